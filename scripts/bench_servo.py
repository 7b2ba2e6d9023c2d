"""How well are runs at a gain predicted that was never fitted? Prints the table of results/servo.json.

Every setting (gain, supply, load) of a recording set of a servo is left out in turn. The other recordings go
through the door that users take, `diagnose`, and the files that it hands out predict the setting as
``vtrefine-predict`` does. BAM's friction models M1 to M6 (arXiv 2410.08650, see reference/bam_ladder.py) are
fitted to the same recordings. What is done is kept in the output folder, so that an interrupted run goes on
where it stopped:

    vtrefine-import --source=bam_xl330.npz --recording_dir=outputs/xl330
    python scripts/bench_servo.py --recording=outputs/xl330
    python scripts/collect_results.py servo outputs/bench_servo/servo.md --replace
"""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from reference.bam_ladder import LADDER, errors, fit, gridded

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.provenance import write_provenance
from lerobot_vtrefine.diagnose.api import diagnose
from lerobot_vtrefine.diagnose.core.resampling import gain_interval
from lerobot_vtrefine.diagnose.predict import load_predictor, predict_frames
from lerobot_vtrefine.diagnose.recordings import RecordingSet, RobotTrial, read_recording_set
from lerobot_vtrefine.diagnose.report.words import title
from lerobot_vtrefine.diagnose.servo.bench import Bench, on_bench

ROOT = Path(__file__).parents[1]
Array = np.ndarray


def kept(path: Path, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a file holds; it is made where it is not there."""
    if not path.is_file():
        found = make()
        part = path.with_suffix(".part")
        part.write_text(json.dumps(found), encoding="utf-8")
        part.replace(path)
    return json.loads(path.read_text(encoding="utf-8"))


def diagnosed(whole: RecordingSet, fitted: Array, held: Array, seed: int, folder: Path) -> dict[str, Any]:
    """Names found on some trials, and errors on the others of the models that were handed out."""
    found = diagnose(chosen(whole, fitted), seed)
    test, squared = chosen(whole, held), {}
    folder.mkdir(exist_ok=True)
    models = {"baseline": found.baseline_model, "engine": found.extended_model}
    for name, model in models.items():
        assert model is not None
        model.save(folder / f"{name}.json")
        predict = load_predictor(folder / f"{name}.json", test)
        squared[name] = [mean_squared(trial, predict_frames(trial, predict)) for trial in test.trials]
    verdict = found.verdict
    told = {"status": verdict.status, "causes": [cause.name for cause in verdict.causes]}
    return squared | told | {"ties": sorted({name for pair in verdict.ambiguous_with for name in pair})}


def chosen(recordings: RecordingSet, trials: Array) -> RecordingSet:
    """Only some recordings."""
    return replace(recordings, trials=tuple(recordings.trials[number] for number in trials))


def mean_squared(trial: RobotTrial, predicted: Array) -> float:
    """Over the frames that were measured [rad^2]."""
    return float(np.nanmean(np.square(trial.position - predicted)))


def ladder(bench: Bench, fitted: Array, held: Array, rung: str, lower: dict[str, Any]) -> dict[str, Any]:
    """One of BAM's models, refitted."""
    logs = gridded(bench)
    theta = fit(logs.of(fitted), rung, {name: np.array(item["theta"]) for name, item in lower.items()})
    return {"theta": theta.tolist(), "errors": errors(logs.of(held), rung, theta).tolist()}


def milliradians(squared: Array) -> str:
    """Root of a mean squared error."""
    return f"{1e3 * float(np.sqrt(np.mean(squared))):.1f}"


def render(found: list[dict[str, Any]], labels: list[str], seed: int) -> str:
    """The table: errors at every setting left out, and the gain over all."""
    base = [np.array(item["diagnosis"]["baseline"]) for item in found]
    rows = [("simulated servo: Coulomb and viscous friction", base)]
    rows.append(("vtrefine-diagnose", [np.array(item["diagnosis"]["engine"]) for item in found]))
    rows += [(f"BAM's {rung}", [np.array(item[rung]["errors"]) for item in found]) for rung in LADDER]
    lines = ["| | " + " | ".join([*labels, "squared error gone"]) + " |", "|---" * (len(labels) + 2) + "|"]
    before = np.concatenate(base)
    for name, squared in rows:
        after = np.concatenate(squared)
        low, high = gain_interval(before, after, seed)
        gone = "-" if squared is base else f"{1 - after.sum() / before.sum():.2f} [{low:.2f}, {high:.2f}]"
        cells = [
            milliradians(own) + ("" if squared is base else f" ({1 - own.mean() / first.mean():.2f})")
            for own, first in zip(squared, base, strict=True)
        ]
        lines.append(f"| {name} | " + " | ".join([*cells, gone]) + " |")
    return "\n".join(lines)


@run_cli
def main() -> None:
    """Do what is missing and print the table."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--recording", type=Path, required=True, help="folder with recording.json")
    parser.add_argument(
        "--output_dir",
        type=Path,
        default=ROOT / "outputs" / "bench_servo",
        help="where servo.md and what is done are kept",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the diagnosis (default %(default)s)")
    options = parser.parse_args()
    options.output_dir.mkdir(parents=True, exist_ok=True)
    whole = read_recording_set(options.recording)
    if not on_bench(whole):
        raise ValueError(f"--recording={options.recording} is not of a servo with a known load")
    bench = Bench.of(whole)
    settings = np.array(bench.settings)
    found, labels, said = [], [], []
    for number, name in enumerate(dict.fromkeys(bench.settings)):
        held, fitted = np.flatnonzero(settings == name), np.flatnonzero(settings != name)
        own: dict[str, Any] = {}
        for rung in LADDER:
            path = options.output_dir / f"{number}_{rung}.json"
            own[rung] = kept(path, partial(ladder, bench, fitted, held, rung, own))
        path = options.output_dir / f"{number}_diagnosis.json"
        handed_out = options.output_dir / f"{number}_models"
        own["diagnosis"] = kept(path, partial(diagnosed, whole, fitted, held, options.seed, handed_out))
        duty = bench.duty_per_rad[held[0]]
        labels.append(f"{duty:.2f}/rad left out [mrad]")
        names = ", ".join(title(item) for item in own["diagnosis"]["causes"]) or "nothing"
        ties = ", ".join(title(item) for item in own["diagnosis"]["ties"])
        status = own["diagnosis"]["status"]
        said.append(f"without {duty:.2f}/rad: {status}, {names}" + (f"; ties of {ties}" if ties else ""))
        found.append(own)
    text = render(found, labels, options.seed)
    (options.output_dir / "servo.md").write_text(text + "\n", encoding="utf-8")
    write_provenance(options.output_dir)
    print(text, *said, sep="\n")


if __name__ == "__main__":
    raise SystemExit(main())
