"""End-effector teleoperation: recorded controllers insert in simulation, and nothing they do is dangerous."""

import inspect
import json
import re
import time
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from commands import dataset_flags, flags, follower_flags, run_command
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils import keyboard_input
from rig import Rig
from scipy.spatial.transform import Rotation

from lerobot_vtrefine.datasets.features import STATE_KEY
from lerobot_vtrefine.drivers.arm_models import VIPERX_300S
from lerobot_vtrefine.drivers.dynamixel_arm import rad_to_counts
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.live_world import IDS, LiveWorld
from lerobot_vtrefine.lerobot_compat import phases
from lerobot_vtrefine.sim.config import SceneConfig, TaskConfig
from lerobot_vtrefine.sim.demonstrations import Degradation
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.teleoperators import VtRefineEeConfig
from lerobot_vtrefine.teleoperators.hand_ik import TwoArmIk
from lerobot_vtrefine.teleoperators.hand_motion import ClutchedHand, HandSample, MotionSettings, Pose, still
from lerobot_vtrefine.teleoperators.inputs import gamepad, keyboard, webxr
from lerobot_vtrefine.teleoperators.inputs.speed import Push, SpeedControllers
from lerobot_vtrefine.teleoperators.vtrefine_ee import VtRefineEe

BODIES = ("aloha", "kinova")
BODY = get_embodiment("aloha")
ARMS = [arm.name for arm in BODY.arms]
FPS = 10
YAW = Rotation.from_euler("z", np.pi)
"""The operator's frame in the world, by default."""


@pytest.fixture(autouse=True)
def restored() -> Generator[None]:
    yield
    phases.uninstall()


def expert_targets(env: VtRefineEnvConfig, seed: int) -> np.ndarray:
    """(T + 1, J) commands of the scripted expert, the start first."""
    world = LiveWorld(env)
    world.reset(seed)
    expert = ScriptedExpert(world.sim, Degradation())
    expert.reset(IDS)
    targets = [world.sim.command_targets()[0].copy()]
    while not world.outcome:
        world.step(expert.act(IDS)[0])
        targets.append(world.sim.command_targets()[0].copy())
    assert world.outcome == "success"
    return np.stack(targets)


def as_controllers(
    targets: np.ndarray, tremor_m: float = 0.0, delay: int = 0, body: str = "aloha"
) -> dict[str, np.ndarray]:
    """What controllers would say whose hands move so: anywhere in the room, turned anyhow."""
    ik, body = TwoArmIk(body, 1 / FPS), get_embodiment(body)
    rng = np.random.default_rng(0)
    rows = np.concatenate([np.repeat(targets[:1], 1 + delay, 0), targets[1:]])
    hands = [ik.hands(row) for row in rows]
    closed = 1 - body.openings(rows) / body.fingers.travel_m
    arrays: dict[str, np.ndarray] = {}
    for index, arm in enumerate(ARMS):
        held = Rotation.from_euler("xyz", [0.3, -0.5, 0.8])  # how the controller lies in the person's hand
        place = np.array([0.2, -0.4, 1.1])
        world = [pose[index] for pose in hands]
        turned = [YAW.inv() * Rotation.from_matrix(pose.rotation) * held for pose in world]
        shaken = tremor_m * rng.standard_normal((len(world), 3))
        arrays[f"{arm}_position"] = YAW.inv().apply([pose.position for pose in world]) + place + shaken
        arrays[f"{arm}_quaternion"] = np.stack([turn.as_quat(scalar_first=True) for turn in turned])
        arrays[f"{arm}_clutch"] = np.ones(len(world), bool)
        arrays[f"{arm}_grip"] = closed[:, index]
    return arrays


def record(
    patch: pytest.MonkeyPatch, arrays: dict[str, np.ndarray], folder: Path, env: str, body: str = "aloha"
) -> dict:
    np.savez(folder / "people.npz", **arrays)
    teleop = flags(teleop__type="vtrefine_ee", teleop__input="recording", teleop__path=folder / "people.npz")
    teleop += flags(teleop__embodiment=body)
    robot = flags(robot__type="vtrefine_sim", robot__env=env, robot__fps=FPS, robot__seed=3)
    root = folder / "recorded"
    run_command(patch, "record", [*robot, *teleop, *dataset_flags(root, 1, 30.0, FPS)])
    return json.loads((root / "meta" / "recording.json").read_text())["episodes"][0]


