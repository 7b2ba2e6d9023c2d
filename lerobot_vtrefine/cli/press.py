"""``vtrefine-press``: record presses of a simulated pad with a hidden flaw, to try diagnosis."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import staged
from lerobot_vtrefine.extras import SIMULATOR, require
from lerobot_vtrefine.wording import plural

DESCRIPTION = """\
Record presses of a simulated pad with a hidden flaw, in the format that real recordings have. A sphere and
a square punch press, hold and slide; noise, rounding and small errors between recordings are added."""
EPILOG = """\
examples:
  vtrefine-press --output_dir=presses
  vtrefine-press --reality=reality.json --output_dir=presses
  vtrefine-diagnose --recording=presses --output_dir=diagnosis"""
REPLICATES = 2
MOST_TRIALS = 10_000
"""Files are numbered by four digits."""


def make_parser() -> CommandParser:
    """Command line of ``vtrefine-press``."""
    parser = CommandParser("vtrefine-press", DESCRIPTION, EPILOG)
    parser.add_argument(
        "--reality",
        type=Path,
        metavar="FILE",
        help="hidden physics, as --env.reality takes it (default: a pad with row sharing)",
    )
    parser.add_argument("--output_dir", type=Path, required=True, metavar="DIR", help="folder to write")
    parser.add_argument(
        "--trials", type=int, default=16, help="recordings, two of every motion (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of motions and noise (default: %(default)s)")
    parser.add_argument("--overwrite", action="store_true", help="replace recordings that are there already")
    return parser


@run_cli
def main(arguments: Sequence[str] | None = None) -> None:
    """Console entry point."""
    options = make_parser().parse_args(arguments)
    if options.trials < REPLICATES or options.trials % REPLICATES:
        raise ValueError(f"--trials must be an even number of at least {REPLICATES}, got {options.trials}")
    if options.trials > MOST_TRIALS:
        raise ValueError(f"--trials must be at most {MOST_TRIALS}, got {options.trials}")
    if options.seed < 0:
        raise ValueError(f"--seed must be at least 0, got {options.seed}")
    require("vtrefine-press", SIMULATOR)
    with staged(options.output_dir, ("recording.json",), overwrite=options.overwrite) as folder:
        from lerobot_vtrefine.diagnose.pad.stand_in_rig import record

        record(options.reality, folder, options.trials, options.seed)
    print(f"{plural(options.trials, 'recording')} in {options.output_dir}")
    print(
        f"next: vtrefine-diagnose --recording={shlex.quote(str(options.output_dir))} --output_dir=diagnosis"
    )


if __name__ == "__main__":
    raise SystemExit(main())
