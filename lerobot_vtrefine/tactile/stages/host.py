"""Stages of sampling and transport: when a reading was taken, and how long the host repeats it."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar, override

import numpy as np
import torch

from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import (
    Frame,
    Stage,
    State,
    Traits,
    as_tuple,
    parameter,
    register,
)
from lerobot_vtrefine.tactile.stages.signals import delayed, followed, low_passed, sampled, share_gone

PHASES = 16
"""Instants over which the mean reading of a free-running board is taken."""
HISTORY_FRAMES = 16
"""Frames that a delay remembers while simulating; replay has no such limit."""


def periods_gone(time_s: Any, period_s: Any, phase: Any = 0.0) -> Any:
    """Periods that have gone by; a time at a period's very end, but for rounding, is in the next."""
    return time_s / period_s + phase + 1e-6


def taken_at_frames(times_s: np.ndarray, period_s: float, frame_s: float) -> np.ndarray:
    """When what is held at times (T,) was read: at the first frame after the present period began [s]."""
    begun = np.floor(periods_gone(times_s, period_s)) * period_s
    return np.minimum(np.ceil(begun / frame_s - 1e-3) * frame_s, times_s)


@dataclass(frozen=True)
class Delay(Stage):
    """Base: every row is read `delay_s` (rows,) before the frame's time; linear between frames."""

    domain: ClassVar[str] = "counts"
    has_state: ClassVar[bool] = True
    proportional: ClassVar[bool] = True

    def delay_s(self, rows: int, like: torch.Tensor, frame: Frame) -> torch.Tensor:
        """Delay of each row at a frame, (..., R, 1) [s]."""
        raise NotImplementedError

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        return {
            "history": np.zeros((pads, HISTORY_FRAMES, layout.rows, layout.cols), dtype=np.float32),
            "age_s": np.zeros((pads, HISTORY_FRAMES), dtype=np.float32),
            "frames": np.zeros(pads, dtype=np.int64),
        }

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        delay = self.delay_s(x.shape[-2], x, frame)
        # The oldest remembered frame is HISTORY_FRAMES - 1 steps old: a longer delay would silently be cut.
        if frame.dt_s > 0.0 and float(delay.max()) > (HISTORY_FRAMES - 1) * frame.dt_s:
            limit = f"{HISTORY_FRAMES - 1} frames of {frame.dt_s:g} s"
            raise ValueError(f"{self.name}: a delay of {float(delay.max()):g} s exceeds {limit}")
        first = (state["frames"] == 0)[..., None, None, None]
        past = torch.where(first, x.unsqueeze(-3), state["history"][..., :-1, :, :])
        history = torch.cat([x.unsqueeze(-3), past], dim=-3)
        age = torch.cat(
            [torch.zeros_like(state["age_s"][..., :1]), state["age_s"][..., :-1] + frame.dt_s], dim=-1
        )
        value = x
        for k in range(HISTORY_FRAMES - 1):
            weight = share_gone(delay, age[..., k, None, None], age[..., k + 1, None, None])
            value = value + weight * (history[..., k + 1, :, :] - history[..., k, :, :])
        return value, {"history": history, "age_s": age, "frames": state["frames"] + 1}

    @override
    def sequence(self, x: torch.Tensor, times_s: torch.Tensor, frame: Frame) -> torch.Tensor:
        return delayed(x, times_s, self.delay_s(x.shape[-2], x, frame))


