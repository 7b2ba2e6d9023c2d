"""The sensor model: order, files, and names that are wrong."""

import json
from pathlib import Path

import pytest

from lerobot_vtrefine.diagnose.verdict import SENSOR_CAUSES
from lerobot_vtrefine.tactile import SensorModel
from lerobot_vtrefine.tactile.stages.base import STAGES
from lerobot_vtrefine.tactile.stages.contact import Consistent, KelvinVoigt
from lerobot_vtrefine.tactile.stages.hysteresis import Hysteresis
from lerobot_vtrefine.tactile.stages.readout import Crosstalk, Gain, Quantisation


def with_everything() -> SensorModel:
    model = SensorModel.default()
    for cls in STAGES.values():
        if cls.domain not in ("contact", "gain"):
            model = model.with_stage(cls())
    return model


def test_every_named_cause_is_a_stage() -> None:
    assert set(SENSOR_CAUSES) <= set(STAGES)


def test_paper_is_the_papers_law_alone() -> None:
    model = SensorModel.paper()
    assert [stage.name for stage in model.stages] == ["kelvin_voigt", "gain", "quantisation"]
    assert model.contact == KelvinVoigt(k_n=1.0, k_d=3e-3)
    assert not model.has_state


def test_json_round_trip_of_all_stages(tmp_path: Path) -> None:
    model = with_everything()
    model.save(tmp_path / "sensor_model.json")
    assert SensorModel.load(tmp_path / "sensor_model.json") == model
    assert SensorModel.named(str(tmp_path / "sensor_model.json")) == model
    assert model.has_state


def test_stages_go_to_their_place_whatever_the_order_of_adding() -> None:
    one = SensorModel.default().with_stage(Hysteresis()).with_stage(Crosstalk())
    two = SensorModel.default().with_stage(Crosstalk()).with_stage(Hysteresis())
    assert one == two
    names = [stage.name for stage in one.stages]
    assert (
        names.index("hysteresis")
        < names.index("gain")
        < names.index("crosstalk")
        < names.index("quantisation")
    )


def test_replacing_and_removing() -> None:
    model = SensorModel.default().with_stage(KelvinVoigt(k_n=5.0)).with_stage(Gain(counts_per_n=7.0))
    assert model.contact == KelvinVoigt(k_n=5.0)
    assert model.find("gain") == Gain(counts_per_n=7.0)
    assert model.without("noise").find("noise") is None
    assert model.find("crosstalk") is None


def test_unknown_names_list_the_valid_ones(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"unknown stage 'hysterisis'; valid names: .*hysteresis.*"):
        SensorModel.default().find("hysterisis")
    data = SensorModel.default().to_dict()
    data["stages"][1]["gain"] = 3
    with pytest.raises(ValueError, match="stage 'gain' has no 'gain'; valid: counts_per_n"):
        SensorModel.from_dict(data)
    path = tmp_path / "broken.json"
    path.write_text(json.dumps({"schema": "other", "stages": []}))
    with pytest.raises(ValueError, match=r"broken.json: sensor model must hold"):
        SensorModel.load(path)
    with pytest.raises(FileNotFoundError, match="neither a file nor one of default, paper"):
        SensorModel.named("papr")


def test_impossible_models_are_refused() -> None:
    with pytest.raises(ValueError, match="exactly one contact stage"):
        SensorModel((Gain(), Quantisation()))
    with pytest.raises(ValueError, match="repeats a stage"):
        SensorModel((Consistent(), Gain(), Gain()))
    with pytest.raises(ValueError, match="must go from depth to contact"):
        SensorModel((Gain(), Consistent()))


def test_ranges_name_every_parameter_that_can_be_randomised() -> None:
    ranges = with_everything().ranges()
    assert ranges["row_sharing.conductance_per_count"][1] > 0
    assert {"consistent.foundation_n_per_m3", "hysteresis.width_m", "latency.tau_s"} <= set(ranges)


@pytest.mark.parametrize(
    ("loop", "name"),
    [
        ("even", "hysteresis"),
        ("resting", "resting_hysteresis"),
        ("behind", "loading_hysteresis"),
        ("scaled", "proportional_hysteresis"),
        ("peak", "peak_hysteresis"),
    ],
)
def test_files_of_the_one_hysteresis_stage_are_read(loop: str, name: str) -> None:
    data = SensorModel.paper().with_stage(Hysteresis(0.2, 3e-4)).to_dict()
    old = next(item for item in data["stages"] if item["stage"] == "hysteresis")
    old["loop"] = loop
    stage = SensorModel.from_dict(data).find(name)
    assert stage is not None
    assert stage.fraction == 0.2
    assert getattr(stage, "width_m", 3e-4) == 3e-4


def test_a_loop_that_never_was_is_refused() -> None:
    data = SensorModel.paper().with_stage(Hysteresis(0.2, 3e-4)).to_dict()
    next(item for item in data["stages"] if item["stage"] == "hysteresis")["loop"] = "round"
    with pytest.raises(ValueError, match=r"hysteresis\.loop must be one of even, .*, got 'round'"):
        SensorModel.from_dict(data)
