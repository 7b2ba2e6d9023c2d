"""What the demo's stages will parse from their flags, parsed before the first stage starts.

A misspelt or impossible value is then an error at once, not after minutes of recording and training.
"""

from collections.abc import Mapping
from typing import Any

import draccus
from draccus.utils import DraccusException
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig

from lerobot_vtrefine.cli.errors import describe
from lerobot_vtrefine.envs.config import VtRefineEnvConfig, checked_env
from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.sim.demonstrations import Degradation


def parse_policy(values: Mapping[str, Any]) -> VtDp3Config:
    """The policy of ``--policy.KEY=VALUE``. Raises: ValueError that names the flag."""
    parsed = _decode("policy", PreTrainedConfig, {"type": "vt_dp3", "device": "cpu"} | dict(values))
    if not isinstance(parsed, VtDp3Config):
        raise ValueError(f"--policy: the demo trains vt_dp3 policies, not {parsed.type}")
    return parsed


def parse_env(values: Mapping[str, Any]) -> VtRefineEnvConfig:
    """The environment of ``--env.KEY=VALUE``. Raises: ValueError that names the flag."""
    parsed = checked_env(_decode("env", EnvConfig, {"type": "vtrefine"} | dict(values)))
    _ = parsed.scene_config  # its own checks
    return parsed


def parse_dppo(values: Mapping[str, Any]) -> DppoConfig:
    """The settings of ``--dppo.KEY=VALUE``. Raises: ValueError that names the flag."""
    return _decode("dppo", DppoConfig, {"type": "paper"} | dict(values))


def parse_degradation(values: Mapping[str, Any]) -> Degradation:
    """The expert's errors of ``--degradation.KEY=VALUE``. Raises: ValueError that names the flag."""
    return _decode("degradation", Degradation, dict(values))


def _decode(flag: str, kind: type, values: dict[str, Any]) -> Any:
    try:
        return draccus.decode(kind, values)
    except (DraccusException, ValueError) as error:
        raise ValueError(f"--{flag}: {describe(error)}") from error
