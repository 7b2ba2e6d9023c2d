"""The installed distribution: light import, registration through LeRobot's own discovery, entry points."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import EntryPoint, distribution
from pathlib import Path
from typing import Any

import pytest

from lerobot_vtrefine.cli.flags import describe_module
from lerobot_vtrefine.cli.umbrella import module_of

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
HEAVY = ("mujoco", "warp", "mujoco_warp", "matplotlib", "trimesh", "manifold3d", "datasets")

DISCOVER = """
import json, sys
import lerobot.configs.policies, lerobot.envs.configs, lerobot.processor
before = set(sys.modules)
import lerobot_vtrefine
heavy = [name for name in json.loads(sys.argv[1]) if name in set(sys.modules) - before]
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.cameras import CameraConfig
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.processor import ProcessorStepRegistry
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig

found = {
    "heavy": heavy,
    "policies": list(PreTrainedConfig.get_known_choices()),
    "envs": list(EnvConfig.get_known_choices()),
    "steps": ProcessorStepRegistry.list(),
    "devices": [
        config.__module__
        for base in (RobotConfig, TeleoperatorConfig, CameraConfig)
        for config in base.get_known_choices().values()
    ],
}
print(json.dumps(found))
import gc; gc.freeze()  # what was imported need not be looked through once more
"""

HELP = """
import contextlib, importlib, io, json, sys
help_texts = {}
for name, target in json.loads(sys.argv[1]).items():
    module, function = target.split(":")
    sys.argv = [name, "--help"]
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        try:
            status = getattr(importlib.import_module(module), function)()
        except SystemExit as stop:
            status = stop.code
    help_texts[name] = [status or 0, text.getvalue()]
heavy = [name for name in ("lerobot", "torch", "mujoco", "warp") if name in sys.modules]
print(json.dumps([help_texts, heavy]))
"""


def run_python(code: str, argument: Any) -> Any:
    command = [sys.executable, "-c", code, json.dumps(argument)]
    environment = os.environ | {"HF_HUB_OFFLINE": "1"}
    result = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    return json.loads(result.stdout.strip().splitlines()[-1])


def test_lerobot_discovers_every_type_of_a_light_package() -> None:
    """Importing it loads nothing heavy beyond what LeRobot itself loads for a plugin."""
    found = run_python(DISCOVER, HEAVY)
    assert found["heavy"] == []
    assert "vt_dp3" in found["policies"]
    assert "vtrefine" in found["envs"]
    assert [step for step in found["steps"] if step.startswith("vt_")] != []
    ours = {module.split(".")[1] for module in found["devices"] if module.startswith("lerobot_vtrefine.")}
    assert ours == {"robots", "teleoperators", "cameras"}


def test_every_entry_point_shows_help_at_once() -> None:
    """A sentence, an example, the flags; and without importing what takes seconds."""
    help_texts, heavy = run_python(HELP, PROJECT["scripts"])
    assert {name: status for name, (status, _) in help_texts.items() if status != 0} == {}
    assert [name for name, (_, text) in help_texts.items() if "usage:" not in text] == []
    assert [name for name, (_, text) in help_texts.items() if not re.search("^examples?:", text, re.M)] == []
    assert [name for name, (_, text) in help_texts.items() if f"\n  {name}" not in text] == []
    assert heavy == []


def test_every_command_is_described_in_one_sentence() -> None:
    for name, target in PROJECT["scripts"].items():
        entry = EntryPoint(name, target, "console_scripts")
        sentence, _ = describe_module(module_of(entry))
        assert sentence.endswith("."), name
        assert ". " not in sentence, name


def test_distribution_name_keeps_underscores() -> None:
    """LeRobot matches the raw name in METADATA by prefix."""
    installed = distribution("lerobot_policy_vtrefine")
    assert installed.metadata["Name"] == "lerobot_policy_vtrefine" == PROJECT["name"]
    assert installed.metadata["License-Expression"] == "Apache-2.0"


@pytest.mark.parametrize("name", sorted(PROJECT["scripts"]))
def test_entry_point_exists(name: str) -> None:
    module, function = PROJECT["scripts"][name].split(":")
    path = ROOT / Path(*module.split(".")).with_suffix(".py")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    made = [target for node in tree.body if isinstance(node, ast.Assign) for target in node.targets]
    names = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
    assert function in names + [target.id for target in made if isinstance(target, ast.Name)]


@pytest.mark.slow
def test_the_wheel_holds_configurations_and_pages(tmp_path: Path) -> None:
    uv = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
    if uv is None:
        pytest.skip("uv is not installed")
    subprocess.run(
        [uv, "build", "--wheel", "--out-dir", str(tmp_path), str(ROOT)], check=True, capture_output=True
    )
    (wheel,) = tmp_path.glob("*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    wanted = {f"lerobot_vtrefine/{path.relative_to(ROOT)}" for path in (ROOT / "configs").rglob("*.yaml")}
    wanted |= {str(path.relative_to(ROOT)) for path in (ROOT / "lerobot_vtrefine").rglob("*.html")}
    assert wanted - held == set()
    assert not [name for name in held if name.startswith(("tests", "scripts", "results"))]
