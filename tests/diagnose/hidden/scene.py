"""What an effect may know: the pad under test and the trial on a fine time grid."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hidden.rig import Rig

STAGES = ("surface", "law", "force", "counts", "additive", "frame", "when", "hold")
"""Where an effect acts: where the face is [m], the elastic law [m -> N], force in the layers [N], readings
above idle [counts], additions to them, additions per frame, the sampling time and the host's grid [s]."""


@dataclass(frozen=True)
class Pad:
    """One specimen: stiffness [N/m], damping [N s/m], gain [counts/N]; idle levels (N,) [counts]."""

    rig: Rig
    k_n: float
    k_d: float
    gain: float
    idle: np.ndarray

    @property
    def peak(self) -> float:
        """Reading above idle of the deepest press."""
        return self.k_n * self.rig.reach_m * self.gain

    @property
    def soft_m(self) -> float:
        return self.rig.reach_m


@dataclass
class Scene:
    """One trial. Arrays over the fine grid: (T,), or (T, N) where they differ between taxels."""

    pad: Pad
    time_s: np.ndarray
    start_s: float
    order: int
    velocity: np.ndarray
    height: np.ndarray
    rate: np.ndarray
    temperature_c: np.ndarray
    rng: np.random.Generator
    """Chance within this trial."""

    @property
    def dt(self) -> float:
        return float(self.time_s[1] - self.time_s[0])

    @property
    def loaded(self) -> np.ndarray:
        """Whether the indenter touches the pad, (T,)."""
        return (self.height > 0).any(axis=1)

    def grid(self, values: np.ndarray) -> np.ndarray:
        """(T, N) as (T, R, C)."""
        return values.reshape(len(values), self.pad.rig.rows, self.pad.rig.cols)


Apply = Callable[[Scene, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Effect:
    """One departure from the baseline. `params` holds the contract's parameters where its form has them."""

    family: str
    form: str
    stage: str
    apply: Apply
    params: dict[str, float] = field(default_factory=dict)
