"""What the method asks of an instrument: trials, a baseline, candidates, and fits that can be reweighted.

Shapes: T trials, J channels (1 for a camera, one per joint for a robot, one per quantity for parts).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np

from lerobot_vtrefine.diagnose.core.score_test import Tested
from lerobot_vtrefine.diagnose.evidence import ResidualView, Savable, Trace
from lerobot_vtrefine.diagnose.verdict import Parameter

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.core.rivals import Rival
    from lerobot_vtrefine.diagnose.core.search import Selection
    from lerobot_vtrefine.diagnose.core.suspicion import Alarm, Suspicion

Array = np.ndarray


class Candidate(Protocol):
    """One form of one cause."""

    @property
    def cause(self) -> str:
        """A name of the catalogue, or of something without a name (a decoy)."""

    @property
    def shared(self) -> bool:
        """Whether it acts on all channels together and is one hypothesis."""

    @property
    def clue(self) -> str:
        """What a decoy would mean; empty for what has a name. Decoys compete and are never handed out."""

    @property
    def handicap(self) -> float:
        """Part of the error by which it must beat forms with fewer terms."""

    @property
    def only_where(self) -> str:
        """Cause that must have helped on a channel for this one to be tried there; empty: everywhere."""

    def refines(self, other: "Candidate") -> bool:
        """Whether its fit starts from that of another."""


@dataclass(frozen=True)
class PlainCandidate:
    """A cause of one form that acts on single channels: what most instruments need."""

    cause: str
    handicap: float = 0.0
    shared: bool = False
    clue: str = ""
    only_where: str = ""

    def refines(self, other: Candidate) -> bool:
        """It starts by itself."""
        return False


class Fit(Protocol):
    """Where a fit ended."""

    @property
    def mse(self) -> Array:
        """(T, J) mean squared error."""


class Reweighted(Protocol):
    """A fit to other choices of the same trials, by one Newton step."""

    @property
    def channels(self) -> Array:
        """Numbers of the channels that may change."""

    def errors(self, weights: Array, trials: Array) -> Array:
        """Mean squared errors of some trials on `channels` if every trial counted `weights` (T,) times."""


class OptionalSteps(Protocol):
    """Steps that an instrument may add between those of the method; each does nothing by default."""

    @property
    def screens(self) -> bool:
        """Whether it is a `ScreenedProblem`; else a `SearchedProblem`."""
        return False

    @property
    def can_settle(self) -> bool:
        """Whether `settles` can decide anything here."""
        return False

    def revised(self, now: Any, accepted: Sequence[Any]) -> Self:
        """The problem after candidates were accepted; itself where these change nothing about it."""
        return self

    def reviewed(self, selection: "Selection[Any, Any, Any]", seed: int) -> "Selection[Any, Any, Any]":
        """The selection after a look at what candidates cannot say."""
        return selection

    def reformed(self, selection: "Selection[Any, Any, Any]", seed: int) -> "Selection[Any, Any, Any]":
        """The same names, each in the form that suits best."""
        return selection

    def thinned(self) -> Self:
        """The trials as the search sees them: with fewer readings, where there are more than it needs."""
        return self

    def with_all_frames(self, selection: "Selection[Any, Any, Any]") -> "Selection[Any, Any, Any]":
        """What was selected on thinned trials, on whole ones."""
        return selection

    def settles(self, rival: "Rival[Any, Any]", selection: "Selection[Any, Any, Any]", seed: int) -> int:
        """What else than the errors decides a tie: 1 for the rival, -1 for the cause, 0 for neither."""
        return 0

    def nameless_rivals(
        self, selection: "Selection[Any, Any, Any]", seed: int
    ) -> "Sequence[Rival[Any, Any]]":
        """What has no name, and explains as much in the place of an accepted cause; its clue says it."""
        return ()

    def finer(self) -> Self | None:
        """The same trials with predictions for which the search is too slow; None where there are none."""
        return None

    def shown(self, selection: "Selection[Any, Any, Any]", locked: Self) -> "Selection[Any, Any, Any]":
        """With what several locked trials show by themselves, so that each is told what the others show."""
        return selection

    def handed_out(
        self, selection: "Selection[Any, Any, Any]", seed: int, *, doubtful: bool
    ) -> "Selection[Any, Any, Any]":
        """The selection with fits as users get them; `doubtful`: an alarm was raised."""
        return selection

    def without_effect(self, fit: Any, baseline: Any) -> Any:
        """A fit that may keep its names, and that predicts as the baseline does, but for what was seen in the
        readings themselves."""
        return baseline

    def completed(self, selection: "Selection[Any, Any, Any]") -> tuple[Any, Any]:
        """Baseline and fit for users, once all is decided and measured: it may be fitted to all trials."""
        return selection.baseline, selection.fit

    def suspicions(self, selection: "Selection[Any, Any, Any]", seed: int) -> "Sequence[Suspicion]":
        """What may be left, as scores of trials."""
        return ()

    def surprises(self, fit: Any, locked: Self) -> "Sequence[Suspicion]":
        """What may be left in locked trials, or in the order of all; asked once models are settled."""
        return ()


class Problem[F: Fit, C: Candidate](OptionalSteps, Protocol):
    """Trials to be explained, and fits to them."""

    @property
    def subject(self) -> str:
        """What is judged, for progress and sentences."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the J channels."""

    @property
    def conditions(self) -> tuple[str, ...]:
        """(T,) equal where trials are driven alike."""

    @property
    def files(self) -> tuple[str, ...]:
        """(T,) names of the trials."""

    def subset(self, trials: Array) -> Self:
        """The same on fewer trials."""

    def baseline(self) -> F:
        """The simulation's own model, refitted."""

    def extended(self, now: F, candidate: C, channels: Array, plainer: F | None = None) -> F:
        """Fit a candidate on top of a fit, on channels (J,) bool where it is applicable.

        Args:
            plainer: the fit of the candidate that it refines, where there is one already.
        """

    def reduced(self, now: F, candidates: Sequence[C], channels: Array) -> F:
        """Refit without candidates on channels (J,) bool; what is shared goes everywhere."""

    def refitted(self, now: F) -> F:
        """Everything that is free, fitted anew."""

    def errors(self, fit: F) -> Array:
        """(T, J) mean squared errors under a fit that may have been made on other trials."""

    def credible(self, baseline: F, now: F, best: F, candidate: C) -> Array:
        """(J,) bool: whether the size found is large enough to be seen and no larger than errors allow."""


