"""What a stage of the sensor model is, and the registry of their names.

A stage maps a batch of pad images (..., R, C) to another. It is a frozen dataclass of parameters in SI units
with one pure function `step`; memory between frames is passed in and out explicitly. Parameters may be
tensors that broadcast against (..., R, C), which is how each environment gets its own value.
"""

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np
import torch

from lerobot_vtrefine.tactile.layout import PadLayout

State = dict[str, torch.Tensor]
Traits = dict[str, np.ndarray]

DOMAINS = ("depth", "contact", "force", "gain", "counts")
"""What a stage reads and writes, in the order in which a model lists them: depth [m] to depth, depth to
force [N],
force to force, force to counts, counts to counts."""


@dataclass(frozen=True)
class Frame:
    """What a stage may know about the frame that it processes."""

    layout: PadLayout
    dt_s: float = 0.0
    """Time since the previous frame [s]."""
    time_s: torch.Tensor | float = 0.0
    """Session time, broadcastable to (..., R, C) [s]."""
    stiffness_n_per_m: torch.Tensor | float = 0.0
    """One taxel's stiffness in the contact stage [N/m]."""
    temperature_c: torch.Tensor | None = None
    """Temperature, broadcastable to (..., R, C); None where nobody measured it [degrees Celsius]."""
    load_conserving: bool = False
    """Whether the taxels' sum is a measured or solved load, which mechanics must not change."""
    borne: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None
    """What each of J earlier recordings pressed a taxel with at most (J, ..., R, C) [m; N where the load is
    known], how long before this recording's first frame [s], and all its loading together [m; N]; None where
    nobody knows."""


LARGEST = {
    "1": 1e3,
    "m": 1.0,
    "rad": math.pi,
    "s": 1e6,
    "N": 1e6,
    "degC": 1e3,
    "counts": 1e9,
    "counts/N": 1e12,
    "counts/s": 1e6,
    "counts/degC": 1e6,
    "1/counts": 1e3,
    "N/m": 1e12,
    "N*s/m": 1e12,
    "N/m^3": 1e15,
}
"""What no pad's parameter exceeds, by unit: far from any real one, and far from where numbers break down."""


def parameter(
    default: Any,
    unit: str,
    low: float,
    high: float,
    minimum: float | None = 0.0,
    maximum: float | None = None,
) -> Any:
    """Dataclass field of a stage's parameter.

    Args:
        unit: SI unit, "1" for none.
        low, high: range for randomisation.
        minimum: smallest valid value; None if any finite number is valid.
        maximum: largest valid size; by default the unit's in `LARGEST`.
    """
    ends = {"minimum": minimum, "maximum": LARGEST[unit] if maximum is None else maximum}
    return field(default=default, metadata={"unit": unit, "range": (low, high), **ends})


