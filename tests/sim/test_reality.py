"""Hidden physics from a file: late commands, play, shifted encoders, other sensors and parts."""

import json

import numpy as np
import pytest
from draccus.utils import ParsingError

from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.factory import make_simulation
from lerobot_vtrefine.sim.backends import Trace
from lerobot_vtrefine.sim.config import SceneConfig, TaskConfig
from lerobot_vtrefine.sim.drive import make_drive
from lerobot_vtrefine.sim.reality import RobotFaults, load_reality
from lerobot_vtrefine.sim.simulation import InsertionSim
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.dividers import RowSharing
from lerobot_vtrefine.tactile.stages.host import Latency
from lerobot_vtrefine.tactile.stages.hysteresis import Hysteresis
from lerobot_vtrefine.tactile.stages.readout import Gain, Idle, Quantisation, TaxelGainSpread

ROBOT = get_embodiment("aloha")
DT, SUBSTEPS = 0.1, 40
NU = 14
ELBOW = 2


class Recorder:
    """A backend that only notes the servos' commands, a row per substep."""

    num_envs = 3

    def __init__(self):
        self.commands = []

    def advance(self, ids, controls):
        self.commands.append(controls)
        return Trace(controls, controls)

    def advance_linearly(self, ids, start, stop, substeps):
        weight = ((np.arange(substeps) + 1) / substeps)[None, :, None]
        return self.advance(ids, start[:, None] + weight * (stop - start)[:, None])

    def series(self):
        return np.concatenate(self.commands, axis=1)


def drive_through(faults, commands, ids=(0, 2)):
    """Servo commands (m, K, nu) of a drive that follows the controller's commands (steps, nu)."""
    backend, ids = Recorder(), np.array(ids)
    drive = make_drive(backend, ROBOT, SUBSTEPS, TaskConfig(), faults)
    before = drive.reset(ids, np.zeros((len(ids), NU)))
    for command in commands:
        after = np.tile(command, (len(ids), 1))
        trace = drive.advance(ids, before, after)
        assert trace.qpos.shape == (len(ids), SUBSTEPS, NU)
        before = after
    return backend.series()


def random_commands(steps=6, seed=0):
    return np.random.default_rng(seed).normal(0, 0.1, (steps, NU))


@pytest.mark.parametrize("latency_s", [0.0, 0.03, 0.1, 0.25])
def test_commands_arrive_late_and_unchanged(latency_s):
    commands = random_commands()
    seen = drive_through(RobotFaults(control_latency_s=latency_s), commands)

    knots = np.arange(len(commands) + 1) * DT
    values = np.vstack([np.zeros(NU), commands])
    times = (np.arange(len(commands) * SUBSTEPS) + 1) * DT / SUBSTEPS - latency_s
    expected = np.column_stack([np.interp(times, knots, values[:, k]) for k in range(NU)])
    np.testing.assert_allclose(seen[0], expected, atol=1e-12)
    np.testing.assert_array_equal(seen[0], seen[1])


def test_play_swallows_reversals_of_its_joint_only():
    there = np.zeros(NU)
    there[ELBOW] = 0.2
    back = there * 0.9
    seen = drive_through(RobotFaults(backlash_rad={"left_elbow": 0.03}), [there, back, np.zeros(NU)])
    ends = seen[0, SUBSTEPS - 1 :: SUBSTEPS]
    np.testing.assert_allclose(ends[:, ELBOW], [0.185, 0.185, 0.015])
    assert not np.delete(seen, ELBOW, axis=2).any()
    # On the way there nothing moves until the play is taken up, half of its width on that side.
    way = seen[0, :SUBSTEPS, ELBOW]
    np.testing.assert_allclose(way, (np.linspace(0, 0.2, SUBSTEPS + 1)[1:] - 0.015).clip(0), atol=1e-12)


def test_encoder_offset_shifts_readings_and_commands_alike():
    scene = SceneConfig(start="grasped")
    plain, shifted = (
        InsertionSim(scene, sensor="paper", num_envs=2, robot_faults=faults)
        for faults in (None, RobotFaults(encoder_offset_rad={"right_waist": 0.02}))
    )
    waist = ROBOT.joint_names.index("right_waist")
    for sim in (plain, shifted):
        sim.reset(np.arange(2), np.array([3, 4]))
    offset = shifted.joint_state() - plain.joint_state()
    np.testing.assert_allclose(offset[:, waist], 0.02, atol=1e-6)
    assert not np.delete(offset, waist, axis=1).any()
    # Holding what the encoders say keeps the arm where it is ...
    start = plain.part_poses()[0]
    for sim in (plain, shifted):
        sim.step(sim.command_targets())
    np.testing.assert_allclose(shifted.part_poses()[0], plain.part_poses()[0], atol=1e-9)
    assert np.abs(plain.part_poses()[0] - start).max() < 1e-3
    # ... and a command in true coordinates moves it away.
    for sim in (plain, shifted):
        sim.step(plain.command_targets())
    assert np.abs(shifted.part_poses()[0] - plain.part_poses()[0]).max() > 1e-3


