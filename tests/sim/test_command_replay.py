"""Commands through the twin: servos alone, whole scenes, and where parts stood."""

import numpy as np
import pytest

from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.sim.command_replay import grasp_frame, grasp_start, replay_commands, replay_scene
from lerobot_vtrefine.sim.config import SceneConfig, TaskConfig
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.simulation import InsertionSim

ROBOT = get_embodiment("aloha")
HOME = ROBOT.home
WORLD = np.zeros(1, np.int64)


def step_command(frames: int, joint: int, size: float) -> np.ndarray:
    commands = np.tile(HOME, (frames, 1))
    commands[2:, joint] += size
    return commands


def test_arms_follow_their_commands() -> None:
    commands = step_command(60, 1, 0.1)
    (position,) = replay_commands([commands], HOME[None], 0.1)
    assert position.shape == commands.shape
    np.testing.assert_allclose(position[0], HOME)
    assert abs(position[2, 1] - HOME[1]) < 0.01  # the command of frame 2 acts from frame 2 on
    assert 0.02 < position[3, 1] - HOME[1] < 0.1
    assert abs(position[-1, 1] - commands[-1, 1]) < 0.01  # dry friction leaves less than that


def test_episodes_do_not_depend_on_their_company() -> None:
    short, long = step_command(12, 0, 0.2), step_command(20, 5, -0.3)
    together = replay_commands([short, long], np.stack([HOME, HOME]), 1 / 30)
    for commands, position in zip((short, long), together, strict=True):
        (alone,) = replay_commands([commands], HOME[None], 1 / 30)
        np.testing.assert_array_equal(position, alone)


def test_a_ramp_arrives_later_than_a_jump() -> None:
    commands = step_command(10, 0, 0.2)
    (jump,) = replay_commands([commands], HOME[None], 0.1)
    (ramp,) = replay_commands([commands], HOME[None], 0.1, hold="linear")
    assert ramp[3, 0] < jump[3, 0] - 0.01


def test_grippers_close_on_nothing() -> None:
    commands = np.tile(HOME, (40, 1))
    commands[2:, [6, 14]], commands[2:, [7, 15]] = 0.0, 0.0
    (position,) = replay_commands([commands], HOME[None], 0.1)
    assert np.abs(position[-1, [6, 7, 14, 15]]).max() < 1e-3


@pytest.mark.parametrize(
    ("commands", "starts", "options", "message"),
    [
        ([np.zeros((3, 15))], np.zeros((1, 16)), {}, r"commands must be \(T, 16\), got \(3, 15\)"),
        ([np.full((3, 16), np.nan)], np.zeros((1, 16)), {}, "episode 0: commands must be finite"),
        ([np.zeros((3, 16))], np.zeros((2, 16)), {}, "1 episodes need starts"),
        ([np.zeros((3, 16))], np.zeros((1, 16)), {"hold": "spline"}, "hold=spline is unknown"),
    ],
)
def test_wrong_arguments(commands: list, starts: np.ndarray, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replay_commands(commands, starts, 0.1, **options)


def expert_episode(sim: InsertionSim, seed: int, steps: int) -> dict[str, np.ndarray]:
    """States, commands and counts of the scripted expert."""
    expert = ScriptedExpert(sim)
    sim.reset(WORLD, np.array([seed]))
    expert.reset(WORLD)
    frames: dict[str, list[np.ndarray]] = {"state": [], "action": [], "tactile": []}
    for _ in range(steps):
        seen = sim.observe()
        action = expert.act(WORLD).astype(np.float32)
        for key, value in {**seen, "action": action}.items():
            frames.get(key, []).append(value[0])
        sim.step(action)
    return {key: np.stack(values) for key, values in frames.items()}


def test_a_simulated_episode_comes_out_the_same_touch_included() -> None:
    scene = SceneConfig(start="grasped")
    episode = expert_episode(InsertionSim(scene), seed=5, steps=20)
    again = replay_scene(InsertionSim(scene), episode["action"], seed=5)
    np.testing.assert_array_equal(again.position, episode["state"])
    np.testing.assert_array_equal(again.counts, episode["tactile"])
    other = replay_scene(InsertionSim(scene), episode["action"], seed=6)
    assert (other.counts != episode["tactile"]).any()


def test_grasps_tell_where_the_parts_stood() -> None:
    task = TaskConfig()
    sim = InsertionSim(SceneConfig(start="table"), task)
    sim.reset(WORLD, np.array([11]))
    plug, socket = (pose[0] for pose in sim.part_poses())
    episode = expert_episode(sim, seed=11, steps=70)
    start = grasp_start(ROBOT, sim.scene.pair, episode["state"], 0.0)
    assert start is not None
    for found, true in ((start.plug[0], plug), (start.socket[0], socket)):
        assert np.abs(found[:2] - true[:2]).max() < 0.006
        assert abs(found[2] - true[2]) < 1e-3
        assert abs(float(found[3:] @ true[3:])) > np.cos(0.05)
    replayed = replay_scene(InsertionSim(SceneConfig(start="table"), task), episode["action"], 0, start)
    held = replayed.counts[-1].astype(int).sum(1) - replayed.baseline.astype(int).sum(1)
    assert (held > 500).all()  # all four pads hold a part, as in the recording


def test_moment_of_a_grasp() -> None:
    opening = np.full(60, 0.040)
    opening[10:14] = 0.020  # a short try
    opening[20:24] = [0.035, 0.030, 0.027, 0.0255]
    opening[24:50] = 0.025
    position = np.tile(HOME, (60, 1))
    position[:, 6] = opening
    assert grasp_frame(ROBOT, position, 0) == 23
    assert grasp_frame(ROBOT, position, 1) is None
