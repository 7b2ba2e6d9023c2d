"""The diagnosis of a pad: recorded presses in; what the paper's model gets wrong, and by how much, out."""

from dataclasses import replace

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.core.engine import Progress, infer
from lerobot_vtrefine.diagnose.core.heldout import lock
from lerobot_vtrefine.diagnose.core.memory import memory_kept
from lerobot_vtrefine.diagnose.core.summary import tell
from lerobot_vtrefine.diagnose.pad.account import PadAccount
from lerobot_vtrefine.diagnose.pad.press_trials import prepare, usable
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial
from lerobot_vtrefine.diagnose.verdict import DataIssue, Verdict
from lerobot_vtrefine.wording import plural

MIN_RECORDINGS = 2
FEW_RECORDINGS = 8


def diagnose_pad(recordings: RecordingSet, seed: int = 0, progress: Progress | None = None) -> Diagnosis:
    """Find what the paper's model gets wrong about these recordings, name it, extend the model, measure it.

    Args:
        seed: decides which recordings are locked, and every resampling.
        progress: called with a few words and the fraction done.

    Raises ValueError when an indenter's mesh cannot be used.
    """
    trials, issues = _usable_trials(recordings)
    if len(trials) < MIN_RECORDINGS:
        return _invalid(issues, plural(len(trials), "usable recording"))
    locked = set(lock([trial.condition for trial in trials], seed))
    learn = [index for index in range(len(trials)) if index not in locked]
    # Idle levels are learnt from discovery only.
    presses = prepare(recordings, trials, learn)
    if not any((press.drive > 0).any() for press in presses.subset(learn).presses):
        return _invalid(issues, "the indenter never touches the pad")
    whole = PadProblem(presses, seed)
    with memory_kept():
        found = infer(whole, seed, progress)
        account = PadAccount(found, whole)
        diagnosis = tell(found, account)
    return replace(diagnosis, maps=account.maps()).noting(*issues, *_little_data(len(trials), len(locked)))


def _invalid(issues: list[DataIssue], problem: str) -> Diagnosis:
    noted = (*issues, DataIssue(None, problem, "nothing was fitted"))
    return Diagnosis(Verdict("invalid_data", data_issues=noted), unit="counts")


def _little_data(count: int, locked: int) -> list[DataIssue]:
    issues = []
    if count < FEW_RECORDINGS:
        few = f"only {plural(count, 'recording')}"
        text = f"{few}: most effects cannot reach significance, see minimum_detectable"
        issues.append(DataIssue(None, text, "kept"))
    if not locked:
        issues.append(DataIssue(None, "too few recordings to lock any", "no held-out error"))
    return issues


def _usable_trials(recordings: RecordingSet) -> tuple[list[Trial], list[DataIssue]]:
    trials, issues = [], []
    for trial in recordings.trials:
        clean = usable(trial)
        if clean is None:
            issues.append(DataIssue(trial.file, "too few frames hold numbers", "set aside"))
        else:
            trials.append(clean)
    if any(trial.depth_m is None for trial in trials) and any(trial.depth_m is not None for trial in trials):
        kept = [trial for trial in trials if trial.depth_m is not None]
        for trial in trials:
            if trial.depth_m is None:
                issues.append(DataIssue(trial.file, "driven by load, while others give depth", "set aside"))
        trials = kept
    return trials, issues
