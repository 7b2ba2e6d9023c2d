"""A cause of one's own, added as docs/own-cause.md says, is screened, named, reported and predicted."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from robot_rigs import Rig, make_set

import lerobot_vtrefine
from lerobot_vtrefine.diagnose.joints import candidates as joint_candidates
from lerobot_vtrefine.diagnose.pad import candidates
from lerobot_vtrefine.diagnose.servo import candidates as servo_candidates
from lerobot_vtrefine.diagnose.verdict import ROBOT_CAUSES, SENSOR_CAUSES

PACKAGE = Path(lerobot_vtrefine.__file__).parent
ROOT = Path(__file__).parents[2]

STAGE = '''

@register
@dataclass(frozen=True)
class ColumnSharing(Stage):
    """s_rc / (1 + k * sum_i s_ic): the taxels of a column load each other."""

    name: ClassVar[str] = "column_sharing"
    domain: ClassVar[str] = "counts"
    rank: ClassVar[int] = 57
    conductance_per_count: float = parameter(1e-3, "1/counts", 0.0, 5e-3)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        return x / (1.0 + self.conductance_per_count * x.sum(dim=-2, keepdim=True)), state
'''
CANDIDATE = '''"""column_sharing: a taxel's reading falls as others of its column are pressed."""

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Value
from lerobot_vtrefine.tactile.stages.readout import ColumnSharing

