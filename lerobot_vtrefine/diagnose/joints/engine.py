"""The diagnosis of a robot: its trials in, what the core's method finds in them out."""

from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.core.engine import Inference, Progress, infer
from lerobot_vtrefine.diagnose.core.rivals import Rival
from lerobot_vtrefine.diagnose.core.summary import tell
from lerobot_vtrefine.diagnose.core.suspicion import Alarm
from lerobot_vtrefine.diagnose.evidence import ResidualView, Trace
from lerobot_vtrefine.diagnose.joints import experiments, views
from lerobot_vtrefine.diagnose.joints.batch import make_batch
from lerobot_vtrefine.diagnose.joints.candidates import NAMES, NOT_SHOWN, SIZES
from lerobot_vtrefine.diagnose.joints.candidates.base import Candidate
from lerobot_vtrefine.diagnose.joints.command_spread import scattering
from lerobot_vtrefine.diagnose.joints.detectable import minimum_detectable
from lerobot_vtrefine.diagnose.joints.estimates import Estimates, repeatability
from lerobot_vtrefine.diagnose.joints.fitting import Fit
from lerobot_vtrefine.diagnose.joints.model import RobotModel, to_model
from lerobot_vtrefine.diagnose.joints.parameters import INDEX
from lerobot_vtrefine.diagnose.joints.problem import JointProblem
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.diagnose.verdict import Parameter


def diagnose_robot(recordings: RecordingSet, seed: int = 0, progress: Progress | None = None) -> Diagnosis:
    """Find what the servo model gets wrong about a robot, name it, and measure what naming it gains.

    Args:
        recordings: a set of kind "robot" after quality control, or episodes of a dataset.
        seed: of the locked trials, folds, sign flips and resampling.
        progress: called with what is being done and the fraction done.

    Raises:
        ValueError: a trial with commands or times that are not finite.
    """
    return diagnose_problem(JointProblem.of(recordings.joints, make_batch(recordings.trials)), seed, progress)


def diagnose_problem(whole: JointProblem, seed: int = 0, progress: Progress | None = None) -> Diagnosis:
    """The same for a problem that is posed already."""
    found = infer(whole, seed, progress)
    return tell(found, JointAccount(found))


class JointAccount:
    """See `core.problem.Account`."""

    unit = "rad"
    metric = "rmse"

    def __init__(self, found: Inference[JointProblem, Fit, Candidate]) -> None:
        self.selection = found.selection
        self.estimates = Estimates(scattering(found.selection))
        self.detectable = minimum_detectable(found.selection)

    def parameters(self, cause: str, channels: tuple[int, ...]) -> Mapping[str, Parameter]:
        """By the cause's own file."""
        return SIZES[cause](self.estimates, channels)

    def baseline_parameters(self) -> Mapping[str, Parameter]:
        """The servos'."""
        return self.estimates.baseline(self.selection.baseline.point.theta)

    def model(self, fit: Fit) -> RobotModel:
        """The file that is written."""
        return to_model(self.selection.problem.names, fit.point)

    def minimum_detectable(self) -> Mapping[str, float]:
        """On the worst joint."""
        return self.detectable

    def noise_floor(self) -> float | None:
        """By repeated commands."""
        return repeatability(self.selection.problem, self.selection.fit.residual)

    def causes(self) -> Sequence[str]:
        """The catalogue."""
        return NAMES

    def caveat(self, cause: str, channels: tuple[int, ...]) -> str:
        """What an accepted cause leaves open."""
        forms = self.selection.candidates_of(cause, channels)
        spread = self.estimates.selection.problem.delay_spread_s
        if spread and any(form.shared for form in forms):
            return f", which changes from command to command by about {1e3 * spread:.0f} ms"
        if not self.selection.problem.asks_lags and any(form.shared for form in forms):
            return "; whether commands pass a low-pass in place of it, no replay on a twin was asked"
        free = self.selection.fit.free[list(channels)]
        if not free[:, INDEX["stop"]].any() or free[:, INDEX["bend"]].any():
            return ""
        return (
            ": it stops at one opening whatever is commanded; whether a part or the gripper's own end stops "
            "it, and how hard it presses, only the column load or pads can tell"
        )

    def not_identifiable(self, cause: str) -> str:
        """What to record where no joint shows it."""
        return "" if cause in self.detectable else NOT_SHOWN[cause]

    def next_experiment(
        self, rivals: Sequence[Rival[Fit, Candidate]], alarms: Sequence[Alarm]
    ) -> Mapping[str, Any] | None:
        """What to record next."""
        if alarms:
            return experiments.for_alarm(self.selection, alarms[0])
        if rivals:
            return experiments.for_rivals(self.selection, rivals)
        if self.selection.causes():
            return None
        return experiments.for_little_data(self.selection, self.detectable)

    def drawings(self, test: JointProblem, seed: int) -> tuple[tuple[Trace, ...], tuple[ResidualView, ...]]:
        """Traces of the worst joints, and what their residuals may follow."""
        batch, fits = test.batch, (self.selection.baseline, self.selection.fit)
        simulated, predicted = (test.predict(fit.point) for fit in fits)
        traces = views.traces(batch, test.names, simulated, predicted)
        return traces, views.residual_views(batch, simulated, predicted, seed)