@register
@dataclass(frozen=True)
class Latency(Delay):
    """Readings are `tau_s` old when the host stamps them.

    The part `smoothing` of that age is a one-pole filter's (of the board or its driver), the rest a delay.
    Where readings queue up, the delay grows by `growth` with every second of the recording, or falls to zero.
    """

    name: ClassVar[str] = "latency"
    rank: ClassVar[int] = 70
    alike: ClassVar[bool] = True
    tau_s: float = parameter(0.01, "s", 0.0, 0.05)
    smoothing: float = parameter(0.0, "1", 0.0, 0.0, maximum=1.0)
    growth: float = parameter(0.0, "1", 0.0, 0.0, minimum=None, maximum=1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.smoothing, torch.Tensor) and self.smoothing > 1.0:
            raise ValueError(f"latency.smoothing must be at most 1, got {self.smoothing:g}")

    @property
    def plain(self) -> bool:
        """Whether it is a delay alone."""
        return not isinstance(self.smoothing, torch.Tensor) and self.smoothing == 0.0

    @property
    def _grows(self) -> bool:
        return isinstance(self.growth, torch.Tensor) or self.growth != 0.0

    def late_s(self, time_s: Any) -> Any:
        """Delay so long after the recording's start [s]."""
        late = (1.0 - self.smoothing) * self.tau_s
        return (late + self.growth * torch.as_tensor(time_s)).clamp(min=0.0) if self._grows else late

    @override
    def delay_s(self, rows: int, like: torch.Tensor, frame: Frame) -> torch.Tensor:
        delay = torch.as_tensor(self.late_s(frame.time_s), dtype=like.dtype, device=like.device)
        return delay.reshape(-1, *(1,) * (like.ndim - 1))

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        found = super().initial(layout, pads)
        if not self.plain:
            shape = (pads, layout.rows, layout.cols)
            found |= {name: np.zeros(shape, dtype=np.float32) for name in ("before", "smooth")}
        return found

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        late, new = super().step(x, state, frame)
        if self.plain:
            return late, new
        first = (state["frames"] == 0)[..., None, None]
        before = torch.where(first, late, state["before"])
        smooth = torch.where(first, late, state["smooth"])
        smooth = followed(smooth, before, late, frame.dt_s, self._filter_s)
        return smooth, {**new, "before": late, "smooth": smooth}

    @property
    def _filter_s(self) -> Any:
        """Time constant of the filter [s]."""
        tau_s = self.smoothing * self.tau_s
        return tau_s.clamp(min=1e-6) if isinstance(tau_s, torch.Tensor) else max(tau_s, 1e-6)

    @override
    def sequence(self, x: torch.Tensor, times_s: torch.Tensor, frame: Frame) -> torch.Tensor:
        if self._grows:
            late = sampled(x, times_s, times_s - self.late_s(times_s))
        else:
            late = super().sequence(x, times_s, frame)
        return late if self.plain else late[:1] + low_passed(late - late[:1], times_s, float(self._filter_s))


@register
@dataclass(frozen=True)
class ScanSkew(Delay):
    """Rows are read one after the other: row r is sampled skew_s * r / (R - 1) before the frame's time.

    A board that goes along the rows as well reads column c another `cols_s` * c / (C - 1) earlier: of one
    that reads element by element, the smaller of both is what one line takes. `rows_s`, delays at equal steps
    from the first row to the last and straight between them, stand in for `skew_s` where a board reads its
    rows in another rhythm; `skew_s` is then their slope alone.
    """

    name: ClassVar[str] = "scan_skew"
    rank: ClassVar[int] = 72
    skew_s: float = parameter(0.008, "s", 0.0, 0.043, minimum=None)
    rows_s: tuple[float, ...] = ()
    cols_s: float = parameter(0.0, "s", 0.0, 0.0, minimum=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "rows_s", as_tuple(self.rows_s))
        if len(self.rows_s) == 1 or not all(math.isfinite(value) for value in self.rows_s):
            raise ValueError("scan_skew.rows_s needs at least two finite numbers")

    def late_s(self, row: torch.Tensor, col: torch.Tensor, rows: int, cols: int) -> torch.Tensor:
        """Delay of taxels in these rows and columns of a rows x cols pad [s]."""
        share = row / max(rows - 1, 1)
        if self.rows_s:
            known = np.interp(share.cpu().numpy(), np.linspace(0.0, 1.0, len(self.rows_s)), self.rows_s)
            late = torch.as_tensor(known, dtype=row.dtype, device=row.device)
        else:
            late = self.skew_s * share
        return late + self.cols_s * col / max(cols - 1, 1)

    @override
    def delay_s(self, rows: int, like: torch.Tensor, frame: Frame) -> torch.Tensor:
        row, col = (torch.arange(n, dtype=like.dtype, device=like.device) for n in (rows, like.shape[-1]))
        # Without a delay along them, the columns of a row are read as one.
        along = isinstance(self.cols_s, torch.Tensor) or self.cols_s != 0.0
        return self.late_s(row[:, None], col if along else col[:1], rows, like.shape[-1])


