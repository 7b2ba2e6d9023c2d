"""What mkdocs does beyond Markdown: navigation from the files there are, the command reference, notebooks.

The reference and the notebooks' pages are generated while the site is built, so they never lag behind.
"""

import contextlib
import html
import importlib
import io
import json
import sys
import tomllib
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SECTIONS: dict[str, tuple[str, ...]] = {
    "Start": ("index", "quickstart", "play"),
    "Concepts": (
        "task",
        "pads",
        "point-cloud",
        "policy",
        "dppo",
        "diagnosis",
        "diagnosis-method",
        "glossary",
    ),
    "How to": (
        "record-robot",
        "simulated-robot",
        "teleoperation",
        "calibrate",
        "replay-import",
        "view-data",
        "other-policies",
        "share",
        "gpu",
        "own-pad",
        "own-pair",
        "own-body",
        "own-cause",
    ),
    "Reference": ("commands", "settings", "recording-format", "verdict", "faq"),
    "Results": ("results", "learning", "paper-pairs", "learning-tried", "diagnosis-results"),
    "Notebooks": ("notebooks/environment", "notebooks/dataset", "notebooks/diagnosis"),
}
"""Pages by section, also those that may not be there yet; what is not named here comes under More."""
GENERATED = ("commands", "settings")
CONFIGS = (
    ("--env.*", "lerobot_vtrefine.envs.config", "VtRefineEnvConfig", "env."),
    ("--policy.*", "lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3", "VtDp3Config", "policy."),
    ("--dppo.*", "lerobot_vtrefine.finetune.config", "DppoConfig", "dppo."),
    ("--degradation.*", "lerobot_vtrefine.sim.demonstrations", "Degradation", "degradation."),
)


def on_config(config: Any) -> Any:
    """Navigation: every page there is, each once."""
    pages = {path.relative_to(DOCS).with_suffix("").as_posix() for path in DOCS.rglob("*.md")}
    pages |= {path.relative_to(DOCS).with_suffix("").as_posix() for path in DOCS.rglob("*.ipynb")}
    pages |= set(GENERATED)
    named = {page for section in SECTIONS.values() for page in section}
    sections = SECTIONS | {"More": tuple(sorted(pages - named))}
    shown = {name: [f"{page}.md" for page in wanted if page in pages] for name, wanted in sections.items()}
    config.nav = [{name: found} for name, found in shown.items() if found]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages."""
    pages = {"commands.md": commands_page(), "settings.md": settings_page()}
    for path in sorted(DOCS.rglob("*.ipynb")):
        pages[path.relative_to(DOCS).with_suffix(".md").as_posix()] = notebook_page(path)
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links to notebooks go to their pages."""
    return markdown.replace(".ipynb)", ".md)")


def commands_page() -> str:
    """Every command's help, as it is printed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    parts = [
        "# Commands",
        "What each command prints for `--help`. LeRobot's own commands are not repeated here.",
    ]
    for name, target in project["scripts"].items():
        module, function = target.split(":")
        parts += [f"## {name}", f"```text\n{help_of(name, module, function).rstrip()}\n```"]
    return "\n\n".join(parts)


def help_of(name: str, module: str, function: str) -> str:
    """What a command prints for ``--help``."""
    text, before = io.StringIO(), sys.argv
    sys.argv = [name, "--help"]
    try:
        with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
            getattr(importlib.import_module(module), function)()
    finally:
        sys.argv = before
    return text.getvalue()


def settings_page() -> str:
    """Every field of the configurations that commands share, read from their dataclasses."""
    from lerobot_vtrefine.cli.flags import flags_of

    parts = ["# Settings", "Flags that several commands share, with their defaults."]
    for title, module, name, prefix in CONFIGS:
        parts.append(f"## {title}")
        lines = []
        for flag in flags_of(module, name, prefix, nested=True):
            if flag.group is not None:
                continue
            default = f", default `{flag.default}`" if flag.default else ""
            text = html.escape(flag.text.replace("``", "`"), quote=False)
            lines.append(f"- `--{flag.name}` ({flag.type.replace('|', 'or')}{default}): {text}".rstrip(": "))
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def notebook_page(path: Path) -> str:
    """A notebook's text and code, with the file to download."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"]).strip()
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    return "\n\n".join([*parts, f"The notebook itself: `docs/notebooks/{path.name}`."])
