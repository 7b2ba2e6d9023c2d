"""How long a pad's diagnosis takes, beside what was recorded for it; a row for ``vtrefine-bench``."""

import tempfile
import time
from pathlib import Path

from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.pad.stand_in_rig import SECONDS, record
from lerobot_vtrefine.diagnose.recordings import read_recording_set

TRIALS = 16

Row = tuple[str, float, str]


def run() -> list[Row]:
    """(what, ratio, explanation) for presses of a stand-in pad, the taxels of whose rows load each other."""
    with tempfile.TemporaryDirectory() as folder:
        presses = Path(folder) / "presses"
        record(None, presses, TRIALS, seed=0)
        recordings = read_recording_set(presses)
        begin = time.process_time()
        verdict = diagnose_pad(recordings, 0, None).verdict
        seconds = time.process_time() - begin
    named = ", ".join(cause.name for cause in verdict.causes) or verdict.status
    explanation = f"{seconds:.1f} s of CPU time for {TRIALS} presses of {SECONDS:g} s each: {named}"
    return [("time of presses / of their diagnosis", TRIALS * SECONDS / seconds, explanation)]
