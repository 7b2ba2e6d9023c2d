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
    """What `vtrefine-diagnose` writes to verdict.json, and the extended model."""
    from lerobot_vtrefine.diagnose.api import diagnose
    from lerobot_vtrefine.diagnose.verdict import read_verdict, write_verdict

    found = diagnose(path, seed)
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "verdict.json"
        write_verdict(found.verdict, file)
        read_verdict(file)  # the format's own checks
        return json.loads(file.read_text(encoding="utf-8")), found.extended_model


def predictions(model: Any, path: Path) -> list[np.ndarray]:
    """The model's readings for every trial of a folder, in the folder's order."""
    from lerobot_vtrefine.diagnose.pad.prediction import predict_trial
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