class SearchedProblem[F: Fit, C: Candidate](Problem[F, C], Protocol):
    """Trials of many channels, and candidates that are all fitted to each."""

    def candidates(self) -> Sequence[C]:
        """Everything that may be wrong."""

    def applicable(self, candidate: C, now: F) -> Array:
        """(J,) bool: channels on which these trials could show it, and which a fit does not give it yet."""

    def merged(self, one: F, other: F, take_other: Array) -> F:
        """Channels of the one fit, those of the other where (J,) says so."""

    def reweighted(self, fit: F, channels: Array | None = None) -> Reweighted:
        """For cross-validation; only some channels (numbers) move if they are given."""


class FormCandidate(Candidate, Protocol):
    """One form of a cause that is tested by scores before it is fitted."""

    @property
    def terms(self) -> int:
        """Coordinates that it adds; 0 where none are counted (a map that is shrunk): it imitates nothing."""

    @property
    def peer(self) -> bool:
        """Of another form than the plain one: whether it is no richer than that."""

    @property
    def disturbs(self) -> bool:
        """Whether nothing else can be fitted well before it is: where it helps, it is taken first."""


class ScoredFit(Fit, Protocol):
    """A fit under a noise model."""

    @property
    def scores(self) -> Array:
        """(T, J) log score of every trial, up to a constant."""


class Scored(Protocol):
    """See `Reweighted`."""

    def errors(self, weights: Array, trials: Array) -> Array:
        """Mean squared errors of some trials (trials, J) if every trial counted `weights` (T,) times."""

    def log_scores(self, weights: Array, trials: Array) -> Array:
        """The same of log scores."""


@dataclass(frozen=True)
class Promise[C]:
    """A candidate and what its scores say before it is fitted."""

    candidate: C
    tested: Tested
    refine: bool = False
    """Whether another form of the same cause promised most, so that it is tried in any case."""


class ScreenedProblem[F: ScoredFit, C: FormCandidate](Problem[F, C], Protocol):
    """Trials of one channel with a noise model, and candidates of many forms whose fits are slow.

    Candidates are tested by scores before any is fitted, in their plain forms first.
    """

    @property
    def further_gain(self) -> float:
        """Part of the error that a further cause must take away: correcting the form of others gains some."""

    @property
    def in_nats(self) -> bool:
        """Whether log scores follow from a noise model; else plain errors stand in."""

    def weighed(self, now: F | None) -> tuple[Self, F]:
        """The problem with the noise around a fit (None: the baseline's) for weights, and the fit anew."""

    def unweighed(self, now: F) -> tuple[Self, F]:
        """The same where all readings count alike."""

    def far_off(self, now: F) -> bool:
        """Whether errors are so far above noise that weights may hide what is wrong."""

    def screened(self, now: F, only: Collection[str] | None = None) -> list[Promise[C]]:
        """Every cause (or those of some names) that a fit does not hold, by its most certain probe."""

    def refinements(self, candidate: C) -> Sequence[C]:
        """Other forms of the same cause, the plainer first."""

    def log_scores(self, fit: F) -> Array:
        """(T,) of trials that took no part in a fit, under the noise and the scatter between trials that it
        knows, up to a constant."""

    def reweighted(self, fit: F) -> Scored:
        """For cross-validation."""


class OptionalRemarks(Protocol):
    """What an account may add; nothing by default."""

    def noise_floor(self) -> float | None:
        """Root mean square error that no model could undo; None where it is not known."""
        return None

    def caveat(self, cause: str, channels: tuple[int, ...]) -> str:
        """What an accepted cause leaves open."""
        return ""

    def not_identifiable(self, cause: str) -> str:
        """Why these trials cannot show a cause; empty where they can."""
        return ""

    def drawings(self, test: Any, seed: int) -> tuple[tuple[Trace, ...], tuple[ResidualView, ...]]:
        """What the report draws about locked trials."""
        return (), ()


class Account[F: Fit, C: Candidate](OptionalRemarks, Protocol):
    """How an instrument reports what was found: sizes, models, sentences, drawings."""

    unit: str
    metric: str

    def parameters(self, cause: str, channels: tuple[int, ...]) -> Mapping[str, Parameter]:
        """Sizes with intervals."""

    def baseline_parameters(self) -> Mapping[str, Parameter]:
        """Those of the refitted baseline."""

    def model(self, fit: F) -> Savable | None:
        """As the file that is written."""

    def minimum_detectable(self) -> Mapping[str, float]:
        """Cause -> smallest size that these trials would have shown."""

    def causes(self) -> Sequence[str]:
        """Names that are reported, found or not."""

    def next_experiment(
        self, rivals: "Sequence[Rival[F, C]]", alarms: "Sequence[Alarm]"
    ) -> Mapping[str, Any] | None:
        """What to record next."""
