"""The diagnosis of a robot: its trials in, what the core's method finds in them out."""

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.core.engine import Progress, infer
from lerobot_vtrefine.diagnose.core.summary import tell
from lerobot_vtrefine.diagnose.joints.account import JointAccount
from lerobot_vtrefine.diagnose.joints.batch import make_batch
from lerobot_vtrefine.diagnose.joints.problem import JointProblem
from lerobot_vtrefine.diagnose.recordings import RecordingSet


def diagnose_robot(recordings: RecordingSet, seed: int = 0, progress: Progress | None = None) -> Diagnosis:
    """Find what the servo model gets wrong about a robot, name it, and measure what naming it gains.

    Args:
        recordings: a set of kind "robot" after quality control, or episodes of a dataset.
        seed: of the locked trials, folds, sign flips and resampling.
        progress: told what is being done and the fraction done.

    Raises:
        ValueError: a trial with commands or times that are not finite.
    """
    return diagnose_problem(JointProblem.of(recordings.joints, make_batch(recordings.trials)), seed, progress)


def diagnose_problem(whole: JointProblem, seed: int = 0, progress: Progress | None = None) -> Diagnosis:
    """The same for a problem that is posed already."""
    found = infer(whole, seed, progress)
    return tell(found, JointAccount(found))