@dataclass(frozen=True)
class Stage:
    """Base of all stages; subclasses set the class variables and override `step`."""

    name: ClassVar[str] = ""
    domain: ClassVar[str] = ""
    rank: ClassVar[int] = 0
    """Canonical place among the stages; decides where `SensorModel.with_stage` puts a stage."""
    has_state: ClassVar[bool] = False
    """Whether `step` needs its own previous state, so that frames must be processed in order."""
    stochastic: ClassVar[bool] = False
    alike: ClassVar[bool] = False
    """Whether every taxel follows the same law by itself: fits run it on the taxels that answer, alone."""
    spreads: ClassVar[bool] = False
    """Whether it moves force from taxel to taxel, in proportion."""
    proportional: ClassVar[bool] = False
    """Whether twice the force or reading, in all taxels and frames, gives twice the result."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value, minimum = getattr(self, item.name), item.metadata.get("minimum")
            if "unit" not in item.metadata or isinstance(value, torch.Tensor):
                continue
            for number in value if isinstance(value, tuple) else (value,):
                if not isinstance(number, int | float) or not np.isfinite(number):
                    raise ValueError(f"{self.name}.{item.name} must be a finite number, got {number!r}")
                if minimum is not None and number < minimum:
                    raise ValueError(f"{self.name}.{item.name} must be at least {minimum:g}, got {number:g}")

    @property
    def rate_free(self) -> bool:
        """Whether a memory follows the order of the frames, whatever their times."""
        return False

    def traits(self, layout: PadLayout, pads: int, rng: np.random.Generator) -> Traits:
        """What differs between specimens of the sensor, drawn once per episode of one environment: name ->
        (P, ...)."""
        return {}

    def initial(self, layout: PadLayout, pads: int) -> Traits:
        """State of one untouched environment: name -> (P, ...)."""
        return {}

    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        """Process one frame of a batch: x (..., R, C), state tensors with the same leading dimensions.

        Returns the result (..., R, C) and the new state (traits are returned unchanged). Neither input is
        modified.
        """
        raise NotImplementedError

    def sequence(self, x: torch.Tensor, times_s: torch.Tensor, frame: Frame) -> torch.Tensor:
        """Process a recording: x (T, ..., R, C) at times (T,) [s], starting untouched and without traits.

        The same as calling `step` frame by frame.
        """
        if not self.has_state:
            shape = (-1,) + (1,) * (x.ndim - 1)
            return self.step(x, {}, replace(frame, time_s=times_s.view(shape)))[0]
        one = self.initial(frame.layout, 1)
        lead = x.shape[1:-2]
        state = {
            key: torch.as_tensor(value[0], device=x.device).expand((*lead, *value.shape[1:]))
            for key, value in one.items()
        }
        outputs, previous = [], times_s[0]
        for value, time_s in zip(x, times_s, strict=True):
            moment = replace(frame, time_s=time_s, dt_s=float(time_s - previous))
            value, state = self.step(value, state, moment)
            outputs.append(value)
            previous = time_s
        return torch.stack(outputs)


STAGES: dict[str, type[Stage]] = {}


def register[StageType: Stage](cls: type[StageType]) -> type[StageType]:
    """Class decorator: make a stage known by its name."""
    if cls.domain not in DOMAINS:
        raise ValueError(f"stage {cls.__name__}: domain must be one of {', '.join(DOMAINS)}")
    STAGES[cls.name] = cls
    return cls


def stage_class(name: str) -> type[Stage]:
    """Look a stage up by name; ValueError lists the valid names."""
    if name not in STAGES:
        raise ValueError(f"unknown stage {name!r}; valid names: {', '.join(sorted(STAGES))}")
    return STAGES[name]


def as_tuple(value: Any) -> Any:
    """Nested lists as nested tuples, so that stages stay hashable and comparable."""
    return tuple(as_tuple(item) for item in value) if isinstance(value, list | tuple | np.ndarray) else value


def paired(stage: str, first: Any, second: Any, names: str = "tau_s and fraction") -> list[tuple[Any, Any]]:
    """Numbers or equally long lists of them, branch by branch."""
    firsts = first if isinstance(first, tuple) else (first,)
    seconds = second if isinstance(second, tuple) else (second,)
    if len(firsts) != len(seconds) or not firsts:
        raise ValueError(f"{stage}: {names} need the same number of branches, got {firsts} and {seconds}")
    return list(zip(firsts, seconds, strict=True))


def as_map(name: str, values: Any) -> Any:
    """Rows of a map as a nested tuple, a number as it is; ValueError where rows differ in length."""
    rows = as_tuple(values)
    if isinstance(rows, tuple) and (not rows or not rows[0] or len({len(row) for row in rows}) > 1):
        raise ValueError(f"{name} must hold equally long rows of a number per taxel")
    return rows


def taxel_map(values: Any, like: torch.Tensor) -> torch.Tensor:
    """A number or nested (R, C) sequence as a tensor that broadcasts against `like` (..., R, C).

    Raises ValueError for a map of another pad.
    """
    if isinstance(values, torch.Tensor):
        return values
    array = np.asarray(values, dtype=np.float32)
    if array.ndim == 2 and array.shape not in ((1, 1), tuple(like.shape[-2:])):
        made, pad = (" x ".join(map(str, shape)) for shape in (array.shape, like.shape[-2:]))
        raise ValueError(f"the sensor model holds a map of {made} taxels, but the pad has {pad}")
    return torch.as_tensor(array, device=like.device).to(like.dtype)
