"""``vtrefine``: list this project's commands, or run one of them.

examples:
  vtrefine-play                   # a good start: a trained policy, live in a browser
  vtrefine-demo --quick           # the whole chain with tiny numbers: record, imitate, improve, evaluate
  vtrefine configs                # names that --config_path=vtrefine:NAME takes
  vtrefine diagnose --help        # the same as vtrefine-diagnose --help
"""

import sys
from importlib.metadata import EntryPoint, distribution

from lerobot_vtrefine.choices import did_you_mean
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.flags import describe_module
from lerobot_vtrefine.shipped import PREFIX, names

DISTRIBUTION = "lerobot_policy_vtrefine"
COMMAND = "vtrefine-"
KINDS_OF_FILES = {
    "env": "tasks: --config_path= of lerobot-eval and of vtrefine-record-demos, -finetune, -play, -demo",
    "policy": "policies: --config_path= of lerobot-train",
}
"""Folders of configuration files, and who reads them."""
STOCK = """\
Recording on robots, training and evaluation are LeRobot's own commands:
  lerobot-record, lerobot-teleoperate, lerobot-rollout    --robot.type=aloha_tactile_follower
  lerobot-train                                           --policy.type=vt_dp3
  lerobot-eval                                            --env.type=vtrefine"""


def commands() -> dict[str, EntryPoint]:
    """Every other command of the installed distribution, by its name without ``vtrefine-``."""
    found = distribution(DISTRIBUTION).entry_points.select(group="console_scripts")
    return {e.name.removeprefix(COMMAND): e for e in sorted(found, key=lambda e: e.name) if COMMAND in e.name}


def module_of(entry: EntryPoint) -> str:
    """The module whose docstring describes a command; those that start late are named as their function."""
    return f"{entry.module.rpartition('.')[0]}.{entry.attr}" if entry.attr != "main" else entry.module


def overview() -> str:
    """The list of commands, a sentence each."""
    sentence, examples = describe_module(__name__)
    rows = [f"  {COMMAND + name:<24} {describe_module(module_of(e))[0]}" for name, e in commands().items()]
    usage = "usage: vtrefine [--version | COMMAND [FLAGS ...]]"
    return "\n".join([usage, "", sentence, "", "commands:", *rows, "", STOCK, "", examples])


def configurations() -> str:
    """Names of configuration files by their folder, and what their first line says."""
    lines = []
    for kind, title in KINDS_OF_FILES.items():
        lines += ["", title] if lines else [title]
        for name, path in names().items():
            if path.parent.name == kind:
                first = path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
                lines.append(f"  {PREFIX + name:<36} {first}")
    return "\n".join(lines)


def version() -> str:
    """Name and version of the installed distribution."""
    return f"{DISTRIBUTION} {distribution(DISTRIBUTION).version}"


ANSWERS = {"-h": overview, "--help": overview, "--version": version, "configs": configurations}
"""What is no command."""


@run_cli
def main() -> int:
    """Console entry point."""
    name, *rest = sys.argv[1:] or ["--help"]
    if name in ANSWERS:
        if rest:
            raise ValueError(f"vtrefine {name} takes nothing more, got {' '.join(rest)}")
        print(ANSWERS[name]())
        return 0
    known = commands()
    if name not in known:
        listed = ", ".join([*known, "configs"]) + did_you_mean(name, [*known, "configs"])
        raise ValueError(f"unknown command {name!r}; choose from {listed}")
    sys.argv = [COMMAND + name, *rest]
    return known[name].load()() or 0


if __name__ == "__main__":
    raise SystemExit(main())
