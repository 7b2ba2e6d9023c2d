"""Entry points of the commands that need LeRobot: their help is printed before anything heavy is imported."""

import gc
import importlib
import sys
import textwrap
from collections.abc import Callable, Sequence
from functools import partial

from lerobot_vtrefine.choices import did_you_mean
from lerobot_vtrefine.cli.arguments import with_brackets
from lerobot_vtrefine.cli.checks import check_arguments
from lerobot_vtrefine.cli.errors import CONFIG_FLAG, run_cli
from lerobot_vtrefine.cli.flags import Flag, describe_module, flags_of
from lerobot_vtrefine.embodiments.menagerie import FLAG as LOOKS

HELP_FLAGS = ("-h", "--help")
WIDTH = 100
INDENT = 30


def launch(command: str, module: str, config: str) -> int:
    """Show help, or run ``lerobot_vtrefine.cli.COMMAND``, whose flags are the fields of ``module.config``.

    Raises:
        ValueError: a flag is missing or unknown. OSError: a file or a folder is not there. Told before
            LeRobot is imported, which takes ten seconds.
    """
    name = f"lerobot_vtrefine.cli.{command}"
    if set(HELP_FLAGS) & set(sys.argv[1:]):
        groups = [argument.removeprefix("--") for argument in sys.argv[1:] if argument not in HELP_FLAGS]
        below = [line for group in groups for line in group_help(module, config, group)]
        print("\n".join(below) or help_text(name, module, config))
        return 0
    known = flags_of(module, config, unused=True)
    sys.argv[1:] = with_environment(sys.argv[1:], known)
    check_arguments(known, sys.argv[1:])
    lists = {flag.name for flag in flags_of(module, config, nested=True) if flag.is_list}
    sys.argv[1:] = with_brackets(sys.argv[1:], lists)
    if sys.stderr.isatty():
        print("loading LeRobot and PyTorch (the first time takes longest) ...", file=sys.stderr, flush=True)
    gc.disable()  # what is imported stays: rounds over it would take a seventh of the time
    try:
        main = importlib.import_module(name).main
    finally:
        gc.freeze()  # and at the end, when all goes at once, a second or two
        gc.enable()
    from lerobot_vtrefine.lerobot_compat.config_errors import undecoded_values_raise

    with undecoded_values_raise():
        return main()


def with_environment(arguments: Sequence[str], flags: Sequence[Flag]) -> list[str]:
    """A command line that sets something of the environment, with the only type that commands here take.

    How arms look (`LOOKS`) says nothing about it, and a file says it itself.
    """
    takes_one = any(flag.name == "env" and flag.group is not None for flag in flags)
    given = {argument.partition("=")[0] for argument in arguments}
    sets_it = any(name.startswith("--env.") and name != LOOKS for name in given)
    if takes_one and sets_it and given.isdisjoint({"--env.type", CONFIG_FLAG}):
        return ["--env.type=vtrefine", *arguments]
    return list(arguments)


def entry_point(command: str, module: str, config: str) -> Callable[[], int]:
    """Console entry point of a command; its arguments are those of `launch`."""
    return run_cli(partial(launch, command, module, config))


demo = entry_point("demo", "lerobot_vtrefine.cli.pipeline.demo_config", "DemoConfig")
record_demos = entry_point("record_demos", "lerobot_vtrefine.cli.record_demos", "RecordDemosConfig")
record_starts = entry_point("record_starts", "lerobot_vtrefine.cli.record_starts", "RecordStartsConfig")
finetune = entry_point("finetune", "lerobot_vtrefine.finetune.pipeline", "FinetunePipelineConfig")
information = entry_point("information", "lerobot_vtrefine.cli.information", "InformationConfig")
play = entry_point("play", "lerobot_vtrefine.cli.play", "PlayConfig")
bench = entry_point("bench", "lerobot_vtrefine.cli.bench", "BenchConfig")
import_dataset = entry_point("import_dataset", "lerobot_vtrefine.cli.import_dataset", "ImportConfig")
replay = entry_point("replay", "lerobot_vtrefine.cli.replay", "ReplayConfig")


def group_help(module: str, config: str, group: str) -> list[str]:
    """The flags below a group such as ``env.scene``; nothing for what is no group's name.

    Raises: ValueError for a name below a group that is not there.
    """
    every = flags_of(module, config, nested=True)
    prefix = f"{group.removesuffix('.*')}."
    below = [flag for flag in every if flag.name.startswith(prefix) and flag.group is None]
    if below:
        return [f"flags of --{prefix[:-1]}:", *(line for flag in below for line in _lines(flag))]
    groups = {flag.name.rpartition(".")[0] for flag in every} - {""}
    known = groups | {flag.name for flag in every}
    if "=" in group or group in known or group.partition(".")[0] not in groups:
        return []
    close = did_you_mean(group, groups)
    raise ValueError(f"--help {group}: there is no such group of flags{close}; --help alone names them")


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
    closing = ["FILE is a YAML file of flags; vtrefine:NAME takes one that comes with the package."]
    if any(line.startswith("  --env.scene.*") for line in shown):
        closing.append(
            "--help env.scene lists the flags below --env.scene with their defaults; so for every group."
        )
    return "\n".join([usage, "", sentence, "", rest, "", "flags:", *shown, "", *closing])


def _lines(flag: Flag) -> list[str]:
    head = f"  --{flag.name}.*" if flag.has_flags_below else f"  --{flag.name}={flag.type}"
    said = flag.text
    if flag.required:
        said = f"{said} (required)"
    elif flag.default:
        said = f"{said} (default: {flag.default})"
    wrapped = textwrap.wrap(said.strip().replace("``", ""), WIDTH - INDENT) or [""]
    if len(head) < INDENT - 1:
        return [f"{head:<{INDENT}}{wrapped[0]}".rstrip(), *(" " * INDENT + line for line in wrapped[1:])]
    return [head, *(" " * INDENT + line for line in wrapped if line)]
