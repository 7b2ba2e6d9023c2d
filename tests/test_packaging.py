"""The installed distribution: light import, registration through LeRobot's own discovery, entry points."""

import ast
import json
import os
import subprocess
import sys
import tomllib
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
HEAVY = ("mujoco", "warp", "mujoco_warp", "matplotlib", "trimesh", "coacd", "datasets")

LIGHT = """
import json, sys
import lerobot.configs.policies, lerobot.envs.configs, lerobot.processor
before = set(sys.modules)
import lerobot_vtrefine
print(json.dumps([name for name in json.loads(sys.argv[1]) if name in set(sys.modules) - before]))
"""

# One process for both: importing PyTorch and LeRobot takes most of the time.
DISCOVER_AND_HELP = """
import contextlib, importlib, io, json, sys
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.cameras import CameraConfig
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.processor import ProcessorStepRegistry
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig

found = {
    "policies": list(PreTrainedConfig.get_known_choices()),
    "envs": list(EnvConfig.get_known_choices()),
    "steps": ProcessorStepRegistry.list(),
    "devices": [
        config.__module__
        for base in (RobotConfig, TeleoperatorConfig, CameraConfig)
        for config in base.get_known_choices().values()
    ],
}
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
print(json.dumps([found, help_texts]))
"""


def run_python(code: str, argument: Any) -> Any:
    command = [sys.executable, "-c", code, json.dumps(argument)]
    environment = os.environ | {"HF_HUB_OFFLINE": "1"}
    result = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    return json.loads(result.stdout.strip().splitlines()[-1])


@pytest.fixture(scope="module")
def installed() -> Any:
    """What LeRobot's discovery finds, and (status, text) of every entry point's help."""
    return run_python(DISCOVER_AND_HELP, PROJECT["scripts"])


def test_import_is_light() -> None:
    """Nothing heavy is loaded beyond what LeRobot itself loads for a plugin."""
    assert run_python(LIGHT, HEAVY) == []


def test_lerobot_discovers_every_type(installed: Any) -> None:
    found, _ = installed
    assert "vt_dp3" in found["policies"]
    assert "vtrefine" in found["envs"]
    assert [step for step in found["steps"] if step.startswith("vt_")] != []
    ours = {module.split(".")[1] for module in found["devices"] if module.startswith("lerobot_vtrefine.")}
    assert ours == {"robots", "teleoperators", "cameras"}


def test_every_entry_point_shows_help(installed: Any) -> None:
    _, help_texts = installed
    assert {name: status for name, (status, _) in help_texts.items() if status != 0} == {}
    assert [name for name, (_, text) in help_texts.items() if "usage:" not in text] == []


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
    assert function in [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