def test_recorded_controllers_insert_through_stock_lerobot_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    targets = expert_targets(VtRefineEnvConfig(start="grasped", num_threads=1), seed=3)
    row = record(monkeypatch, as_controllers(targets), tmp_path, "{start: grasped, num_threads: 1}")
    assert row["success"]
    assert row["in_hand_shift_m"] < 0.003


@pytest.mark.slow
@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize(("tremor_m", "delay"), [(0.0, 0), (0.0003, 2)])
def test_recorded_people_pick_and_insert_from_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tremor_m: float, delay: int, body: str
) -> None:
    scene = SceneConfig(embodiment=body)
    targets = expert_targets(VtRefineEnvConfig(start="table", num_threads=1, scene=scene), seed=3)
    env = f"{{num_threads: 1, scene: {{embodiment: {body}}}}}"
    row = record(monkeypatch, as_controllers(targets, tremor_m, delay, body), tmp_path, env, body)
    print(body, tremor_m, delay, row)
    assert row["success"]
    robot_type = json.loads((tmp_path / "recorded" / "meta" / "info.json").read_text())["robot_type"]
    assert robot_type == get_embodiment(body).robot_type


def stand_at_home(rig: Rig) -> None:
    for arm in BODY.arms:
        angles = dict(zip((joint.name for joint in BODY.joints), arm.home_rad, strict=True))
        motors = [(number, name) for name, number, _ in VIPERX_300S.motors if name in angles]
        motors += [(number, joint) for _, number, _, joint in VIPERX_300S.shadows]
        for number, joint in motors:
            rig.motor("follower", arm.name, number).shaft = float(rad_to_counts(np.array(angles[joint])))


