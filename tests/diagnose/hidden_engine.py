"""The engine behind its public interface: a folder in, the verdict and a model's predictions out."""

import dataclasses
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from hidden.cases import Case
from hidden.grading import grade
from hidden.naive import bic_stepwise, free_refit, load
from hidden.oracle import fit_baseline, squared_errors, truth_predictions
from hidden.session import Session, run_session
from hidden.writer import truth_of, write_session


def diagnose_folder(path: Path, seed: int = 0) -> tuple[dict[str, Any], Any]:
    """What `vtrefine-diagnose` would write to verdict.json, and the extended model."""
    from lerobot_vtrefine.diagnose.pad_engine import diagnose_pad
    from lerobot_vtrefine.diagnose.quality import check_quality
    from lerobot_vtrefine.diagnose.recordings import read_recording_set

    recordings, issues = check_quality(read_recording_set(path))
    found = diagnose_pad(recordings, seed=seed)
    verdict = {
        "status": found.status,
        "causes": [dataclasses.asdict(cause) for cause in found.causes],
        "ambiguous_with": [list(group) for group in found.ambiguous_with],
        "unknown": dataclasses.asdict(found.unknown),
        "heldout": dataclasses.asdict(found.heldout) if found.heldout else None,
        "minimum_detectable": dict(found.minimum_detectable),
        "next_experiment": found.next_experiment,
        "data_issues": [dataclasses.asdict(issue) for issue in issues],
    }
    return json.loads(json.dumps(verdict, default=plain)), found.extended_model


def plain(value: Any) -> Any:
    """Arrays and numpy's numbers as JSON knows them."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else dict(value)


def predictions(model: Any, path: Path) -> list[np.ndarray]:
    """The model's readings for every trial of a folder, in the folder's order."""
    from lerobot_vtrefine.diagnose.prediction import predict_trial
    from lerobot_vtrefine.diagnose.recordings import read_recording_set
    from lerobot_vtrefine.tactile.layout import PadLayout

    recordings = read_recording_set(path)
    layout = PadLayout(recordings.rows, recordings.cols, recordings.pitch_m)
    return [predict_trial(model, trial, layout) for trial in recordings.trials]


def share_of_oracle(session: Session, locked: Session, model: Any, folder: Path) -> dict[str, float]:
    """Gains on recordings that were never in the engine's folder, against the baseline refitted here."""
    locked.recordings.sort(key=lambda recording: recording.order)
    baseline = fit_baseline(session)
    plain_mse = squared_errors(locked, [baseline.predict(r) for r in locked.recordings]).mean()
    best_mse = squared_errors(locked, truth_predictions(locked)).mean()
    mse = squared_errors(locked, predictions(model, folder)).mean()
    return {"oracle_gain": 1 - best_mse / plain_mse, "gain": 1 - mse / plain_mse}


def run_case(case: Case, naive: bool = False) -> dict[str, Any]:
    """One row of the benchmark's cache. Whatever the engine raises is a failure of the engine."""
    session, locked = run_session(case.spec, case.seed, locked=6)
    truth = truth_of(session, case.seed)
    row: dict[str, Any] = {
        "group": case.group,
        "label": case.label,
        "seed": case.seed,
        "size": len(session.recordings),
    }
    row |= {"causes": truth.causes, "outside": truth.outside, "rig": case.spec.rig}
    with tempfile.TemporaryDirectory() as scratch:
        folder, later = Path(scratch) / "set", Path(scratch) / "locked"
        write_session(folder, session)
        write_session(later, locked)
        begin, cpu = time.perf_counter(), time.process_time()
        try:
            verdict, model = diagnose_folder(folder)
            row |= {"seconds": time.perf_counter() - begin, "cpu_s": time.process_time() - cpu}
            row |= {"verdict": verdict, **share_of_oracle(session, locked, model, later)}
            row |= dataclasses.asdict(grade(truth, verdict))
        except Exception as error:
            row |= {"kind": "error", "exact": False, "error": f"{type(error).__name__}: {error}"}
            row |= {"seconds": time.perf_counter() - begin, "oracle_gain": oracle_only(session, locked)}
        if naive:
            bench = load(folder)
            for analyst in (bic_stepwise, free_refit):
                row[analyst.__name__] = dataclasses.asdict(grade(truth, analyst(bench)))
    return row


def oracle_only(session: Session, locked: Session) -> float:
    baseline = fit_baseline(session)
    plain_mse = squared_errors(locked, [baseline.predict(r) for r in locked.recordings]).mean()
    return float(1 - squared_errors(locked, truth_predictions(locked)).mean() / plain_mse)