def test_late_commands_move_the_arm_later_and_snapshots_know():
    faults = RobotFaults(control_latency_s=0.06, backlash_rad={"left_elbow": 0.004})
    sims = [
        InsertionSim(SceneConfig(start="grasped"), sensor="paper", num_envs=1, robot_faults=f)
        for f in (None, RobotFaults(), faults)
    ]
    goals = []
    for sim in sims:
        sim.reset(np.arange(1), np.array([5]))
        goal = sim.command_targets()
        goal[0, 0] += 0.05
        sim.step(goal)
        goals.append(sim.joint_state()[0, 0])
    assert goals[0] == goals[1]
    assert goals[2] < goals[0] - 0.005
    late = sims[2]
    kept = late.get_state(0)
    first = [late.step(late.command_targets()) and late.joint_state() for _ in range(3)]
    late.set_state(0, kept)
    again = [late.step(late.command_targets()) and late.joint_state() for _ in range(3)]
    np.testing.assert_array_equal(first, again)


def write(path, **content):
    path.write_text(json.dumps({"schema": "vtrefine/reality@1", **content}))
    return path


def test_environment_stands_in_for_reality(tmp_path):
    sensor = SensorModel((KelvinVoigt(), Gain(), RowSharing(2e-3), Idle(30.0, 0.0), Quantisation()))
    sensor.save(tmp_path / "hidden.json")
    file = write(
        tmp_path / "reality.json",
        sensor_model="hidden.json",
        robot={"control_latency_s": 0.05},
        scene={"clearance_m": 0.001, "part_friction": 0.5},
    )
    config = VtRefineEnvConfig(start="grasped", clearance_m=0.002, reality=file)
    assert config.scene_config.clearance_m == 0.001
    assert config.scene_config.part_friction == 0.5
    sim = make_simulation(config, 1)
    sim.reset(np.arange(1), np.array([0]))
    assert (sim.observe()["tactile_baseline"] == 30).all()
    plain = make_simulation(VtRefineEnvConfig(start="grasped"), 1)
    assert plain.scene.config.clearance_m == 0.002


def test_the_extended_model_of_a_diagnosis_is_loaded_as_it_is(tmp_path):
    rng = np.random.default_rng(0)
    gains = np.exp(rng.normal(0, 0.2, (12, 32)))
    idle = 20.0 + rng.uniform(0, 10, (12, 32)).round()
    model = SensorModel(
        (
            KelvinVoigt(420.0, 1.1),
            Hysteresis((0.1, 0.1), (1e-4, 3e-4)),
            Gain(480.0),
            TaxelGainSpread(map=gains.tolist()),
            RowSharing(1e-3),
            Idle(idle.tolist(), 0.0),
            Latency(0.08),
            Quantisation(),
        )
    )
    model.save(tmp_path / "sensor_model.json")
    sim = make_simulation(
        VtRefineEnvConfig(start="grasped", sensor_model=str(tmp_path / "sensor_model.json")), 2
    )
    sim.reset(np.arange(2), np.array([0, 1]))
    for _ in range(3):
        sim.step(sim.command_targets())
    seen = sim.observe()
    np.testing.assert_array_equal(seen["tactile_baseline"][0, 0], idle.ravel().astype(np.uint8))
    pressed = seen["tactile"].astype(int) - seen["tactile_baseline"]
    assert pressed.max() > 20
    assert (pressed >= -1).all()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"sensor": "x.json"}, "reality has no 'sensor'; valid: schema, sensor_model, robot, scene"),
        ({"robot": {"latency": 1}}, "robot has no 'latency'"),
        ({"robot": {"control_latency_s": -0.1}}, "control_latency_s must lie in"),
        ({"robot": {"backlash_rad": {"left_elbow": -0.1}}}, "must not be negative"),
        ({"scene": {"pair": "square"}}, "scene has no 'pair'"),
        ({"scene": {"clearance_m": -1}}, "clearance_m must be above 0"),
        ({"schema": "vtrefine/other@1"}, "vtrefine/reality@1"),
        ({"sensor_model": {"schema": "vtrefine/sensor-model@1", "stages": []}}, "contact"),
    ],
)
def test_faults_of_the_file_are_named(tmp_path, content, words):
    file = write(tmp_path / "reality.json", **content)
    with pytest.raises(ValueError, match=r"reality\.json") as error:
        load_reality(file)
    assert words in str(error.value)
    with pytest.raises(ParsingError, match=r"reality\.json"):
        VtRefineEnvConfig(reality=file)


def test_missing_files_unknown_joints_and_two_sensor_models_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_reality(tmp_path / "nowhere.json")
    with pytest.raises(ParsingError, match=r"--env\.reality=.*nowhere\.json: no such file"):
        VtRefineEnvConfig(reality=tmp_path / "nowhere.json")
    with pytest.raises(ValueError, match="no arm has a joint 'left_left_finger'"):
        make_drive(
            Recorder(), ROBOT, SUBSTEPS, TaskConfig(), RobotFaults(backlash_rad={"left_left_finger": 0.1})
        )
    joint = {
        "name": "left_elbow",
        "natural_frequency_rad_s": 20.0,
        "damping_ratio": 1.0,
        "laws": {"flex": 1.0},
    }
    (tmp_path / "robot.json").write_text(json.dumps({"schema": "vtrefine/robot-model@1", "joints": [joint]}))
    with pytest.raises(ValueError, match=r"robot\.json: the simulated arms know no law 'flex'"):
        load_reality(tmp_path / "robot.json")
    model = SensorModel.paper().to_dict()
    file = write(tmp_path / "reality.json", sensor_model=model)
    with pytest.raises(ParsingError, match=r"drop --env\.sensor_model"):
        VtRefineEnvConfig(reality=file, sensor_model="paper")
