"""``vtrefine-diagnose``: name what the simulation gets wrong, repair its model and measure the gain."""

import argparse
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.formats import add_format_flags
from lerobot_vtrefine.cli.outputs import staged

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
    from lerobot_vtrefine.diagnose.recordings import RecordingSet

FILES = ("baseline_model.json", "sensor_model.json", "report.html", "verdict.json")
"""What a run leaves in the output folder; the verdict last, so that it stands for a whole run."""
DESCRIPTION = """\
Compare measured recordings with the simulation, name what the simulation gets wrong, extend its model
by that and measure the gain on recordings used neither for fitting nor for selection.

Give a recording set (a folder with recording.json and a Parquet file per trial), or a LeRobot dataset
of a robot's commands and positions, an episode being a trial."""
EPILOG = """\
Results in the output folder:
  verdict.json         status (adequate, explained, ambiguous, unexplained, invalid_data), causes with
                       parameters and intervals, held-out gain, what could not have been seen, data issues
  sensor_model.json    the extended model; load it with vtrefine-predict --sensor_model=FILE, and in
                       lerobot-eval and vtrefine-finetune with --env.sensor_model=FILE (of pads) or
                       --env.reality=FILE (of a robot like the simulated one)
  baseline_model.json  the simulation's own model, refitted, for comparison
  report.html          all of it for reading, on one page that needs no network

The exit status is 0 whatever the verdict, and 2 when the input cannot be read; one line then says which
file, trial and column is wrong.

examples:
  vtrefine-diagnose --template=presses
  vtrefine-diagnose --recording=presses --output_dir=diagnosis
  vtrefine-diagnose --dataset.root=outputs/aloha --output_dir=diagnosis"""


def make_parser() -> CommandParser:
    """Command line of ``vtrefine-diagnose``."""
    parser = CommandParser("vtrefine-diagnose", DESCRIPTION, EPILOG)
    parser.add_argument("--recording", type=Path, metavar="DIR", help="folder with recording.json")
    parser.add_argument(
        "--dataset.repo_id", dest="repo_id", metavar="NAME", help="LeRobot dataset, by its name"
    )
    parser.add_argument(
        "--dataset.root", dest="root", type=Path, metavar="DIR", help="LeRobot dataset, by its folder"
    )
    parser.add_argument(
        "--output_dir", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of resampling and of what is held out (default: %(default)s)"
    )
    parser.add_argument(
        "--stability",
        type=int,
        default=0,
        metavar="N",
        help="diagnose 2 N times more, with other recordings held out and with halves of them, and say which "
        "names survive (default: %(default)s)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace results that are there already")
    add_format_flags(parser)
    return parser


@run_cli
def main(arguments: Sequence[str] | None = None) -> None:
    """Console entry point."""
    options = make_parser().parse_args(arguments)
    check(options)
    # Before NumPy is loaded. The diagnosis works on all cores itself, and BLAS's threads would wait for each
    # other: half as much processor time again, and on a busy machine longer than the diagnosis need take.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with staged(options.output_dir, FILES, overwrite=options.overwrite) as folder:
        found, survived = run(read(options), folder, options.seed, options.stability, options.output_dir)
    summarise(found, options.output_dir, survived)


def check(options: argparse.Namespace) -> None:
    """ValueError unless exactly one source of recordings is given, and a seed that generators take."""
    dataset = options.repo_id is not None or options.root is not None
    if (options.recording is not None) == dataset:
        raise ValueError("give either --recording=DIR, or --dataset.root and/or --dataset.repo_id")
    _check_kind(options.recording, options.root)
    if options.seed < 0:
        raise ValueError(f"--seed must be at least 0, got {options.seed}")
    if options.stability < 0:
        raise ValueError(f"--stability must be at least 0, got {options.stability}")


def _check_kind(recording: Path | None, root: Path | None) -> None:
    """Raise where a source is of the other kind."""
    if recording is not None and recording.is_file():
        raise NotADirectoryError(f"--recording={recording} is a file; name the folder with recording.json")
    if recording is not None and (recording / "meta" / "info.json").is_file():
        raise ValueError(f"--recording={recording} is a LeRobot dataset: give --dataset.root={recording}")
    if root is not None and (root / "recording.json").is_file():
        raise ValueError(f"--dataset.root={root} is a recording set: give --recording={root}")


def read(options: argparse.Namespace) -> "RecordingSet":
    """The recordings that the options name; ValueError or FileNotFoundError say what is wrong with them."""
    if options.recording is not None:
        from lerobot_vtrefine.diagnose.recordings import read_recording_set

        return read_recording_set(options.recording)
    from lerobot_vtrefine.diagnose.joints.dataset import read_dataset

    return read_dataset(options.repo_id, options.root)


def run(
    recordings: "RecordingSet", folder: Path, seed: int, repetitions: int = 0, final: Path | None = None
) -> tuple["Diagnosis", str]:
    """Diagnose, and write all result files into ``folder``; the diagnosis, and what survives repetitions in
    one line. The page names files in ``final``, where the results will be."""
    from lerobot_vtrefine.cli.report.press_film import press_film
    from lerobot_vtrefine.diagnose.api import diagnose
    from lerobot_vtrefine.diagnose.report import render_report
    from lerobot_vtrefine.diagnose.report.words import title
    from lerobot_vtrefine.diagnose.stability import stability
    from lerobot_vtrefine.diagnose.verdict import write_verdict

    with tqdm(total=100, bar_format="{desc:<44} {percentage:3.0f} % |{bar}| {elapsed}") as bar:

        def progress(doing: str, done: float) -> None:
            bar.set_description_str(doing, refresh=False)
            bar.update(100.0 * min(done, 1.0) - bar.n)

        found = diagnose(recordings, seed, progress)
    survived = stability(recordings, found, repetitions, seed, diagnose).line(title) if repetitions else ""
    for model, name in zip((found.baseline_model, found.extended_model), FILES[:2], strict=True):
        if model is not None:
            model.save(folder / name)
    model = shlex.quote(str((final or folder) / FILES[1]))
    film = press_film(found, recordings)
    page = render_report(found, recordings, seed, film, survived, model)
    (folder / "report.html").write_text(page, encoding="utf-8")
    write_verdict(found.verdict, folder / "verdict.json")
    return found, survived


def summarise(found: "Diagnosis", output_dir: Path, survived: str) -> None:
    """The verdict and where to read about it, in a few lines."""
    from lerobot_vtrefine.diagnose.report.issues import issue_lines
    from lerobot_vtrefine.diagnose.report.words import headline, power_line

    verdict = found.verdict
    print(f"{verdict.status}: {headline(verdict, found.unit)}")
    if power := power_line(verdict):
        print(power)
    if survived:
        print(f"stability: {survived}")
    for line in issue_lines(verdict.data_issues):
        print(line)
    print(f"report: {output_dir / 'report.html'}")


if __name__ == "__main__":
    raise SystemExit(main())
