"""What a candidate cause is: a family of simulator stages with parameters, starting points and a null."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal

import numpy as np

from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.cover import CoverLaw


@dataclass(frozen=True)
class Setting:
    """What a candidate may know about the recordings and the fitted baseline."""

    layout: PadLayout
    top_counts: float
    """Signal that the baseline predicts at most."""
    full_scale: float
    frame_s: float
    """Median time between frames [s]."""
    duration_s: float
    """Median length of a recording [s]."""
    session_s: float
    """Span of the session [s]; 0 if it was not recorded."""
    top_depth_m: float
    loaded: bool
    """Driven by the load: nothing before the force can be fitted."""
    touched_rows: int
    touched_cols: int
    rest_session_s: float
    """Mean session time of the frames that the idle map rests on [s]."""
    temperature_c: float | None = None
    """Mean temperature; None where it was not recorded throughout, or did not change."""
    row_company: int = 1
    """Most taxels of a row that are pressed at once."""
    company: int = 1
    """Most taxels that are pressed at once."""
    ages_s: tuple[float, ...] = (0.0,)
    """How old readings were in frames on the pad, each as likely: the middles of equal parts [s]."""
    log_gain: float | None = None
    """Logarithm of the plain baseline's counts per metre (or newton); None before it is fitted."""
    damped: bool = False
    """Whether damping bears a visible part of what the plain baseline predicts."""
    repeats: bool = True
    """Whether readings repeat in frames on the pad, or nothing says that they do not."""
    row_groups: tuple[int, ...] = ()
    """Number of every row's group where these repeat apart, in one rhythm; none where whole frames do."""
    returned: bool = False
    """Whether recordings press where others of the session have pressed before."""
    idle_counts: tuple[tuple[float, ...], ...] = ()
    """What every taxel reads at rest (R, C)."""
    rest_time_s: float = 0.0
    """Mean time in their recordings of the frames that the idle map rests on [s]."""
    idle_course: tuple[tuple[float, float], ...] = ()
    """How taxels that nothing presses move through the session: times [s] and counts above the idle map."""
    idle_rates: tuple[tuple[float, ...], ...] = ()
    """What every taxel does beside that (R, C) [counts/s]; none where they all do the same."""
    face_m: tuple[tuple[float, ...], ...] = ()
    """How much lower than its mean the face is at every taxel (R, C) [m]; none where that was not told."""


@dataclass(frozen=True)
class Value:
    """One fitted coordinate of a form and its bounds."""

    name: str
    low: float
    high: float
    step: float
    """Step of finite differences; 0 for a coordinate that is searched, not descended along."""


Stages = tuple[Stage, ...]
Kind = Literal[
    "bend",  # of readings against depth
    "load",  # otherwise than in proportion to it
    "memory",  # of the contact
    "peak",  # of its largest load
    "age",  # of how long it has lasted
    "rate",  # of how fast it came
    "time",  # drifts within a recording
    "place",  # differs over the pad
    "centre",  # with the distance from it
    "row",  # depends on its other readings
    "column",
    "pad",
    "timing",
]
"""What a cause is like."""


@dataclass(frozen=True)
class Form:
    """One functional form of a cause.

    Attributes:
        family: name of the cause (docs/verdict.md).
        label: what form this is, for people.
        values: fitted coordinates; coordinate vectors elsewhere follow their order.
        build: coordinates and setting to stages.
        report: coordinates and setting to the public parameters: name -> (value, unit).
        probes: coordinates near the null, one row per guess of what the effect may look like.
        amplitude: index of the coordinate that is the effect's size (0 is no effect), along which probes are
            stretched; None if probes are taken as they are.
        signed: whether the effect may go either way; otherwise screening is one-sided.

    What holds for the cause as a whole (`kinds`, `needs`, `between_frames`) stands with its plain form.
    """

    family: str
    label: str
    values: tuple[Value, ...]
    build: Callable[[np.ndarray, Setting], Stages]
    report: Callable[[np.ndarray, Setting], dict[str, tuple[float, str]]]
    probes: Callable[[Setting], list[list[float]]]
    amplitude: int | None = 0
    signed: bool = False
    possible: Callable[[Setting], bool] = field(default=lambda setting: True)
    search: Callable[[PressSet, float], list[list[float]]] | None = None
    """Starting points taken from the recordings and the frame time, instead of stretched probes."""
    range: Callable[[np.ndarray, PressSet], dict[str, tuple[float, float]]] | None = None
    """Intervals of parameters that no descent can estimate: coordinates and recordings to name -> ends."""
    twin: int | None = None
    """Number of the coordinate that trades off against the baseline's damping, if one does."""
    screened: bool = True
    """Whether its probes take part in screening; fallbacks are only fitted where their family is named."""
    competes: bool = True
    """Whether it is fitted while names compete; else only once its family is named, as the likeliest form."""
    peer: bool = False
    """Whether it is no richer than the plain form: it need not predict clearly better, only better."""
    rank: int | None = None
    """Where its stage stands among the others, if not at its usual place."""
    beside: tuple[str, ...] = ()
    """Causes, one of which must be there for it to differ from another form; none: it always does."""
    needs: str = "recordings in which it can act"
    """What to record where the cause cannot show."""
    grown: Callable[[np.ndarray, Setting], list[float] | list[list[float]]] | None = None
    """The family's plain form, given by its coordinates, as this form has it: where descents start, one or
    several."""
    kinds: tuple[Kind, ...] = ()
    """Signals of these kinds are the family's own: what follows them may be the fault of its form."""
    between_frames: bool = False
    """Whether what a motion did between two frames, which nobody saw, imitates it."""
    sizes: tuple[str, ...] = ()
    """Parameters of which the largest is its size; the first that is reported unless given."""
    none: float = 0.0
    """Value of that parameter without the effect."""
    shrinks: bool = False
    """Whether that parameter falls as the effect grows."""

    @property
    def moves(self) -> np.ndarray:
        """Which coordinates a descent changes (p,) bool."""
        return np.array([value.step > 0 for value in self.values], dtype=bool)

    @property
    def low(self) -> np.ndarray:
        """Lower bounds (p,)."""
        return np.array([value.low for value in self.values])

    @property
    def high(self) -> np.ndarray:
        """Upper bounds (p,)."""
        return np.array([value.high for value in self.values])


@cache
def beside_damping(form: Form) -> Form:
    """The same law of what the contact's springs bear alone, where damping bears something as well."""

    def build(values: np.ndarray, setting: Setting) -> Stages:
        stages = form.build(values, setting)
        return tuple(
            replace(stage, elastic=True) if isinstance(stage, CoverLaw) else stage for stage in stages
        )

    return replace(
        form,
        label=f"{form.label}, beside damping",
        build=build,
        possible=lambda setting: setting.damped and form.possible(setting),
        screened=False,
        peer=True,
        grown=lambda values, setting: values.tolist(),
    )
