"""The simulation as a robot of LeRobot's stock commands."""

import json
from collections.abc import Generator
from pathlib import Path
from types import SimpleNamespace
from urllib.request import urlopen

import numpy as np
import pytest
from aloha_columns import TACTILE_KEYS
from commands import dataset_flags, flags, leader_flags, run_command, train
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.robots import make_robot_from_config
from lerobot.scripts import lerobot_replay
from rig import Rig, follower_config

from lerobot_vtrefine.cli.record_demos import RecordDemosConfig, record
from lerobot_vtrefine.datasets.features import ACTION_KEY, DEPTH_KEY, STATE_KEY
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.lerobot_compat import phases
from lerobot_vtrefine.robots import VtRefineSimConfig
from lerobot_vtrefine.robots import vtrefine_sim as module
from lerobot_vtrefine.robots.vtrefine_sim import VtRefineSim
from lerobot_vtrefine.sim.config import fitting_timestep

FPS = 10
TACTILE = TACTILE_KEYS[0].removeprefix("observation.")
GRASPED = "{start: grasped, num_threads: 1}"


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One episode of the scripted expert, from seed 0."""
    root = tmp_path_factory.mktemp("demos") / "demos"
    record(
        RecordDemosConfig(
            root, num_episodes=1, num_envs=1, env=VtRefineEnvConfig(start="grasped", num_threads=1)
        )
    )
    return root


@pytest.fixture(autouse=True)
def restored() -> Generator[None]:
    yield
    phases.uninstall()


def robot_flags(**more: object) -> list[str]:
    return flags(robot__type="vtrefine_sim", robot__env=GRASPED, robot__fps=FPS, **more)


def table_flags(**env: object) -> list[str]:
    told = ", ".join(f"{key}: {value}" for key, value in {"num_threads": 1, **env}.items())
    camera = "{width: 80, height: 60, fov_y_rad: 0.384, position_m: [-0.44, 0, 0.42], target_m: [0, 0, 0.09]}"
    return flags(
        robot__type="vtrefine_sim", robot__env=f"{{scene: {{camera: {camera}}}, {told}}}", robot__fps=FPS
    )


def pictures(dataset: LeRobotDataset, index: int) -> np.ndarray:
    return np.asarray(dataset[index][DEPTH_KEY])


def states(root: Path) -> np.ndarray:
    return np.array(LeRobotDataset("local/x", root=root).hf_dataset.with_format("numpy")[STATE_KEY])


def noted(root: Path) -> list[dict]:
    return json.loads((root / "meta" / "recording.json").read_text())["episodes"]


def merge(patch: pytest.MonkeyPatch, roots: list[Path], target: Path) -> LeRobotDataset:
    command = flags(
        operation__type="merge",
        operation__repo_ids=f"[{', '.join(f'local/{root.name}' for root in roots)}]",
        operation__roots=f"[{', '.join(map(str, roots))}]",
        new_repo_id="local/merged",
        new_root=target,
    )
    run_command(patch, "edit_dataset", command)
    return LeRobotDataset("local/merged", root=target)


@pytest.mark.slow
def test_stock_record_with_leaders_merges_with_expert_demonstrations_both_ways(
    rig: Rig, demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "driven"
    command = [*table_flags(episode_steps=8), *leader_flags(rig), *dataset_flags(root, 2, 3.0, FPS)]
    told: list[str] = []
    monkeypatch.setattr(module.logger, "info", lambda text, *values: told.append(text % values))
    run_command(monkeypatch, "record", command)
    assert all(row["failure"] not in ("none", "stopped") for row in noted(root))  # arms sweep the parts away
    assert [row["seed"] for row in noted(root)] == [0, 1]
    dataset = LeRobotDataset("local/driven", root=root)
    lengths = list(dataset.meta.episodes["length"])
    assert lengths == [row["steps"] for row in noted(root)]  # the loop ended where the episode did
    assert max(lengths) <= 8 < 3.0 * FPS
    assert (pictures(dataset, 0) != pictures(dataset, lengths[0])).sum() > 20  # the parts stand elsewhere
    assert sum("behind real time" in line for line in told) == 2

    for order in ([demos, root], [root, demos]):
        merged = merge(monkeypatch, order, tmp_path / f"merged_{order[0].name}")
        assert merged.meta.total_episodes == 3
        assert merged.meta.robot_type == "aloha_tactile_follower"


def test_stock_replay_repeats_an_experts_episode_exactly(
    demos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[float]] = []
    felt: list[np.ndarray] = []
    rows: list[dict] = []
    look, leave = VtRefineSim.get_observation, VtRefineSim.disconnect

    def noting(robot: VtRefineSim) -> dict:
        look(robot)
        values = look(robot)  # whoever looks twice sees the same
        seen.append([values[key] for key in robot.action_features])
        felt.append(values[TACTILE])
        return values

    def leaving(robot: VtRefineSim) -> None:
        rows.append(robot.world.row())
        leave(robot)

    monkeypatch.setattr(VtRefineSim, "get_observation", noting)
    monkeypatch.setattr(VtRefineSim, "disconnect", leaving)
    replayed = flags(dataset__repo_id="local/demos", dataset__root=demos, dataset__episode=0)
    run_command(monkeypatch, "replay", [*robot_flags(robot__seed=0), *replayed, "--play_sounds=false"])
    np.testing.assert_array_equal(np.array(seen, np.float32), states(demos))
    recorded = LeRobotDataset("local/x", root=demos).hf_dataset.with_format("numpy")
    np.testing.assert_array_equal(np.array(felt), np.array(recorded[f"observation.{TACTILE}"]))
    assert rows[0]["success"]


@pytest.mark.slow
def test_teleoperation_starts_the_next_episode_by_itself(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    start = VtRefineSim._start

    def noting(robot: VtRefineSim, seed: int) -> None:
        seeds.append(seed)
        start(robot, seed)

    monkeypatch.setattr(VtRefineSim, "_start", noting)
    for side in ("left", "right"):
        rig.motor("leader", side, 9).shaft = 2500.0
    command = [*robot_flags(robot__seed=7, robot__pause_s=0.1), *leader_flags(rig)]
    run_command(monkeypatch, "teleoperate", [*command, "--teleop_time_s=3", f"--fps={FPS}"])
    assert seeds[:2] == [7, 8]


def test_another_rate_is_refused_in_one_line(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = [*robot_flags(), *leader_flags(rig), *dataset_flags(tmp_path / "d", 1, 1.0, 15)]
    with pytest.raises(ValueError, match=r"--robot.fps=15"):
        run_command(monkeypatch, "record", command)
    with pytest.raises(ValueError, match=r"--robot.fps=60"):  # what lerobot-teleoperate does by default
        run_command(monkeypatch, "teleoperate", [*robot_flags(), *leader_flags(rig), "--teleop_time_s=1"])


def test_a_recording_of_another_rate_is_not_replayed_in_slow_motion(
    demos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replayed = flags(dataset__repo_id="local/demos", dataset__root=demos, dataset__episode=0)
    command = flags(robot__type="vtrefine_sim", robot__env=GRASPED, robot__fps=3 * FPS, play_sounds="false")
    with pytest.raises(ValueError, match=f"^--robot.fps={3 * FPS}, .* give --robot.fps={FPS} "):
        run_command(monkeypatch, "replay", [*command, *replayed])


def test_another_robot_that_is_replayed_later_in_this_process_has_its_own_rate(rig: Rig) -> None:
    sim = VtRefineSim(VtRefineSimConfig(env={"start": "grasped", "num_threads": 1}))
    assert lerobot_replay.LeRobotDataset is not LeRobotDataset  # sim would check the rate
    other = lerobot_replay.make_robot_from_config(follower_config(rig))
    assert other is not sim
    assert lerobot_replay.LeRobotDataset is LeRobotDataset
    assert lerobot_replay.make_robot_from_config is make_robot_from_config


def test_a_loop_of_ones_own_takes_other_robots_as_it_did() -> None:
    sim, seen = VtRefineSim(VtRefineSimConfig(env={"start": "grasped", "num_threads": 1})), []

    def loop(robot: object, events: dict, fps: int) -> None:
        seen.append((robot, events, fps))

    phases._phased(loop)("another robot", {}, 30)
    assert seen == [("another robot", {}, 30)]
    with pytest.raises(TypeError, match="needs its arguments by name here: robot="):
        phases._phased(loop)(sim, {}, 30)


def rollout_of(robot: object, fps: int = FPS, between: int = 1) -> SimpleNamespace:
    """The context of a rollout, as far as strategies without recording read it."""
    runtime = SimpleNamespace(cfg=SimpleNamespace(fps=fps, interpolation_multiplier=between))
    return SimpleNamespace(hardware=SimpleNamespace(robot_wrapper=robot), runtime=runtime)


@pytest.mark.parametrize(("fps", "between"), [(3 * FPS, 1), (FPS, 2)])
def test_a_rollout_that_records_nothing_runs_at_the_rate_of_the_simulation(fps: int, between: int) -> None:
    robot = connected(fps=FPS)
    with pytest.raises(ValueError, match=f"give --robot.fps={fps * between} "):
        phases._forgetting(lambda *_: pytest.fail("it ran"))(None, rollout_of(robot, fps, between))
    robot.disconnect()


def connected(**settings: object) -> VtRefineSim:
    robot = VtRefineSim(VtRefineSimConfig(env={"start": "grasped", "num_threads": 1}, **settings))
    robot.connect()
    return robot


class Dataset:
    """What a phase asks of a dataset."""

    def __init__(self, root: Path) -> None:
        self.root, self.num_episodes = root, 0


def test_a_rerecorded_episode_starts_from_the_same_seed_and_is_not_noted(tmp_path: Path) -> None:
    robot, dataset = connected(seed=5), Dataset(tmp_path)
    (tmp_path / "meta").mkdir()
    home = dict(zip(robot.action_features, robot.world.sim.command_targets()[0], strict=True))
    events = {"exit_early": False, "rerecord_episode": False}

    def episode() -> int:
        with robot.phase(events, dataset):
            robot.get_observation()
            robot.send_action(home)
            return robot.world.seed

    assert episode() == 5
    assert episode() == 5  # discarded: the dataset did not grow
    dataset.num_episodes = 1
    with robot.phase(events, None):
        assert robot.world.seed == 6
    assert episode() == 6
    robot.disconnect()  # not saved either
    assert [(row["episode_index"], row["seed"], row["failure"]) for row in noted(tmp_path)] == [
        (0, 5, "stopped")
    ]


def test_a_dataset_of_another_simulation_is_refused_before_anything_is_recorded(tmp_path: Path) -> None:
    robot, dataset = connected(), Dataset(tmp_path)
    (tmp_path / "meta").mkdir()
    other = {"settings": {"scene": {"pair": "square"}}, "episodes": []}
    (tmp_path / "meta" / "recording.json").write_text(json.dumps(other))
    with (
        pytest.raises(ValueError, match=r"recording.json notes a recording in another simulation: choose"),
        robot.phase({"exit_early": False}, dataset),
    ):
        pytest.fail("a frame could have been recorded")
    robot.disconnect()
    assert noted(tmp_path) == []


def test_a_rollouts_policy_forgets_the_last_episode() -> None:
    robot, forgotten = connected(seed=5, pause_s=0.1), []
    part = SimpleNamespace(reset=lambda: forgotten.append(robot.world.seed))
    strategy = SimpleNamespace(_engine=part, _interpolator=part)

    def run(_strategy: object, _ctx: object) -> None:
        robot.world.outcome, robot.world._row = "success", {**robot.world.row(), "time_to_success_s": 1.0}
        for _ in range(3):
            robot.send_action(robot.held_targets())

    wrapper = SimpleNamespace(inner=robot)
    phases._forgetting(run)(strategy, rollout_of(wrapper))
    assert forgotten == [6, 6]
    assert robot.on_restart is None
    robot.disconnect()


def test_what_the_last_episode_called_for_does_not_move_the_next_one() -> None:
    """lerobot-rollout does not tell its policy of a new episode: a chunk that has begun is carried out."""
    robot = connected(seed=5, pause_s=0.6)
    robot.world.outcome, robot.world._row = "success", {**robot.world.row(), "time_to_success_s": 1.0}
    stale = {name: value + 0.05 for name, value in robot.held_targets().items()}
    while robot.world.seed == 5:
        robot.send_action(stale)
    start = robot.held_targets()
    for _ in range(3):  # half of the pause at 10 Hz
        assert robot.send_action(stale) == start
    assert robot.send_action(stale) != start
    robot.disconnect()


def test_a_teleoperator_goes_on_from_where_the_next_episode_begins() -> None:
    robot = connected(seed=5, pause_s=0.1)
    followed: list[tuple[int, dict, float]] = []

    class Hands:
        def follow(self, positions: dict[str, float], fps: float) -> None:
            followed.append((robot.world.seed, positions, fps))

    def loop(**_settings: object) -> None:
        robot.world.outcome, robot.world._row = "success", {**robot.world.row(), "time_to_success_s": 1.0}
        for _ in range(3):
            robot.send_action(robot.held_targets())

    phases._phased(loop)(robot=robot, teleop=Hands(), fps=FPS)
    assert [(seed, fps) for seed, _, fps in followed] == [(5, FPS), (6, FPS)]
    (_, first, _), (_, second, _) = followed
    assert list(first) == list(robot.action_features)
    assert first != second  # in hand, another seed holds the parts elsewhere
    assert robot.on_restart is None


def test_the_robots_camera_gives_colour_where_the_environment_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    painted = np.arange(24 * 32 * 3, dtype=np.uint8).reshape(1, 24, 32, 3)

    class Painter:
        def __init__(self, *size: object) -> None:
            assert size[1:] == (24, 32)

        def images(self, ids: np.ndarray) -> np.ndarray:
            return painted

    monkeypatch.setattr("lerobot_vtrefine.sim.rgb.RgbCamera", Painter)
    colour = {"start": "grasped", "num_threads": 1, "rgb": True, "rgb_size": [24, 32]}
    robot = VtRefineSim(VtRefineSimConfig(env=colour))
    assert robot.observation_features["front"] == (24, 32, 3)
    robot.connect()
    seen = robot.get_observation()
    assert set(seen) == set(robot.observation_features)
    assert np.array_equal(seen["front"], painted[0])
    robot.disconnect()


def test_it_hands_over_what_it_announces_and_shows_its_own_body() -> None:
    env = {"start": "grasped", "num_threads": 1, "scene": {"embodiment": "kinova"}}
    robot = VtRefineSim(VtRefineSimConfig(env=env, view="browser", view_port=8241))
    robot.connect()
    assert b"<html" in urlopen(f"http://127.0.0.1:{robot._viewer.port}", timeout=10).read().lower()
    assert robot._viewer._cloud.embodiment == "kinova"
    observation = robot.get_observation()
    robot.send_action(robot.held_targets())
    robot.disconnect()
    assert set(observation) == set(robot.observation_features)
    assert "tactile.left_gripper_left_pad" in observation
    assert robot.name == "kinova_gen3_tactile_follower"


def test_commands_that_are_too_fast_are_told_at_the_end(caplog: pytest.LogCaptureFixture) -> None:
    robot = connected()
    robot.send_action(robot.held_targets())
    robot.send_action(dict.fromkeys(robot.action_features, 9.0))
    robot.disconnect()
    (told,) = [line for line in caplog.messages if "were cut" in line]
    assert told.startswith("1 of 2 commands asked for more than the joints' limits and rates allow")


def test_no_action_that_is_no_number_reaches_the_arms() -> None:
    robot = connected()
    action = dict.fromkeys(robot.action_features, 0.0)
    for bad in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="nothing was sent"):
            robot.send_action(action | {next(iter(action)): bad})
    assert robot.world.steps == 0


@pytest.mark.parametrize("fps", [10, 15, 30, 50, 100])
def test_the_physics_step_divides_every_control_step(fps: int) -> None:
    step_s = fitting_timestep(0.0025, fps)
    assert step_s <= 0.0025
    assert 1 / fps / step_s == pytest.approx(round(1 / fps / step_s))
    env = VtRefineSimConfig(fps=fps, episode_s=20).simulation()
    assert env.scene_config.timestep_s == step_s
    assert env.max_episode_steps == 20 * fps


def test_wrong_settings_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "none.yaml").write_text("policy: {}\n")
    for settings, words in (
        ({"env": {"pair": "sqare"}}, "sqare"),
        ({"env_file": tmp_path / "none.yaml"}, "has no part `env:`"),
        ({"env": {"unheard": 1}}, "unheard"),
        ({"view": "window"}, "--robot.view=window"),
        ({"view_port": 70_000}, "--robot.view_port must lie between 1 and 65535, got 70000"),
        ({"fps": 120}, "--robot.fps must lie between 1 and 100 control steps a second, got 120"),
    ):
        with pytest.raises(Exception, match=words):
            VtRefineSim(VtRefineSimConfig(**settings)).connect()


@pytest.mark.slow
def test_record_train_and_roll_out_in_simulation(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    root = tmp_path / "driven"
    run_command(
        monkeypatch, "record", [*robot_flags(), *leader_flags(rig), *dataset_flags(root, 1, 2.0, FPS)]
    )
    policy = train(monkeypatch, root, tmp_path / "out", steps=2)
    common = [*robot_flags(), *flags(policy__path=policy, fps=FPS, device="cpu", play_sounds="false")]
    run_command(monkeypatch, "rollout", [*common, "--strategy.type=base", "--duration=3"])
    target = tmp_path / "rolled" / "rollout_x"
    recorded = [
        line
        for line in dataset_flags(target, 2, 1.0, FPS)
        if "play_sounds" not in line and "num_ep" not in line and "repo_id" not in line
    ]
    run_command(
        monkeypatch,
        "rollout",
        [
            *common,
            "--strategy.type=episodic",
            *recorded,
            "--dataset.num_episodes=2",
            "--dataset.repo_id=local/rollout_x",
        ],
    )
    assert [row["seed"] for row in noted(target)] == [0, 1]
    assert LeRobotDataset("local/x", root=target).features[ACTION_KEY]["shape"] == (16,)
