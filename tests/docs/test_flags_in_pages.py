"""Pages give this package's commands flags that they have."""

import contextlib
import importlib
import io
import re
import sys
import tomllib
from pathlib import Path

import pytest
from command_uses import uses

from lerobot_vtrefine.cli.checks import PLUGINS
from lerobot_vtrefine.cli.flags import flags_of

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
SHARED = (
    ("lerobot_vtrefine.envs.config", "VtRefineEnvConfig", "env."),
    ("lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3", "VtDp3Config", "policy."),
    ("lerobot_vtrefine.finetune.config", "DppoConfig", "dppo."),
    ("lerobot_vtrefine.sim.demonstrations", "Degradation", "degradation."),
)
"""Configurations whose fields commands take, and do not list."""
ALWAYS = {"--help", "--env.type", *PLUGINS}
COMMAND = r"(vtrefine(?:-[a-z-]+)?)"


def test_uses_are_found() -> None:
    text = (
        "`vtrefine-a --b=1`\n```bash\nvtrefine-c --d.e=1 \\\n    --f && make g  # --h\n```\n`lerobot-x --y`"
    )
    assert uses(text, COMMAND) == [("vtrefine-a", ["--b"]), ("vtrefine-c", ["--d.e", "--f"])]


def help_of(target: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """What a command's ``--help`` prints."""
    module, function = target.split(":")
    monkeypatch.setattr(sys, "argv", ["command", "--help"])
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        getattr(importlib.import_module(module), function)()
    return text.getvalue()


def test_flags_that_pages_give_to_commands_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    listed = {
        name: set(re.findall(r"--[\w.]+", help_of(target, monkeypatch))) for name, target in scripts.items()
    }
    shared = {f"--{flag.name}" for config in SHARED for flag in flags_of(*config, nested=True)} | ALWAYS
    wrong, checked = [], 0
    for page in PAGES:
        for name, flags in uses(page.read_text(encoding="utf-8"), COMMAND):
            wrong += [f"{page.name}: {name} {flag}" for flag in flags if flag not in listed[name] | shared]
            checked += len(flags)
    assert wrong == []
    assert checked > 200
