"""Public formats: schemas say what readers check, the pages name every field, and the template is sound."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from pad_sets import make_set, write_set
from test_verdict import EXPLAINED

from lerobot_vtrefine.cli.diagnose import main
from lerobot_vtrefine.diagnose.formats import FORMATS, PAD_COLUMNS, ROBOT_COLUMNS, schema_of
from lerobot_vtrefine.diagnose.joints.model import RobotModel
from lerobot_vtrefine.diagnose.quality import check_quality
from lerobot_vtrefine.diagnose.recordings import read_recording_set
from lerobot_vtrefine.diagnose.servo.model import ServoModel
from lerobot_vtrefine.diagnose.servo.parameters import LIMITS
from lerobot_vtrefine.diagnose.template import write_template
from lerobot_vtrefine.diagnose.verdict import CAUSES, Verdict
from lerobot_vtrefine.sim.reality import load_reality
from lerobot_vtrefine.tactile.model import SensorModel

jsonschema = pytest.importorskip("jsonschema")
ROOT = Path(__file__).parents[2]
SHIPPED = ROOT / "lerobot_vtrefine" / "diagnose" / "schemas"


def errors(name: str, data: object) -> list[str]:
    validator = jsonschema.Draft202012Validator(schema_of(name))
    return [error.message for error in validator.iter_errors(json.loads(json.dumps(data)))]


@pytest.mark.parametrize("name", FORMATS)
def test_shipped_schemas_are_those_of_the_reading_code(name: str) -> None:
    shipped = json.loads((SHIPPED / f"{Path(name).stem}.schema.json").read_text())
    assert shipped == json.loads(json.dumps(schema_of(name)))
    jsonschema.Draft202012Validator.check_schema(shipped)


def test_what_is_written_fits_its_schema(tmp_path: Path) -> None:
    header, columns = make_set(trials=2)
    write_set(tmp_path / "set", header, columns)
    assert errors("recording.json", header) == []
    assert errors("verdict.json", EXPLAINED.to_dict()) == []
    joint = RobotModel.default(("waist", "elbow")).joints[0]
    bent = RobotModel((replace(joint, encoder_offset=-0.1, laws={"flex": -0.2}),), 0.03)
    servo = ServoModel({name: item.start for name, item in LIMITS.items()})
    for model in (SensorModel.default(), SensorModel.paper(), bent, servo, ServoModel.default()):
        assert errors("sensor_model.json", model.to_dict()) == []
    reality = {"schema": "vtrefine/reality@1", "scene": {"clearance_m": 0.0015}}
    assert errors("reality.json", reality) == []


def broken_recording(folder: Path) -> None:
    header, columns = make_set(trials=2)
    header["pad"]["rows"] = "six"
    write_set(folder, header, columns)
    assert errors("recording.json", header)
    read_recording_set(folder)


def broken_verdict(folder: Path) -> None:
    data = json.loads(json.dumps(EXPLAINED.to_dict()))
    data["causes"][0]["p_value"] = 7.0
    assert errors("verdict.json", data)
    Verdict.from_dict(data)


def broken_model(folder: Path) -> None:
    data = SensorModel.paper().to_dict()
    data["stages"][0]["k_n"] = "stiff"
    assert errors("sensor_model.json", json.loads(json.dumps(data)))
    SensorModel.from_dict(data)


BROKEN_MODELS = [
    (RobotModel, ("joints", 0, "damping_ratio"), 0.0, r"joints\[0\]\.damping_ratio must be above 0"),
    (RobotModel, ("joints", 0, "encoder_offset"), -1e5, r"joints\[0\]\.encoder_offset must be at most"),
    (RobotModel, ("joints", 0, "laws"), {"cogging": 0.1}, r"joint 'waist' has no law 'cogging'; valid: flex"),
    (RobotModel, ("joints", 0, "sag_terms"), [0.1], r"joints\[0\]\.sag_terms must hold 4 values"),
    (RobotModel, ("joints",), [], 'a list "joints" of 1 to'),
    (ServoModel, ("parameters", "coulomb"), -0.1, r"parameters\.coulomb must not be negative"),
    (ServoModel, ("parameters", "delay"), 2.0, r"parameters\.delay must be at most 0.2"),
    (ServoModel, ("parameters", "weather"), 1.0, r"parameters has no 'weather'; valid: log_torque"),
    (ServoModel, ("parameters",), {}, r"parameters lacks 'log_torque'"),
]


@pytest.mark.parametrize(("kind", "place", "value", "message"), BROKEN_MODELS)
def test_models_of_robots_are_refused_by_schema_and_reader_alike(
    tmp_path: Path, kind, place: tuple, value: object, message: str
) -> None:
    sound = {RobotModel: RobotModel.default(("waist",)), ServoModel: ServoModel.default()}
    data = json.loads(json.dumps(sound[kind].to_dict()))
    assert errors("sensor_model.json", data) == []
    inner = data
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    path = tmp_path / "sensor_model.json"
    path.write_text(json.dumps(data))
    assert errors("sensor_model.json", data)
    with pytest.raises(ValueError, match=rf"sensor_model\.json: .*{message}"):
        kind.load(path)


def broken_reality(folder: Path) -> None:
    data = {"schema": "vtrefine/reality@1", "scene": {"part_friction": -1.0}}
    assert errors("reality.json", data)
    folder.mkdir()
    (folder / "reality.json").write_text(json.dumps(data))
    load_reality(folder / "reality.json")


@pytest.mark.parametrize(
    ("read", "field"),
    [
        (broken_recording, "pad.rows must be a whole number"),
        (broken_verdict, r"causes\[0\].p_value must be at most 1"),
        (broken_model, "kelvin_voigt.k_n must be a number"),
        (broken_reality, "scene.part_friction must be above 0"),
    ],
)
def test_readers_refuse_what_the_schema_refuses_and_name_the_field(tmp_path: Path, read, field: str) -> None:
    with pytest.raises(ValueError, match=field):
        read(tmp_path / "broken")


def test_a_verdict_of_a_later_version_is_read() -> None:
    data = json.loads(json.dumps(EXPLAINED.to_dict())) | {"weather": "fine"}
    assert errors("verdict.json", data) == []
    assert Verdict.from_dict(data) == EXPLAINED
    old = {key: value for key, value in data.items() if key != "not_tested"}
    assert Verdict.from_dict(old) == replace(EXPLAINED, not_tested={})


def test_the_pages_name_every_field_column_and_cause() -> None:
    recording, verdict = (
        (ROOT / "docs" / name).read_text() for name in ("recording-format.md", "verdict.md")
    )
    header = schema_of("recording.json")["properties"]
    asked = [*header, *header["trials"]["items"]["properties"], *PAD_COLUMNS, *ROBOT_COLUMNS]
    assert [name for name in asked if f"`{name}`" not in recording] == []
    fields = schema_of("verdict.json")["properties"]
    asked = [*fields, *fields["causes"]["items"]["properties"]]
    assert [name for name in asked if f'"{name}"' not in verdict] == []
    assert [name for name in CAUSES if f"`{name}`" not in verdict] == []
    for kind in schema_of("sensor_model.json")["oneOf"][1:]:
        inner = kind["properties"].get("joints", {}).get("items") or kind["properties"].get(
            "parameters", kind
        )
        asked = [*kind["properties"], *inner["properties"]]
        assert [name for name in asked if f"`{name}`" not in verdict] == []


def test_examples_on_the_pages_are_valid() -> None:
    for page, name in (("recording-format.md", "recording.json"), ("verdict.md", "verdict.json")):
        (example,) = re.findall(r"```json\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL)
        assert errors(name, json.loads(example)) == []
    Verdict.from_dict(json.loads(example))


def test_the_glossary_holds_twenty_words() -> None:
    words = re.findall(r"^- \*\*(.+?)\*\*:", (ROOT / "docs" / "glossary.md").read_text(), re.MULTILINE)
    assert len(words) == 20
    assert words == sorted(words)


def test_the_template_is_sound_and_shows_every_needed_column(tmp_path: Path) -> None:
    folder = write_template(tmp_path / "presses")
    recordings = read_recording_set(folder)
    sound, issues = check_quality(recordings)
    assert (len(sound.trials), issues) == (16, [])
    assert errors("recording.json", json.loads((folder / "recording.json").read_text())) == []
    assert set(pq.read_schema(folder / "trial_0000.parquet").names) <= set(PAD_COLUMNS)
    with pytest.raises(ValueError, match="holds something already"):
        write_template(folder)


def test_the_template_diagnoses_cleanly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main([f"--template={tmp_path / 'presses'}"])
    assert left.value.code == 0
    assert main([f"--recording={tmp_path / 'presses'}", f"--output_dir={tmp_path / 'out'}"]) == 0
    said = capsys.readouterr().out
    assert "adequate: The simulation is adequate" in said
    assert "would have shown: " in said
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    assert verdict["data_issues"] == []
    assert errors("verdict.json", verdict) == []


@pytest.mark.parametrize("flag", ["--help_format", "--help-format"])
def test_help_format_describes_and_prints_schemas(capsys: pytest.CaptureFixture[str], flag: str) -> None:
    with pytest.raises(SystemExit) as left:
        main([flag])
    assert left.value.code == 0
    assert all(name in capsys.readouterr().out for name in ("recording.json",))
    with pytest.raises(SystemExit):
        main(["--help_format=verdict.json"])
    assert json.loads(capsys.readouterr().out)["title"] == "verdict.json"
    assert main(["--help_format=weather.json"]) == 2
    assert "--help_format=weather.json is unknown; choose from recording.json" in capsys.readouterr().err
