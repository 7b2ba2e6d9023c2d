"""The diagnosis of a servo with a known load: its trials in, what the core's method finds in them out."""

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.core.engine import Progress, infer
from lerobot_vtrefine.diagnose.core.heldout import affordable
from lerobot_vtrefine.diagnose.core.summary import tell
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.diagnose.servo.account import ServoAccount
from lerobot_vtrefine.diagnose.servo.bench import Bench
from lerobot_vtrefine.diagnose.servo.problem import ServoProblem


def diagnose_servo(recordings: RecordingSet, seed: int = 0, progress: Progress | None = None) -> Diagnosis:
    """Find what a motor with Coulomb and viscous friction gets wrong about a servo.

    Of fewer than eleven trials none is locked, for nothing could be found in the rest: gains are then
    cross-validated ones only.

    Raises ValueError where a trial lacks its load or gain, or its commands or times are not finite.
    """
    locking = affordable(len(recordings.trials))
    found = infer(ServoProblem.of(Bench.of(recordings)), seed, progress, locking=locking)
    return tell(found, ServoAccount(found))
