"""``vtrefine-predict``: predict recordings with a saved model, without looking at their readings."""

import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import staged

DESCRIPTION = """\
Replay each trial's motion through a saved model and write what it predicts.

Pads: the trial's motion (or load) goes through the simulator's own sensor code; the trial's raw
readings are never opened, and may be absent. Robots: its commands go through the servo model; of
its positions only the first is used."""
EPILOG = """\
Lengths, angles and times that clearly are in other units than the format's are converted, and said.

Result: a Parquet file of each trial's name, with time_s and the predicted raw (or position), a row
per recorded frame. Noise and rounding are left out: the mean is what predicts best.

example:
  vtrefine-diagnose --recording=presses --output_dir=diagnosis
  vtrefine-predict --recording=other_presses --sensor_model=diagnosis/sensor_model.json \\
      --output_dir=predicted"""


def make_parser() -> CommandParser:
    """Command line of ``vtrefine-predict``."""
    parser = CommandParser("vtrefine-predict", DESCRIPTION, EPILOG)
    parser.add_argument(
        "--recording", type=Path, required=True, metavar="DIR", help="folder with recording.json"
    )
    parser.add_argument(
        "--sensor_model",
        type=Path,
        required=True,
        metavar="FILE",
        help="sensor_model.json or baseline_model.json of a diagnosis, or any sensor model's file",
    )
    parser.add_argument(
        "--output_dir", type=Path, required=True, metavar="DIR", help="folder for the predictions"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace predictions that are there already")
    return parser


@run_cli
def main(arguments: Sequence[str] | None = None) -> None:
    """Console entry point."""
    options = make_parser().parse_args(arguments)
    if options.output_dir.resolve() == options.recording.resolve():
        raise ValueError("--output_dir is the folder of the recordings, which predictions would replace")
    from lerobot_vtrefine.diagnose.predict import (
        load_predictor,
        predict_frames,
        sound_frames,
        write_prediction,
    )
    from lerobot_vtrefine.diagnose.quality import in_si_units
    from lerobot_vtrefine.diagnose.recordings import read_recording_set

    recorded = read_recording_set(options.recording, measured=False)
    recordings, repairs = in_si_units(recorded)
    for repair in repairs:
        print(f"{repair.trial or 'all trials'}: {repair.problem}; {repair.action}", file=sys.stderr)
    for trial in recordings.trials:
        if broken := int((~sound_frames(trial)).sum()):
            print(
                f"{trial.file}: {broken} of {len(trial.time_s)} frames come again, or have no number in what"
                " moves the model; they get the prediction of the frame before",
                file=sys.stderr,
            )
    predict = load_predictor(options.sensor_model, recordings)
    names = [trial.file for trial in recordings.trials]
    if outside := [name for name in names if ".." in Path(name).parts or Path(name).is_absolute()]:
        raise ValueError(f"{options.recording}: trial file {outside[0]} lies outside of the folder")
    with staged(options.output_dir, names, overwrite=options.overwrite) as folder:
        pairs = zip(recorded.trials, recordings.trials, strict=True)
        for trial, mended in tqdm(pairs, desc="predict", unit="trial", total=len(names)):
            write_prediction(folder / trial.file, recordings, trial, predict_frames(mended, predict))
    print(f"wrote {len(names)} predictions to {options.output_dir}")


if __name__ == "__main__":
    raise SystemExit(main())