@pytest.mark.slow
def test_motors_are_moved_as_the_simulation_is(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot class of the real arms, on emulated motors: hands start from where the joints are read."""
    stand_at_home(rig)
    rising = np.concatenate([np.zeros(5), np.linspace(0.0, 0.05, 12), np.full(8, 0.05)])
    samples: dict[str, np.ndarray] = {}
    for arm, way in (("left", 0.0 * rising), ("right", rising)):
        samples[f"{arm}_position"] = np.outer(way, [0.0, 0.0, 1.0])
        samples[f"{arm}_quaternion"] = np.tile([1.0, 0.0, 0.0, 0.0], (len(way), 1))
        samples[f"{arm}_clutch"] = np.ones(len(way), bool)
        samples[f"{arm}_grip"] = np.zeros(len(way))
    np.savez(tmp_path / "people.npz", **samples)
    teleop = flags(
        teleop__type="vtrefine_ee", teleop__input="recording", teleop__path=tmp_path / "people.npz"
    )
    root = tmp_path / "recorded"
    run_command(monkeypatch, "record", [*follower_flags(rig), *teleop, *dataset_flags(root, 1, 3.0, FPS)])
    frames = LeRobotDataset("local/x", root=root).hf_dataset.with_format("numpy")
    ik = TwoArmIk("aloha", 1 / FPS)
    first, last = (ik.hands(np.array(frames[STATE_KEY])[k]) for k in (0, -1))
    left, right = (after.position - before.position for before, after in zip(first, last, strict=True))
    np.testing.assert_allclose(right, [0.0, 0.0, 0.05], atol=0.004)
    np.testing.assert_allclose(left, 0.0, atol=0.004)


def driven(env: VtRefineEnvConfig, seed: int, tremor_m: float, delay: int, file: Path) -> tuple[dict, list]:
    """How an episode of recorded people ends, and how far commanded hands were from theirs [m]."""
    body = env.body
    targets = expert_targets(env, seed)
    np.savez(file, **as_controllers(targets, tremor_m, delay, body.name))
    world = LiveWorld(env)
    world.reset(seed)
    teleop = VtRefineEe(VtRefineEeConfig(input="recording", path=file, embodiment=body.name, fps=FPS))
    teleop.connect()
    teleop.follow(dict(zip(teleop.action_features, world.sim.command_targets()[0], strict=True)), FPS)
    errors = []
    while not world.outcome:
        action = np.array(list(teleop.get_action().values()))
        wanted = teleop._ik.hands(targets[min(max(world.steps - delay, 0), len(targets) - 1)])
        pairs = zip(wanted, teleop._ik.hands(), strict=True)
        errors += [np.linalg.norm(one.position - other.position) for one, other in pairs]
        world.step(action)
    teleop.disconnect()
    return world.row(), errors


@pytest.mark.slow
@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize(("tremor_m", "delay"), [(0.0, 0), (0.0003, 2)])
def test_people_insert_from_many_starts(tmp_path: Path, body: str, tremor_m: float, delay: int) -> None:
    env = VtRefineEnvConfig(start="grasped", num_threads=1, scene=SceneConfig(embodiment=body))
    found = [driven(env, seed, tremor_m, delay, tmp_path / "p.npz") for seed in range(10)]
    inserted, errors = sum(row["success"] for row, _ in found), np.concatenate([e for _, e in found])
    print(f"{body}, tremor {1e3 * tremor_m} mm, {delay} steps late: {inserted} of 10; hands off by", end=" ")
    print(f"{1e3 * np.median(errors):.2f} mm, 99 % within {1e3 * np.percentile(errors, 99):.2f} mm")
    assert inserted >= 9


def connected(samples: list[dict[str, HandSample]], **settings: object) -> VtRefineEe:
    teleop = VtRefineEe(VtRefineEeConfig(fps=FPS, **settings))
    given = iter(samples)

    class Given:
        def connect(self) -> None: ...
        def restart(self, grips: dict[str, float]) -> None: ...
        def disconnect(self) -> None: ...
        def read(self) -> dict[str, HandSample]:
            return next(given, {})

    teleop._source = Given()
    teleop.connect()
    return teleop


def at(x: float, clutch: bool = True, turn: float = 0.0, grip: float = 0.0) -> HandSample:
    rotation = Rotation.from_euler("z", turn).as_matrix()
    return HandSample(np.array([x, 0.0, 0.0]), rotation, clutch, grip)


NAN = replace(at(0.0), position=np.full(3, np.nan))
FAULTS = {
    "a jump": [at(0.0), at(0.01), at(3.0), at(3.01)],
    "a jump below the guard, again and again": [at(0.14 * (-1) ** k) for k in range(12)],
    "a spin": [at(0.0), at(0.0, turn=3.0), at(0.0, turn=-3.0)],
    "lost tracking": [at(0.0), None, None, at(0.9), at(0.91)],
    "no numbers": [at(0.0), NAN, at(0.02), NAN],
    "infinite": [at(0.0), replace(at(0.0), position=np.array([np.inf, 0, 0])), at(0.0)],
    "no rotation": [at(0.0), replace(at(0.0), rotation=np.zeros((3, 3))), at(0.1)],
    "a released clutch": [at(0.0), at(0.02), at(0.5, clutch=False), at(0.6, clutch=False), at(0.9)],
    "a dead connection": [at(0.0), at(0.05)],
    "a grip beyond its range": [at(0.0, grip=50.0), at(0.0, grip=-50.0), at(0.0, grip=np.nan)],
    "out of reach": [at(0.1 * k) for k in range(20)],
}


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("fault", FAULTS)
def test_nothing_moves_an_arm_faster_than_its_rate_limit(fault: str, name: str) -> None:
    body = get_embodiment(name)
    teleop = connected([{arm: s for arm in ARMS if s is not None} for s in FAULTS[fault]], embodiment=name)
    rules = TaskConfig()
    gripper = body.fingers.command_rate(rules.finger_rate)
    arms = np.isin(np.arange(body.num_joints), body.arm_columns)
    most = np.where(arms, rules.joint_rate, gripper) / FPS
    actions = [np.asarray(body.home)]
    actions += [np.array(list(teleop.get_action().values())) for _ in range(len(FAULTS[fault]) + 3)]
    steps = np.abs(np.diff(actions, axis=0))
    assert np.isfinite(actions).all()
    assert (steps <= most + 1e-9).all()
    assert (np.array(actions) >= body.lower - 1e-9).all()
    assert (np.array(actions) <= body.upper + 1e-9).all()
    if fault in ("a jump", "lost tracking", "a released clutch"):
        reached = teleop._ik.hands(actions[-1])[0].position - teleop._ik.hands(actions[0])[0].position
        assert np.linalg.norm(reached) < 0.04  # the good samples' way alone
    assert (steps[-1] < 1e-4).all() or fault == "out of reach"  # nothing is heard any more, nothing moves


HELD = Pose(np.array([0.1, 0.2, 0.3]), Rotation.from_euler("xyz", [0.2, 0.4, -0.3]).as_matrix())


def clutched(tool: bool = False, scale: float = 1.0) -> ClutchedHand:
    return ClutchedHand(MotionSettings(scale, YAW.as_matrix(), tool, 0.15, 1.0), HELD)


def test_a_hand_follows_scaled_and_from_where_the_clutch_was_pressed() -> None:
    hand = clutched(scale=0.5)
    assert hand.update(at(0.7), HELD).position is HELD.position
    np.testing.assert_allclose(
        hand.update(at(0.8), HELD).position, HELD.position + np.array([-0.05, 0, 0]), atol=1e-12
    )
    there = Pose(HELD.position + np.array([-0.05, 0, 0]), HELD.rotation)
    hand.update(at(0.85, clutch=False), there)
    hand.update(at(0.75, clutch=True), there)
    np.testing.assert_allclose(
        hand.update(at(0.85), there).position, HELD.position + np.array([-0.1, 0, 0]), atol=1e-12
    )
    turned = hand.update(at(0.85, turn=0.3), there).rotation
    np.testing.assert_allclose(turned, Rotation.from_euler("z", 0.3).as_matrix() @ HELD.rotation, atol=1e-12)


def test_in_the_tool_frame_forward_is_where_the_hand_points() -> None:
    hand = clutched(tool=True)
    hand.update(at(0.0), HELD)
    way = hand.update(at(0.1), HELD).position - HELD.position
    np.testing.assert_allclose(way, 0.1 * HELD.rotation[:, 0], atol=1e-12)


@pytest.mark.parametrize("body", BODIES)
def test_both_arms_are_solved_a_hundred_times_a_second_and_track(body: str) -> None:
    ik = TwoArmIk(body, 0.01)
    start, errors, took = ik.hands(), [], []
    for k in range(300):
        way = 0.02 * np.array([np.sin(k / 80), np.sin(k / 100), 1 - np.cos(k / 90)])
        wanted = [Pose(pose.position + way, pose.rotation) for pose in start]
        began = time.process_time()
        ik.step(wanted, [0.0, None])
        took.append(time.process_time() - began)
        errors += [np.linalg.norm(a.position - b.position) for a, b in zip(wanted, ik.hands(), strict=True)]
    print(f"{1e3 * np.median(took):.2f} ms, largest error {1e3 * max(errors):.4f} mm")
    assert np.median(took) < 0.01
    assert max(errors) < 1e-4


def test_the_point_between_the_pads_stays_while_they_close() -> None:
    """The pads of a four-bar gripper move along the hand as they close."""
    ik = TwoArmIk("kinova", 1 / FPS)
    start = ik.hands()
    reaches = []
    for _ in range(10):
        ik.step(start, [1.0, 0.5])
        reaches.append(ik.body.fingers.reach_m(ik.body.openings(ik.joints)))
        for now, before in zip(ik.hands(), start, strict=True):
            assert np.linalg.norm(now.position - before.position) < 1e-4
    assert np.ptp(reaches) > 2e-3


@pytest.mark.parametrize("body", BODIES)
def test_hands_are_kept_apart_and_above_the_table(body: str) -> None:
    ik = TwoArmIk(body, 0.1)
    middle = [Pose(np.array([0.0, 0.0, 0.15]), pose.rotation) for pose in ik.hands()]
    below = [Pose(pose.position * [1, 1, 0] - [0, 0, 0.1], pose.rotation) for pose in ik.hands()]
    for wanted in (middle, below):
        ik.restart(np.asarray(get_embodiment(body).home))
        for _ in range(60):
            ik.step(wanted, [0.0, 0.0])
        data = mujoco.MjData(ik.model)
        data.qpos[:] = ik._configuration.q
        mujoco.mj_forward(ik.model, data)
        own = [tuple(sorted(c.geom)) for c in data.contact if c.dist < 0]
        root = ik.model.body_rootid[ik.model.geom_bodyid]
        assert [pair for pair in own if root[pair[0]] != root[pair[1]]] == []


def test_no_hand_is_moved_by_a_key_that_lerobot_record_takes() -> None:
    """It ends a recording by Q and an episode by N."""
    taken = set(re.findall(r'key in \("\w+", "(\w)"\)', inspect.getsource(keyboard_input)))
    assert taken == {"n", "r", "q"}
    left, right = (set(keys.values()) for keys in keyboard.KEYS)
    assert len(left | right) == sum(len(keys) for keys in keyboard.KEYS)
    assert not taken & (left | right)


def test_keys_and_sticks_move_imaginary_controllers() -> None:
    left, right = keyboard.KEYS
    push = keyboard.push_of({"w", "a"}, {"f"}, left)
    assert push.way.tolist() == [1, 1, 0]
    assert push.toggle_grip
    assert keyboard.push_of({"w", "a"}, set(), right).way.tolist() == [0, 0, 0]
    assert gamepad.push_of((0.05, -1.0), shoulder=False, grip=False).way.tolist() == [1, 0, 0]
    assert gamepad.push_of((0.0, -1.0), shoulder=True, grip=True).way.tolist() == [0, 0, 1]

    class Device:
        given = iter([[Push(), Push()], [Push(np.array([9.0, 0, 0]), toggle_grip=True), Push()]])

        def connect(self) -> None: ...
        def disconnect(self) -> None: ...
        def pushes(self) -> list[Push]:
            return next(self.given)

    controllers = SpeedControllers(Device(), ARMS, 0.01, 0.1)
    assert controllers.read()["left"].clutch
    moved = controllers.read()
    assert moved["left"].position.tolist() == pytest.approx([0.01, 0, 0])
    assert (moved["left"].grip, moved["right"].grip) == (1.0, 0.0)


def test_a_phone_that_falls_silent_is_lost() -> None:
    phones = webxr.WebXrControllers({"left": 1, "right": 2}, timeout_s=0.05)
    phones.restart({"left": 0.6})  # it holds something, which a page that says "open" does not drop
    for shown, grip in (("open", 0.6), ("close", 0.0), ("close", 0.0), ("open", 1.0)):
        phones.hear("left", np.eye(4), {"move": True, "gripper": shown})
        sample = phones.read()["left"]
        assert (sample.clutch, sample.grip) == (True, grip)
    assert "right" not in phones.read()
    time.sleep(0.06)
    assert phones.read() == {}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"input": "mind"}, "--teleop.input=mind is unknown"),
        ({"input": "recording"}, "belong together"),
        ({"scale": 0.0}, "--teleop.scale must be above 0"),
        ({"speed": 1.5}, "--teleop.speed"),
    ],
)
def test_wrong_settings_are_one_line(settings: dict, words: str) -> None:
    with pytest.raises(Exception, match=words):
        VtRefineEeConfig(**settings)


def test_a_recording_that_lacks_something_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", left_position=np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"x.npz needs left_quaternion of shape \(T, 4\)"):
        VtRefineEe(VtRefineEeConfig(input="recording", path=tmp_path / "x.npz"))
    assert still().clutch is False
