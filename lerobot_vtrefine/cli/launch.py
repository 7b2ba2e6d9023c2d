"""Entry points of the commands that need LeRobot: their help is printed before anything heavy is imported."""

import importlib
import sys
import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import yaml

from lerobot_vtrefine.cli.errors import config_files, run_cli
from lerobot_vtrefine.cli.flags import Flag, describe_module, flags_of

HELP_FLAGS = ("-h", "--help")
WIDTH = 100
INDENT = 30
WANTED = {"env": "say which task, --config_path=vtrefine:NAME or --env.type=vtrefine."}
"""What to give for a group of flags."""


def launch(command: str, module: str, config: str) -> int:
    """Show help, or run ``lerobot_vtrefine.cli.COMMAND``, whose flags are the fields of ``module.config``.

    Raises:
        ValueError: a flag is missing; told before LeRobot is imported, which takes ten seconds.
    """
    name = f"lerobot_vtrefine.cli.{command}"
    if set(HELP_FLAGS) & set(sys.argv[1:]):
        print(help_text(name, module, config))
        return 0
    check_required(flags_of(module, config), sys.argv[1:])
    if sys.stderr.isatty():
        print("loading LeRobot and PyTorch (the first time takes longest) ...", file=sys.stderr, flush=True)
    return importlib.import_module(name).main()


def entry_point(command: str, module: str, config: str) -> Callable[[], int]:
    """Console entry point of a command; its arguments are those of `launch`."""
    return run_cli(partial(launch, command, module, config))


demo = entry_point("demo", "lerobot_vtrefine.cli.pipeline.demo_config", "DemoConfig")
record_demos = entry_point("record_demos", "lerobot_vtrefine.cli.record_demos", "RecordDemosConfig")
finetune = entry_point("finetune", "lerobot_vtrefine.finetune.pipeline", "FinetunePipelineConfig")
information = entry_point("information", "lerobot_vtrefine.cli.information", "InformationConfig")
play = entry_point("play", "lerobot_vtrefine.cli.play", "PlayConfig")
bench = entry_point("bench", "lerobot_vtrefine.cli.bench", "BenchConfig")
import_dataset = entry_point("import_dataset", "lerobot_vtrefine.cli.import_dataset", "ImportConfig")
replay = entry_point("replay", "lerobot_vtrefine.cli.replay", "ReplayConfig")


def check_required(flags: Sequence[Flag], arguments: Sequence[str]) -> None:
    """Raises: ValueError naming the flags that neither the command line nor its configuration file gives."""
    given = {argument.partition("=")[0].removeprefix("--") for argument in arguments}
    for path in map(Path, config_files(arguments)):
        if not path.is_file():
            return  # LeRobot looks for it on the Hub, or says that there is none
        given |= set(yaml.safe_load(path.read_text(encoding="utf-8")) or ())
    missing = [flag for flag in flags if flag.required and not flag.is_among(given)]
    if missing:
        told = [WANTED.get(flag.name) or f"give --{flag.name}={flag.type}: {flag.text}" for flag in missing]
        raise ValueError(" ".join([*told, "--help has an example"]))


def help_text(command: str, module: str, config: str) -> str:
    """What the command does, an example, and its flags."""
    sentence, rest = describe_module(command)
    called = "vtrefine-" + command.rpartition(".")[2].removesuffix("_dataset").replace("_", "-")
    flags = flags_of(module, config)
    shown = [line for flag in flags for line in _lines(flag)]
    for flag in flags:
        if flag.group is not None:
            shown += ["", f"flags of --{flag.name}:"]
            shown += [line for inner in flags_of(*flag.group, f"{flag.name}.") for line in _lines(inner)]
    usage = f"usage: {called} [--config_path=FILE] [--FLAG=VALUE ...]"
    files = "FILE is a YAML file of flags; vtrefine:NAME takes one that comes with the package."
    return "\n".join([usage, "", sentence, "", rest, "", "flags:", *shown, "", files])


def _lines(flag: Flag) -> list[str]:
    head = f"  --{flag.name}.*" if flag.group is not None else f"  --{flag.name}={flag.type}"
    said = flag.text
    if flag.required:
        said = f"{said} (required)"
    elif flag.default:
        said = f"{said} (default: {flag.default})"
    wrapped = textwrap.wrap(said.strip().replace("``", ""), WIDTH - INDENT) or [""]
    if len(head) < INDENT - 1:
        return [f"{head:<{INDENT}}{wrapped[0]}".rstrip(), *(" " * INDENT + line for line in wrapped[1:])]
    return [head, *(" " * INDENT + line for line in wrapped if line)]