@register
@dataclass(frozen=True)
class SampleAndHold(Stage):
    """A new reading reaches the host every `period_s`; between, the last one is repeated.

    Periods are counted from the episode's start or, where the board runs `free` of the host, from an instant
    drawn for every episode. Where they are irregular (`period_s` is their mean), readings are `lag_s` older
    than one of `ages_s`, each of which is as likely. With `frame_s` the reading is that of the first frame,
    of frames this far apart, after the period began. Rows of a free board that have converters of their own
    are refreshed in `groups`, each from an instant of its own: the number of every row's group, from the
    first row to the last.
    """

    name: ClassVar[str] = "sample_and_hold"
    domain: ClassVar[str] = "counts"
    rank: ClassVar[int] = 90
    has_state: ClassVar[bool] = True
    proportional: ClassVar[bool] = True
    period_s: float = parameter(0.043, "s", 0.01, 0.1, minimum=1e-6)
    free: bool = False
    ages_s: tuple[float, ...] = ()
    lag_s: float = parameter(0.0, "s", 0.0, 0.0)
    frame_s: float = parameter(0.0, "s", 0.0, 0.0)
    groups: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "ages_s", as_tuple(self.ages_s))
        object.__setattr__(self, "groups", as_tuple(self.groups))
        if self.groups and (not self.free or min(self.groups) < 0):
            raise ValueError("sample_and_hold.groups needs a free board and numbers that are not negative")
        if not all(math.isfinite(age) and age >= 0 for age in self.ages_s):
            raise ValueError("sample_and_hold.ages_s needs finite numbers that are not negative")

    @override
    def traits(self, layout: PadLayout, pads: int, rng: np.random.Generator) -> Traits:
        if not (self.free or self.ages_s):
            return {}
        phase = rng.uniform(0.0, 1.0, (pads, max(self.groups, default=0) + 1, 1))
        every = np.arange(layout.rows)
        return {"phase": phase[:, self.group_of(every, layout.rows)] if self.groups else phase}

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        return {
            "held": np.zeros((pads, layout.rows, layout.cols), dtype=np.float32),
            "slot": np.full((pads, layout.rows if self.groups else 1, 1), -1, dtype=np.int64),
        }

    def group_of(self, row: np.ndarray, rows: int) -> np.ndarray:
        """Number of the group that each of these rows of a pad belongs to."""
        return np.array(self.groups)[row * len(self.groups) // rows]

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        time_s = torch.as_tensor(frame.time_s, dtype=torch.float64, device=x.device)
        phase = state.get("phase", 0.0)
        slot = torch.floor(periods_gone(time_s, self.period_s, phase))
        slot = slot.to(torch.int64).expand(state["slot"].shape).clone()
        held = torch.where(slot != state["slot"], x, state["held"])
        return held, {**state, "held": held, "slot": slot}

    @override
    def sequence(self, x: torch.Tensor, times_s: torch.Tensor, frame: Frame) -> torch.Tensor:
        """As `step` frame by frame; of a free board, whose instants nobody knows, the mean over them."""
        if not (self.free or self.ages_s):
            return self.held(x, times_s)
        even = [self.period_s * (k + 0.5) / PHASES for k in range(PHASES)]
        even = [age - age % self.frame_s for age in even] if self.frame_s else even
        ages = [self.lag_s + age for age in self.ages_s] or even
        return torch.stack([sampled(x, times_s, times_s - age) for age in ages]).mean(dim=0)

    def held(self, x: torch.Tensor, times_s: torch.Tensor) -> torch.Tensor:
        """x (T, ...) as a board of regular periods repeats it; one begins at time zero."""
        if self.frame_s:
            taken_s = taken_at_frames(times_s.cpu().numpy(), self.period_s, self.frame_s)
            return sampled(x, times_s, torch.from_numpy(taken_s).to(times_s))
        return x[self.shown(times_s)]

    def shown(self, times_s: torch.Tensor, phase: float = 0.0) -> torch.Tensor:
        """Number of the time whose reading is there at each of times (T,): the first one of its period."""
        slot = torch.floor(periods_gone(times_s, self.period_s, phase))
        begun = torch.ones_like(slot, dtype=torch.bool)
        begun[1:] = slot[1:] != slot[:-1]
        return begun.nonzero()[begun.cumsum(0) - 1, 0]
