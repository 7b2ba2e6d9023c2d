"""``vtrefine-calibrate``: fit a pad's stiffness, damping and readout to recorded presses."""

import argparse
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import staged
from lerobot_vtrefine.wording import plural

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.calibration import Calibration

FILES = ("sensor_model.json", "calibration.json", "report.html")
CONTACTS = ("kelvin_voigt", "consistent")
DESCRIPTION = """\
Fit the paper's contact model (k_n, k_d) and the readout (gain, idle level, noise, saturation if the data
show one) to presses of a pad by a known indenter, with intervals from resampling whole recordings. Data that
cannot identify a parameter are refused, and what to record is said."""
EPILOG = """\
Results in the output folder:
  sensor_model.json  load it with --env.sensor_model=FILE (simulation) or vtrefine-predict --sensor_model=FILE
  calibration.json   parameters with intervals, and what the recordings excite
  report.html        response curves, uncertainty, presses over time, on one page that needs no network

What to record: at least 4 presses (better 16), each beginning above the pad; at least three depths and three
speeds; depth and load cell (depth_m and force_n: vtrefine-diagnose --help_format).

examples:
  vtrefine-calibrate --recording=presses --output_dir=calibration
  vtrefine-calibrate --recording=presses --k_n=400 --output_dir=calibration      # without a load cell"""


def make_parser() -> CommandParser:
    """Command line of ``vtrefine-calibrate``."""
    parser = CommandParser("vtrefine-calibrate", DESCRIPTION, EPILOG)
    parser.add_argument(
        "--recording", type=Path, required=True, metavar="DIR", help="folder with recording.json"
    )
    parser.add_argument(
        "--output_dir", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    parser.add_argument(
        "--k_n", type=float, metavar="N/M", help="stiffness per taxel, if known: needed without force_n"
    )
    parser.add_argument("--static", action="store_true", help="leave k_d out: presses of one speed will do")
    parser.add_argument(
        "--readout_only", action="store_true", help="fit the path from force to reading alone (needs force_n)"
    )
    parser.add_argument(
        "--contact",
        choices=CONTACTS,
        default=CONTACTS[0],
        help="stage that gets the stiffness: the paper's, or the simulator's load-consistent foundation",
    )
    parser.add_argument("--seed", type=int, default=0, help="of resampling (default: %(default)s)")
    parser.add_argument("--overwrite", action="store_true", help="replace results that are there already")
    return parser


@run_cli
def main(arguments: Sequence[str] | None = None) -> None:
    """Console entry point."""
    options = make_parser().parse_args(arguments)
    check(options)
    with staged(options.output_dir, FILES, overwrite=options.overwrite) as folder:
        calibration = run(options, folder)
    print("\n".join(describe(calibration)))
    print(f"-> {options.output_dir / FILES[0]}")


def check(options: argparse.Namespace) -> None:
    """ValueError for flags that contradict each other."""
    if options.readout_only and (options.k_n is not None or options.static):
        raise ValueError("--readout_only fits neither k_n nor k_d: leave out --k_n and --static")
    if options.seed < 0:
        raise ValueError(f"--seed must be at least 0, got {options.seed}")


def run(options: argparse.Namespace, folder: Path) -> "Calibration":
    """Fit, and write all results into ``folder``."""
    from lerobot_vtrefine.diagnose.calibration import Wanted, calibrate
    from lerobot_vtrefine.diagnose.calibration.page import render_page, summary
    from lerobot_vtrefine.diagnose.recordings import read_recording_set

    wanted = Wanted(options.k_n, options.static, options.readout_only, options.contact)
    calibration = calibrate(read_recording_set(options.recording), wanted, options.seed)
    source = options.recording.resolve().name
    calibration.model.save(folder / FILES[0])
    text = json.dumps(summary(calibration, source), indent=2)
    (folder / FILES[1]).write_text(text + "\n", encoding="utf-8")
    page = render_page(calibration, source, shlex.quote(str(options.output_dir / FILES[0])))
    (folder / FILES[2]).write_text(page, encoding="utf-8")
    return calibration


def describe(calibration: "Calibration") -> list[str]:
    """The result in a few lines of text."""
    from lerobot_vtrefine.diagnose.calibration.page import remarks
    from lerobot_vtrefine.diagnose.report.issues import issue_lines
    from lerobot_vtrefine.diagnose.report.numbers import interval

    recordings = plural(calibration.excitation.recordings, "recording")
    lines = issue_lines(calibration.issues)
    lines.append(f"{recordings}, {100 * calibration.explained:.1f} % explained")
    for name, item in calibration.parameters.items():
        if isinstance(item.value, float):
            value, spread = interval(item.value, item.ci95, item.unit)
            lines.append(f"  {name:<12} {value}{f' (95 %: {spread})' if spread else ''}")
    return lines + [f"  {text}" for text in remarks(calibration)]


if __name__ == "__main__":
    raise SystemExit(main())