FORMS = (
    Form(
        "column_sharing",
        "divider",
        (Value("load", 0.0, 3.0, 2e-3),),  # times the largest reading; 0 is no effect; step of differences
        lambda v, s: (ColumnSharing(float(v[0]) / s.top_counts),),
        lambda v, s: {"conductance_per_count": (float(v[0]) / s.top_counts, "1/counts")},
        lambda s: [[0.05]],  # a small effect, for the screening
        possible=lambda s: s.touched_rows > 1,
    ),
)
'''
HIDDEN = {
    "schema": "vtrefine/reality@1",
    "sensor_model": {
        "schema": "vtrefine/sensor-model@1",
        "stages": [
            {"stage": "kelvin_voigt", "k_n": 400.0, "k_d": 1.2},
            {"stage": "gain", "counts_per_n": 500.0},
            {"stage": "column_sharing", "conductance_per_count": 3e-3},
            {"stage": "idle", "level_counts": 25.0, "spread_counts": 10.0},
            {"stage": "noise", "sigma_counts": 1.0},
            {"stage": "quantisation"},
        ],
    },
}


JOINT_STAGE, JOINT_CANDIDATE = re.findall(
    r"```python\n(.*?)```", (ROOT / "docs" / "diagnosis-method.md").read_text(encoding="utf-8"), re.DOTALL
)
COGGING_RAD = 0.008


def test_every_file_of_the_catalogue_is_asked_about() -> None:
    files = {path.stem for path in (PACKAGE / "diagnose" / "pad" / "candidates").glob("*.py")} - {
        "__init__",
        "base",
    }
    families = {form.family for form in candidates.CATALOGUE}
    assert families == files == set(SENSOR_CAUSES) - {"taxel_gain_spread", "dead_taxels"}
    assert all(candidates.MEANING[name] for name in files)


def test_every_file_of_the_joints_catalogue_is_asked_about() -> None:
    folder = PACKAGE / "diagnose" / "joints" / "candidates"
    files = {path.stem for path in folder.glob("*.py")} - {"__init__", "base", "decoys"}
    assert set(joint_candidates.NAMES) == files == set(ROBOT_CAUSES)
    assert {item.cause for item in joint_candidates.CATALOGUE if not item.clue} == files
    assert all(joint_candidates.MEANING[name] for name in files)


NAMED_ELSEWHERE = {
    "verdict.py": "the public list of names",
    "report/words.py": "titles",
    "report/effects.py": "drawings",
    "joints/experiments.py": "what slow recordings cannot show",
    "joints/model.py": "fields of the file, which have names of their own",
    "pad/coincidence.py": "two that would be each other by a coincidence alone",
    "pad/detectable.py": "a period is no size that grows",
    "pad/final_model.py": "frames that repeat",
    "pad/idle_level.py": "idle levels are learnt without their drift",
    "pad/screening.py": "what is seen in the readings themselves, and touches",
}
"""Files outside of the catalogues that name a cause, and why."""


def test_what_holds_for_a_cause_stands_in_its_own_file() -> None:
    """Elsewhere a cause is asked for by what its candidate says of it, so that a new one needs no list."""
    names = {*candidates.PLAIN, *joint_candidates.NAMES, *servo_candidates.NAMES}
    folder = PACKAGE / "diagnose"
    found = {
        str(path.relative_to(folder))
        for path in folder.rglob("*.py")
        if "candidates" not in path.parts
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and node.value in names and not path.match("servo/stages.py")
    }
    assert found == set(NAMED_ELSEWHERE)


def run(script: str, folder: Path) -> str:
    """What a script prints that imports the package from a folder, and is run there."""
    env = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_a_joints_cause_of_ones_own_is_named_reported_and_predicted(tmp_path: Path) -> None:
    copy = tmp_path / "lerobot_vtrefine"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("assets"))
    with (copy / "diagnose" / "joints" / "stages.py").open("a", encoding="utf-8") as file:
        file.write("\n\n" + JOINT_STAGE)
    (copy / "diagnose" / "joints" / "candidates" / "cogging.py").write_text(JOINT_CANDIDATE, encoding="utf-8")
    rig = Rig(joints=("elbow",), rate_hz=20.0, seconds=5.0, conditions=8, noise=0.5)
    folder = make_set(rig, tmp_path / "moves", 0)
    for path in folder.glob("*.parquet"):
        table = pq.read_table(path)
        q = np.array(table["position"].to_pylist())
        cogged = pa.array((q + COGGING_RAD * np.sin(8 * q)).tolist())
        pq.write_table(table.set_column(table.column_names.index("position"), "position", cogged), path)
    script = (
        "from lerobot_vtrefine.cli import diagnose, predict\n"
        "diagnose.main(['--recording=moves', '--output_dir=out'])\n"
        "predict.main(['--recording=moves', '--sensor_model=out/sensor_model.json', '--output_dir=p'])"
    )
    assert "explained: The simulation lacks cogging." in run(script, tmp_path)
    (cause,) = json.loads((tmp_path / "out" / "verdict.json").read_text())["causes"]
    size = cause["params"]["elbow_rad"]
    assert size["value"] == pytest.approx(COGGING_RAD, rel=0.05)
    assert size["ci95"][0] <= COGGING_RAD <= size["ci95"][1]
    assert "Magnets pull a joint" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert len(list((tmp_path / "p").glob("*.parquet"))) == 16


def test_a_cause_of_ones_own_is_named_reported_and_predicted(tmp_path: Path) -> None:
    copy = tmp_path / "lerobot_vtrefine"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("assets"))
    with (copy / "tactile" / "stages" / "readout.py").open("a", encoding="utf-8") as file:
        file.write(STAGE)
    (copy / "diagnose" / "pad" / "candidates" / "column_sharing.py").write_text(CANDIDATE, encoding="utf-8")
    (tmp_path / "reality.json").write_text(json.dumps(HIDDEN), encoding="utf-8")

    script = (
        "from lerobot_vtrefine.cli import diagnose, predict, press\n"
        "press.main(['--reality=reality.json', '--output_dir=presses'])\n"
        "diagnose.main(['--recording=presses', '--output_dir=out'])\n"
        "predict.main(['--recording=presses', '--sensor_model=out/sensor_model.json', '--output_dir=p'])"
    )
    said = run(script, tmp_path)
    assert "explained: The simulation lacks column sharing." in said
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    (cause,) = verdict["causes"]
    low, high = cause["params"]["conductance_per_count"]["ci95"]
    assert low <= 3e-3 <= high
    assert verdict["heldout"]["gain"] > 0.8
    assert "A taxel&#39;s reading falls as others of its column are pressed" in (
        tmp_path / "out" / "report.html"
    ).read_text(encoding="utf-8")
    assert len(list((tmp_path / "p").glob("*.parquet"))) == 16
