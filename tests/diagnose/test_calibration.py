"""Calibration against pads made by an independent generator, and what it refuses."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hidden.session import Spec, run_session
from hidden.writer import write_set

from lerobot_vtrefine.diagnose.calibration import Calibration, Wanted, calibrate
from lerobot_vtrefine.diagnose.pad.prediction import predict_trial
from lerobot_vtrefine.diagnose.recordings import RecordingSet, read_recording_set
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel


def recorded(folder: Path, seed: int = 1, rig: str = "1x1", **options: Any) -> RecordingSet:
    write_set(folder, Spec(rig=rig, **options), seed)
    return read_recording_set(folder)


def truth(seed: int, rig: str = "1x1") -> dict[str, float]:
    pad = run_session(Spec(rig=rig), seed)[0].pad
    return {"k_n": pad.k_n, "k_d": pad.k_d, "gain": pad.gain}


def holds(calibration: Calibration, name: str, true: float, within: float) -> bool:
    """Whether a parameter is near the truth, and its interval not far from it."""
    item = calibration.parameters[name]
    assert item.ci95 is not None
    low, high = item.ci95
    slack = 0.5 * (high - low)
    return abs(item.value / true - 1) < within and low - slack <= true <= high + slack


@pytest.mark.parametrize("seed", [1, 12])
def test_parameters_of_a_single_taxel_come_back(tmp_path: Path, seed: int) -> None:
    calibration = calibrate(recorded(tmp_path / "set", seed), Wanted())
    true = truth(seed)
    assert holds(calibration, "k_n", true["k_n"], 0.02)
    assert holds(calibration, "gain", true["gain"], 0.02)
    assert holds(calibration, "k_d", true["k_d"], 0.25)
    assert "knee_counts" not in calibration.parameters
    assert calibration.explained > 0.99


def test_a_saturation_is_found_with_its_knee(tmp_path: Path) -> None:
    spec = Spec(rig="1x1", effects=(("saturation", "tanh", 1.0),))
    hidden = write_set(tmp_path / "set", spec, 1).params["saturation"]["knee_counts"]
    calibration = calibrate(read_recording_set(tmp_path / "set"), Wanted())
    assert calibration.saturation_p is not None
    assert calibration.saturation_p < 0.01
    assert calibration.parameters["knee_counts"].value == pytest.approx(hidden, rel=0.06)
    assert calibration.model.find("saturation") is not None
    assert holds(calibration, "gain", truth(1)["gain"], 0.02)


def test_intervals_widen_with_fewer_recordings(tmp_path: Path) -> None:
    from dataclasses import replace

    recordings = recorded(tmp_path / "set", 2)
    many = calibrate(recordings, Wanted()).parameters["k_n"].ci95
    few = calibrate(replace(recordings, trials=recordings.trials[:6]), Wanted()).parameters["k_n"].ci95
    assert many is not None
    assert few is not None
    assert few[1] - few[0] > 1.3 * (many[1] - many[0])


def test_known_stiffness_stands_in_for_the_load_cell(tmp_path: Path) -> None:
    recordings = recorded(tmp_path / "set", 4, changes=(("drive", "depth"),))
    with pytest.raises(
        ValueError, match=r"without force_n only the product gain . k_n follows: .* --k_n=VALUE"
    ):
        calibrate(recordings, Wanted())
    calibration = calibrate(recordings, Wanted(k_n=300.0))
    assert calibration.parameters["k_n"].value == 300.0
    assert calibration.parameters["k_n"].ci95 is None
    true = truth(4)
    product = calibration.parameters["gain"].value * 300.0
    assert product == pytest.approx(true["gain"] * true["k_n"], rel=0.02)


def test_load_alone_gives_the_readout_only(tmp_path: Path) -> None:
    recordings = recorded(tmp_path / "set", 3, rig="1x1_force")
    with pytest.raises(ValueError, match="without depth_m the model's output is the load itself"):
        calibrate(recordings, Wanted())
    calibration = calibrate(recordings, Wanted(readout_only=True))
    assert set(calibration.parameters) == {"gain", "idle_mean", "noise_sigma"}
    assert holds(calibration, "gain", truth(3, "1x1_force")["gain"], 0.02)
    assert calibration.model.contact.name == "consistent"


def test_one_depth_and_one_speed_are_refused(tmp_path: Path) -> None:
    recordings = recorded(tmp_path / "set", 5, protocol="monotone", rig="4x4", changes=(("drive", "both"),))
    with pytest.raises(ValueError, match="cannot be calibrated from") as refused:
        calibrate(recordings, Wanted())
    text = str(refused.value)
    assert "record at least three depths" in text
    assert "k_d is not identifiable: record some at a third and some at three times that speed" in text
    assert "\n" not in text
    with pytest.raises(ValueError, match="three depths") as refused:
        calibrate(recordings, Wanted(static=True))
    assert "k_d" not in str(refused.value)


def test_too_few_recordings_and_other_kinds_are_refused(tmp_path: Path) -> None:
    from dataclasses import replace

    recordings = recorded(tmp_path / "set", 6)
    with pytest.raises(ValueError, match="no uncertainty from 3 usable recordings: record at least 4"):
        calibrate(replace(recordings, trials=recordings.trials[:3]), Wanted())
    lifted = [replace(trial, depth_m=trial.depth_m - 0.01) for trial in recordings.trials]
    with pytest.raises(ValueError, match=r"never touches the pad|no usable recording"):
        calibrate(replace(recordings, trials=tuple(lifted)), Wanted())
    with pytest.raises(ValueError, match='needs presses of a pad, not "robot"'):
        calibrate(replace(recordings, kind="robot"), Wanted())


def test_both_contact_stages_predict_the_same(tmp_path: Path) -> None:
    recordings = recorded(tmp_path / "set", 7)
    models = [calibrate(recordings, Wanted(contact=name)).model for name in ("kelvin_voigt", "consistent")]
    assert [model.contact.name for model in models] == ["kelvin_voigt", "consistent"]
    layout = PadLayout(1, 1, recordings.pitch_m)
    one, other = (predict_trial(model, recordings.trials[0], layout) for model in models)
    np.testing.assert_allclose(one, other, atol=0.02)
    assert np.ptp(one) > 20


def test_static_model_has_no_damping(tmp_path: Path) -> None:
    calibration = calibrate(recorded(tmp_path / "set", 8), Wanted(static=True))
    assert calibration.parameters["k_d"].value == 0.0
    assert getattr(calibration.model.contact, "k_d", None) == 0.0


def test_the_simulation_loads_the_model_of_a_pad_of_another_shape(tmp_path: Path) -> None:
    from lerobot_vtrefine.diagnose.calibration.page import remarks
    from lerobot_vtrefine.sim.config import SceneConfig
    from lerobot_vtrefine.sim.simulation import InsertionSim

    calibration = calibrate(recorded(tmp_path / "set", 10, rig="4x4", changes=(("drive", "both"),)), Wanted())
    assert "The pad has 4 x 4 taxels" in " ".join(remarks(calibration))
    sim = InsertionSim(SceneConfig(start="grasped"), sensor=calibration.model)
    sim.reset(np.zeros(1, np.int64), np.array([0]))
    seen = sim.observe()["tactile_baseline"]
    level = calibration.presses.idle.level
    assert float(seen.mean()) == pytest.approx(level.mean(), abs=1.5)
    assert float(seen.std()) == pytest.approx(level.std(), rel=0.2)


def test_the_simulation_loads_the_model(tmp_path: Path) -> None:
    from lerobot_vtrefine.sim.config import SceneConfig
    from lerobot_vtrefine.sim.simulation import InsertionSim

    calibration = calibrate(recorded(tmp_path / "set", 9), Wanted(contact="consistent"))
    path = tmp_path / "sensor_model.json"
    calibration.model.save(path)
    assert SensorModel.load(path).to_dict() == calibration.model.to_dict()
    sim = InsertionSim(SceneConfig(start="grasped"), sensor=str(path))
    sim.reset(np.zeros(1, np.int64), np.array([0]))
    seen = sim.observe()
    idle = calibration.presses.idle.level.mean()
    assert abs(float(seen["tactile_baseline"].mean()) - idle) < 1.0
    above = seen["tactile"].astype(int) - seen["tactile_baseline"].astype(int)
    assert (above[0].max(axis=1) > 20).all()  # all four pads hold a part


@pytest.mark.parametrize(("options", "message"), [({"k_n": 0.0}, "--k_n"), ({"contact": "x"}, "--contact=x")])
def test_wrong_wishes(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Wanted(**options)
