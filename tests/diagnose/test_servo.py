"""A servo with a known load: its simulation against analytic truth and other code, and the verdicts."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from servo_rig import (
    ARMATURE,
    COULOMB,
    FPS,
    GAINS,
    KT,
    LENGTH_M,
    MASS_KG,
    OHM,
    VISCOUS,
    Law,
    commands,
    make_set,
    plain,
    swing,
)

from lerobot_vtrefine.cli.import_dataset import ImportConfig, import_dataset
from lerobot_vtrefine.cli.predict import main as predict
from lerobot_vtrefine.diagnose.api import diagnose
from lerobot_vtrefine.diagnose.core.suspicion import raise_alarms
from lerobot_vtrefine.diagnose.recordings import read_recording_set
from lerobot_vtrefine.diagnose.servo import candidates
from lerobot_vtrefine.diagnose.servo.bench import Bench
from lerobot_vtrefine.diagnose.servo.model import ServoModel
from lerobot_vtrefine.diagnose.servo.parameters import INDEX
from lerobot_vtrefine.diagnose.servo.problem import ServoProblem
from lerobot_vtrefine.diagnose.servo.simulation import simulate
from lerobot_vtrefine.diagnose.verdict import SERVO_CAUSES

Array = np.ndarray
WEIGHT = MASS_KG * 9.80665 * LENGTH_M
INERTIA = MASS_KG * LENGTH_M**2 + ARMATURE
TRUTH = {
    "log_torque": np.log(KT),
    "log_resistance": np.log(OHM),
    "log_armature": np.log(ARMATURE),
    "coulomb": COULOMB,
    "viscous": VISCOUS,
}


def bench_of(command: Array, gain: Array, first: Array, on: float = 1.0, fps: float = FPS) -> Bench:
    count, trials = command.shape
    ones = np.ones(trials)
    return Bench(
        time_s=np.repeat(np.arange(count)[:, None] / fps, trials, 1),
        command=command,
        position=np.repeat(first[None], count, 0),
        torque_on=np.full(command.shape, on),
        temperature_c=np.full(command.shape, 25.0),
        valid=np.ones(command.shape, dtype=bool),
        inertia=ones * MASS_KG * LENGTH_M**2,
        weight=ones * WEIGHT,
        duty_per_rad=gain,
        supply_v=ones * 7.4,
        max_duty=ones,
        files=tuple(map(str, range(trials))),
        recorded=tuple(map(str, range(trials))),
    )


def theta(**values: float) -> Array:
    out = np.zeros(len(INDEX))
    for name, value in (TRUTH | values).items():
        out[INDEX[name]] = value
    return out


def released(angle: float, **values: float) -> tuple[Array, Array]:
    """Times and positions of a shaft that is let go at an angle."""
    bench = bench_of(np.zeros((2000, 1)), np.ones(1), np.array([angle]), on=0.0, fps=1000.0)
    return bench.time_s[:, 0], simulate(bench, theta(**values)[None])[:, 0, 0]


def test_a_free_pendulum_has_its_period() -> None:
    time_s, q = released(0.05, coulomb=0.0, viscous=0.0)
    crossing = time_s[1:][np.diff(np.sign(q)) != 0]
    assert 2 * np.diff(crossing).mean() == pytest.approx(2 * np.pi * np.sqrt(INERTIA / WEIGHT), rel=5e-3)


def test_coulomb_friction_takes_the_same_off_every_half_swing() -> None:
    _, q = released(0.15, coulomb=0.005, viscous=0.0)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(q))) != 0) + 1
    height = np.abs(np.r_[q[0], q[turns]])
    lost = -np.diff(height)[: int(0.15 / (2 * 0.005 / WEIGHT)) - 1]
    assert lost == pytest.approx(2 * 0.005 / WEIGHT, rel=0.05)


def test_a_servo_comes_to_rest_where_motor_and_load_balance_within_friction() -> None:
    gain = np.array(GAINS)
    bench = bench_of(np.full((600, 3), 0.8), gain, np.zeros(3))
    q = simulate(bench, theta()[None])[-1, 0]
    left = KT * gain * (0.8 - q) * 7.4 / OHM - WEIGHT * np.sin(q)
    assert (np.abs(left) <= COULOMB * 1.001).all()


def at_rest(speed: Array, at: float) -> Array:
    return np.exp(-np.abs(speed) / at)


LAWS: dict[str, tuple[dict[str, float], Law]] = {
    "M1": ({}, plain),
    "M2": (
        {"stiction": 0.06, "stiction_speed": 0.4},
        lambda motor, load, v: plain(motor, load, v) + 0.06 * at_rest(v, 0.4),
    ),
    "M3": ({"load_friction": 0.2}, lambda motor, load, v: plain(motor, load, v) + 0.2 * np.abs(motor - load)),
    "M5": (
        {
            "motor_friction": 0.4,
            "carried_friction": 0.1,
            "motor_stiction": 0.1,
            "carried_stiction": 0.2,
            "load_stiction_speed": 1.0,
        },
        lambda motor, load, v: (
            plain(motor, load, v)
            + np.abs(0.4 * motor - 0.1 * load)
            + at_rest(v, 1.0) * np.abs(0.1 * motor - 0.2 * load)
        ),
    ),
    "M6": (
        {"quadratic_motor": 0.5, "quadratic_load": 0.8, "quadratic_speed": 2.0},
        lambda motor, load, v: (
            plain(motor, load, v)
            + at_rest(v, 2.0)
            * np.where(np.abs(motor) > np.abs(load), 0.8 * load**2, 0.5 * motor**2)
            * (motor * load < 0)
        ),
    ),
}


@pytest.mark.parametrize("name", LAWS)
def test_laws_of_friction_are_those_of_the_paper(name: str) -> None:
    values, law = LAWS[name]
    gain, command = np.array(GAINS), commands(3, np.random.default_rng(3))
    ours = simulate(bench_of(command, gain, np.zeros(3)), theta(**values)[None])[:, 0]
    error, effect = (np.sqrt(np.mean((ours - swing(command, gain, item)) ** 2)) for item in (law, plain))
    assert error < 0.005
    assert not values or error < 0.2 * effect


def test_a_supply_with_resistance_lets_a_driven_motor_hold_less() -> None:
    """At rest motor and load balance, under pulses that put duty (supply - current source) on the motor."""
    gain = np.array(GAINS)
    bench = bench_of(np.full((600, 3), 0.8), gain, np.zeros(3))
    q = simulate(bench, theta(source_resistance=0.5, coulomb=0.0, viscous=0.05)[None])[-1, 0]
    duty = gain * (0.8 - q)
    assert KT * duty * 7.4 / (OHM * (1 + 0.5 * duty)) == pytest.approx(WEIGHT * np.sin(q), rel=1e-3)


def test_users_get_a_servo_fitted_to_all_trials_and_numbers_of_one_that_was_not(tmp_path: Path) -> None:
    problem = ServoProblem.of(Bench.of(read_recording_set(make_set(tmp_path / "set", plain, trials=6))))
    part = problem.subset(np.arange(3))
    fitted = part.baseline()
    baseline, extended = problem.completed(SimpleNamespace(baseline=fitted, fit=fitted))
    assert (baseline.theta == extended.theta).all()
    assert baseline.mse.mean() < problem.errors(fitted).mean()


def test_every_file_of_the_servos_catalogue_is_asked_about() -> None:
    folder = Path(candidates.__file__).parent
    files = {path.stem for path in folder.glob("*.py")} - {"__init__", "base"}
    assert set(candidates.NAMES) == files == {*SERVO_CAUSES, "backlash", "control_latency"}
    assert {item.cause for item in candidates.CATALOGUE} == files
    assert all(candidates.MEANING[name] for name in files)


def test_a_model_is_read_back_and_predicts_from_the_first_position_alone(tmp_path: Path) -> None:
    folder = make_set(tmp_path / "set", plain, trials=3)
    model = ServoModel.of(theta(load_friction=0.1))
    model.save(tmp_path / "model.json")
    assert ServoModel.load(tmp_path / "model.json") == model
    predict(
        [f"--recording={folder}", f"--sensor_model={tmp_path}/model.json", f"--output_dir={tmp_path}/out"]
    )
    assert len(list((tmp_path / "out").glob("*.parquet"))) == 3
    trial = read_recording_set(folder).trials[1]
    other = replace(trial, position=np.r_[trial.position[:1], 0 * trial.position[1:]])
    assert (model.predict(trial) == model.predict(other)).all()
    data = json.loads((tmp_path / "model.json").read_text())
    data["parameters"]["weather"] = 1.0
    (tmp_path / "model.json").write_text(json.dumps(data))
    with pytest.raises(ValueError, match=r"model\.json: parameters has no 'weather'"):
        ServoModel.load(tmp_path / "model.json")


def test_a_trial_without_its_servo_is_named(tmp_path: Path) -> None:
    folder = make_set(tmp_path / "set", plain, trials=3)
    header = json.loads((folder / "recording.json").read_text())
    del header["trials"][2]["servo"]
    (folder / "recording.json").write_text(json.dumps(header))
    with pytest.raises(ValueError, match=r"trial_0002\.parquet: a servo with a known load needs"):
        Bench.of(read_recording_set(folder))


@pytest.mark.parametrize(("error", "winner"), [(1.0, -1), (0.99, -1), (0.97, 0)])
def test_a_law_that_contains_another_is_no_rival_of_it_unless_it_predicts_better(
    error: float, winner: int
) -> None:
    forms = {item.cause: item for item in candidates.CATALOGUE}
    problem = ServoProblem(bench_of(np.zeros((5, 3)), np.array(GAINS), np.zeros(3)))
    now = SimpleNamespace(errors=np.ones((3, 1)))
    rival = SimpleNamespace(
        cause="load_friction", candidate=forms["directional_friction"], errors=np.full((3, 1), error)
    )
    assert problem.settles(rival, now, 0) == winner
    rival.candidate = forms["quadratic_friction"]
    assert problem.settles(rival, now, 0) == 0


def test_thinned_frames_are_apart_and_those_that_were_recorded() -> None:
    gain, command = np.array(GAINS), commands(3, np.random.default_rng(1))
    bench = bench_of(command, gain, np.zeros(3))
    bench.valid[200:, 1] = False
    thin = bench.thinned(0.01)
    assert (np.diff(thin.time_s[:, 0]) >= 0.01 - 1e-9).all()
    assert thin.valid.sum(0).tolist() == [160, 100, 160]
    assert np.isin(thin.command[:, 2], command[:, 2]).all()


def one_sided(motor: Array, load: Array, speed: Array) -> Array:
    """Larger in one direction than in the other, as no law of the catalogue is."""
    return plain(motor, load, speed) * (1 + 0.4 * np.sign(speed))


@pytest.mark.parametrize(("law", "left"), [(plain, False), (one_sided, True)])
def test_what_repeats_with_the_command_is_an_alarm(tmp_path: Path, law: Law, left: bool) -> None:
    folder = make_set(tmp_path / "set", law, seed=5, replicates=2)
    problem = ServoProblem.of(Bench.of(read_recording_set(folder)))
    fitted = problem.baseline()
    now = SimpleNamespace(fit=fitted, baseline=fitted, chosen={}, p_values={}, causes=lambda: {"any": (0,)})
    alarms = raise_alarms(now, problem.suspicions(now, 0), 0)
    assert bool(alarms) == left
    assert all("repeats when the command is repeated" in alarm.clue for alarm in alarms)


def test_commands_that_come_once_say_nothing_about_what_is_left(tmp_path: Path) -> None:
    problem = ServoProblem.of(Bench.of(read_recording_set(make_set(tmp_path / "set", one_sided))))
    assert problem.suspicions(None, 0) == []


@pytest.mark.slow
def test_of_few_runs_none_is_locked_and_a_law_is_found(tmp_path: Path) -> None:
    found = diagnose(make_set(tmp_path / "set", LAWS["M3"][1], trials=8))
    assert [cause.name for cause in found.verdict.causes] == ["load_friction"]
    assert found.verdict.heldout is None
    assert found.verdict.causes[0].heldout_gain is None
    assert found.traces == found.trial_errors == ()


@pytest.mark.slow
def test_what_only_coulomb_and_viscous_friction_hold_back_is_adequate(tmp_path: Path) -> None:
    found = diagnose(make_set(tmp_path / "set", plain))
    assert found.verdict.status == "adequate"
    assert found.verdict.heldout is not None
    assert found.verdict.heldout.extended < 5e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cause", "parameter", "size", "law"),
    [
        ("load_friction", "load_friction", 0.2, LAWS["M3"][1]),
        ("stribeck_friction", "stiction", 0.06, lambda m, q, v: plain(m, q, v) + 0.06 * at_rest(v, 0.4)),
    ],
)
def test_a_hidden_law_is_named_and_sized(
    tmp_path: Path, cause: str, parameter: str, size: float, law: Law
) -> None:
    found = diagnose(make_set(tmp_path / "set", law))
    assert found.verdict.heldout is not None
    assert found.verdict.heldout.gain > 0.8
    named = {item.name: item for item in found.verdict.causes}
    assert cause in named
    value = named[cause].params[parameter]
    assert value.value == pytest.approx(size, rel=0.3)


@pytest.mark.slow
def test_a_law_outside_the_catalogue_is_unexplained(tmp_path: Path) -> None:
    found = diagnose(make_set(tmp_path / "set", one_sided, trials=16, seed=7, replicates=2))
    assert found.verdict.status == "unexplained"
    assert found.verdict.unknown.alarm


@pytest.mark.slow
def test_a_real_servo_lacks_friction_that_grows_with_its_load(tmp_path: Path) -> None:
    data = Path(__file__).parents[1] / "data" / "bam_xl330.npz"
    import_dataset(ImportConfig(data, recording_dir=tmp_path / "set"))
    found = diagnose(tmp_path / "set")
    assert found.verdict.heldout is not None
    assert found.verdict.heldout.gain > 0.5
    assert found.verdict.status == "ambiguous", "BAM's M5 and M6 predict alike"
    assert ["directional_friction", "quadratic_friction"] in map(list, found.verdict.ambiguous_with)
