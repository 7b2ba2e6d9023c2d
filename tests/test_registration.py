"""Importing the package loads neither LeRobot nor PyTorch, and `register` registers all types."""

import json
import os
import subprocess
import sys
from typing import Any

import pytest
from loaded_process import LoadedProcess

FIRST_IMPORT = """
import json, sys

def found(first):
    import importlib, importlib.util
    if first == "by path":
        from lerobot.configs.parser import load_plugin
        load_plugin("lerobot_vtrefine")
    else:
        import lerobot_vtrefine
        assert "lerobot" not in sys.modules
        importlib.import_module(first)
        lerobot_vtrefine.register()
    import lerobot
    from lerobot.cameras import CameraConfig
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig
    from lerobot.processor import ProcessorStepRegistry
    from lerobot.robots import RobotConfig
    from lerobot.teleoperators import TeleoperatorConfig
    kinds = (CameraConfig, PreTrainedConfig, EnvConfig, RobotConfig, TeleoperatorConfig)
    ours = lambda choices: [key for key, value in choices.items() if "vtrefine" in value.__module__]
    types = {kind.__name__: ours(kind.get_known_choices()) for kind in kinds}
    return types | {"steps": [name for name in ProcessorStepRegistry.list() if name.startswith("vt_")],
                    "version": lerobot.__version__}

print(json.dumps(found(sys.argv[1])))
"""

CASES = (
    "by path",  # --policy.discover_packages_path=lerobot_vtrefine, LeRobot first
    "lerobot.processor",
    "lerobot.scripts.lerobot_train",
    "lerobot.scripts.lerobot_eval",
    "lerobot_vtrefine.cameras.config_flexitac_camera",
    "lerobot_vtrefine.envs.config",
    "lerobot_vtrefine.robots.config_aloha_tactile_follower",
    "lerobot_vtrefine.policies.vt_dp3.processor_vt_dp3",
    "lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3",
    "lerobot_vtrefine.envs.demo_dataset",
)

EXPECTED = {
    "CameraConfig": {"flexitac"},
    "PreTrainedConfig": {"vt_dp3"},
    "EnvConfig": {"vtrefine"},
    "RobotConfig": {"tactile", "aloha_tactile_follower", "vtrefine_sim"},
    "TeleoperatorConfig": {"aloha_leader", "vtrefine_ee"},
    "steps": {"vt_visuo_tactile"},
}

LIGHT = """
import json, sys
import lerobot_vtrefine
print(json.dumps([name for name in ("lerobot", "torch", "numpy", "draccus") if name in sys.modules]))
"""

HELP = """
import contextlib, importlib, io, json, sys
for module in json.loads(sys.argv[1]):
    sys.argv = [module, "--help"]
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()) as shown:
        importlib.import_module(f"lerobot_vtrefine.cli.{module}").main()
    assert "usage:" in shown.getvalue(), module
print(json.dumps([name for name in ("lerobot", "torch", "mujoco", "warp") if name in sys.modules]))
"""
SHORT_COMMANDS = (
    "demo",
    "bench",
    "calibrate",
    "diagnose",
    "find_pads",
    "pad_emulator",
    "predict",
    "view_pads",
)  # the others parse LeRobot's own settings


def answer(code: str, *arguments: Any) -> Any:
    """What a fresh interpreter prints as JSON in its last line."""
    command = [sys.executable, "-c", code, *map(json.dumps, arguments)]
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    return json.loads(result.stdout.strip().splitlines()[-1])


def test_import_alone_loads_nothing() -> None:
    assert answer(LIGHT) == []


def test_help_of_short_commands_loads_neither_lerobot_nor_torch() -> None:
    assert answer(HELP, SHORT_COMMANDS) == []


@pytest.mark.parametrize("case", CASES)
def test_every_type_is_registered_whatever_is_imported_first(loaded: LoadedProcess, case: str) -> None:
    done = loaded.run(FIRST_IMPORT, case)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.strip().splitlines()[-1])
    assert found.pop("version")
    assert {key: set(values) for key, values in found.items()} == EXPECTED
