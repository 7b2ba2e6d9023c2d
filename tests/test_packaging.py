"""The installed distribution: light import, registration through LeRobot's own discovery, entry points."""

import ast
import json
import os
import subprocess
import sys
import tomllib
from importlib.metadata import distribution
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
HEAVY = ("mujoco", "warp", "mujoco_warp", "matplotlib", "trimesh", "coacd", "datasets")

DISCOVER = """
import json
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.processor import ProcessorStepRegistry
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig
from lerobot.cameras import CameraConfig
print(json.dumps({
    "policies": list(PreTrainedConfig.get_known_choices()),
    "envs": list(EnvConfig.get_known_choices()),
    "steps": ProcessorStepRegistry.list(),
    "devices": [
        config.__module__
        for base in (RobotConfig, TeleoperatorConfig, CameraConfig)
        for config in base.get_known_choices().values()
    ],
}))
"""


def run_python(code: str, *arguments: str) -> str:
    environment = os.environ | {"HF_HUB_OFFLINE": "1"}
    result = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, env=environment, check=False
    )
    assert result.returncode == 0, result.stderr[-2000:]
    return result.stdout.strip().splitlines()[-1]


def test_import_is_light() -> None:
    """Nothing heavy is loaded beyond what LeRobot itself loads for a plugin."""
    code = (
        "import json, sys\n"
        "import lerobot.configs.policies, lerobot.envs.configs, lerobot.processor\n"
        "before = set(sys.modules)\n"
        "import lerobot_vtrefine\n"
        f"print(json.dumps([name for name in {HEAVY} if name in set(sys.modules) - before]))"
    )
    assert json.loads(run_python(code)) == []


def test_lerobot_discovers_every_type() -> None:
    found = json.loads(run_python(DISCOVER))
    assert "vt_dp3" in found["policies"]
    assert "vtrefine" in found["envs"]
    assert [step for step in found["steps"] if step.startswith("vt_")] != []
    ours = {module.split(".")[1] for module in found["devices"] if module.startswith("lerobot_vtrefine.")}
    assert ours == {"robots", "teleoperators", "cameras"}


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


HELP = """
import contextlib, importlib, io, json, sys
results = {}
for name, target in json.loads(sys.argv[1]).items():
    module, function = target.split(":")
    sys.argv = [name, "--help"]
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        try:
            status = getattr(importlib.import_module(module), function)()
        except SystemExit as stop:
            status = stop.code
    results[name] = [status or 0, text.getvalue()]
print(json.dumps(results))
"""


def test_every_entry_point_shows_help() -> None:
    """One process for all of them: importing PyTorch and LeRobot takes most of the time."""
    results = json.loads(run_python(HELP, json.dumps(PROJECT["scripts"])))
    assert {name: status for name, (status, _) in results.items() if status != 0} == {}
    assert [name for name, (_, text) in results.items() if "usage:" not in text] == []
