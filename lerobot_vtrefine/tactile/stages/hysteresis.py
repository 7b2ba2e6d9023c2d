"""Rate-free loops: loading and unloading differ at the same depth, whatever the speed. One stage per law.

A law is how a memory moves with every frame, and what reading goes with it. A simulation moves it frame by
frame, a replay or a fit through all frames of a recording.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, override

import numpy as np
import torch

from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import (
    Frame,
    State,
    Traits,
    as_tuple,
    paired,
    parameter,
    register,
)
from lerobot_vtrefine.tactile.stages.cover import CoverLaw

BLOCK_FRAMES = 12
"""Frames that are followed at once, wherever such blocks of them begin."""
NARROW = 160
"""Memories side by side, up to which an operation of NumPy costs more to begin than to do."""


def memories(follow: Callable[..., np.ndarray], *inputs: np.ndarray) -> np.ndarray:
    """A memory that is zero at first, after every frame: (T, ...); follow(memory, *the frame's inputs).

    In NumPy, whose operations take a fraction of the time to begin.
    """
    out = np.empty_like(inputs[0])
    memory = np.zeros_like(out[:1].sum(axis=0))
    for frame, now in enumerate(zip(*inputs, strict=True)):
        out[frame] = memory = follow(memory, *now)
    return out


def kept_between(low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
    """`memories` of np.clip between bounds (T, ...), in the place of the array `high`; low <= high."""
    lower, upper = (np.ascontiguousarray(bound.cpu().numpy()) for bound in (low, high))
    kept = _kept_in_blocks if lower[:1].size <= NARROW else _kept_frame_by_frame
    kept(lower, upper, np.zeros_like(lower[:1].sum(axis=0)))
    return torch.from_numpy(upper).to(low)


def _kept_frame_by_frame(lower: np.ndarray, upper: np.ndarray, memory: np.ndarray) -> np.ndarray:
    """Where a memory lies between its bounds (T, ...), in the place of `upper`; returns the last one."""
    for line, top in zip(lower, upper, strict=True):
        memory = np.maximum(np.minimum(memory, top, out=top), line, out=top)
    return memory


def _kept_in_blocks(lower: np.ndarray, upper: np.ndarray, memory: np.ndarray) -> None:
    """The same, frame by frame in all blocks at once: what bounds do one after the other, two bounds do."""
    count = len(lower) // BLOCK_FRAMES
    whole, shape = count * BLOCK_FRAMES, (count, BLOCK_FRAMES, *lower.shape[1:])
    lows, highs = (bounds[:whole].reshape(shape).swapaxes(0, 1) for bounds in (lower.copy(), upper))
    for (low, high), (next_low, next_high) in pairwise(zip(lows, highs, strict=True)):
        np.maximum(np.minimum(high, next_high, out=next_high), next_low, out=next_high)
        # Beyond both of its bounds, a memory ends at the nearer one.
        np.minimum(np.maximum(low, next_low, out=next_low), next_high, out=next_low)
    before = np.empty_like(ends := highs[-1].copy())
    last = _kept_frame_by_frame(lows[-1], ends, memory)
    before[:1], before[1:] = memory, ends[:-1]
    np.maximum(np.minimum(before, highs, out=highs), lows, out=highs)
    _kept_frame_by_frame(lower[whole:], upper[whole:], last)


@dataclass(frozen=True)
class Loop(CoverLaw):
    """Base of the laws."""

    rank: ClassVar[int] = 36
    has_state: ClassVar[bool] = True

    @property
    @override
    def rate_free(self) -> bool:
        return True


@dataclass(frozen=True)
class Bounded(Loop):
    """Base of the laws whose memories rest unless the force's bounds push them: low <= memory <= high."""

    def _bounds(self, x: torch.Tensor, frame: Frame) -> Iterator[tuple[str, torch.Tensor, torch.Tensor]]:
        """Name of every memory, and between what it may lie at f = x [N]: above an array of its own."""
        raise NotImplementedError

    def reading(self, x: torch.Tensor, kept: Iterable[torch.Tensor]) -> torch.Tensor:
        """What the pad feels of the force x with its memories where they are kept [N]."""
        raise NotImplementedError

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        kept = {name: torch.clamp(state[name], low, high) for name, low, high in self._bounds(x, frame)}
        return self.reading(x, kept.values()), {**state, **kept}

    @override
    def sequence(self, x: torch.Tensor, times_s: torch.Tensor, frame: Frame) -> torch.Tensor:
        return self.reading(x, self.kept(x, frame))

    def kept(self, x: torch.Tensor, frame: Frame) -> Iterator[torch.Tensor]:
        """Every memory of a recording x (T, ...), after each of its frames."""
        return (kept_between(low, high) for _, low, high in self._bounds(x, frame))


@dataclass(frozen=True)
class Play(Bounded):
    """Play operators (Prandtl-Ishlinskii): f + sum_j fraction_j * (play_j(f) - f).

    A play operator follows the depth f / stiffness with a dead band of full width `width_m`, so that loading
    and unloading at the same depth differ by fraction * width_m * stiffness. Without contact it returns to
    zero. `fraction` and `width_m` are numbers or equally long lists (several operators make loops of any
    shape). A positive fraction reads less while loading, a negative one more, as a cover that dissipates
    energy does.
    """

    above: ClassVar[float] = 0.5
    """Part of the band that lies above f."""
    rests: ClassVar[bool] = False
    """Whether the operator stays where it was let go."""
    fraction: float | tuple[float, ...] = parameter(0.15, "1", 0.0, 0.3, minimum=None)
    width_m: float | tuple[float, ...] = parameter(2e-4, "m", 5e-5, 5e-4)

    def __post_init__(self) -> None:
        for name in ("fraction", "width_m"):
            object.__setattr__(self, name, as_tuple(getattr(self, name)))
        super().__post_init__()
        self._operators()

    def _operators(self) -> list[tuple[str, Any, Any]]:
        """State's name, fraction and width of every play operator."""
        pairs = paired(self.name, self.fraction, self.width_m, "fraction and width_m")
        return [(f"play_{j}" if j else "play", fraction, width) for j, (fraction, width) in enumerate(pairs)]

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        shape = (pads, layout.rows, layout.cols)
        return {name: np.zeros(shape, dtype=np.float32) for name, _, _ in self._operators()}

    @override
    def _bounds(self, x: torch.Tensor, frame: Frame) -> Iterator[tuple[str, torch.Tensor, torch.Tensor]]:
        touching = x > 0
        for name, _, width_m in self._operators():
            width = width_m * frame.stiffness_n_per_m
            low = (x + (self.above - 1.0) * width).clamp_(min=0.0)
            high = (x + self.above * width).clamp_(min=0.0)
            yield name, low, high if self.rests else high.mul_(touching)

    @override
    def reading(self, x: torch.Tensor, kept: Iterable[torch.Tensor]) -> torch.Tensor:
        fractions = [fraction for _, fraction, _ in self._operators()]
        looped = (1.0 - sum(fractions)) * x
        for fraction, play in zip(fractions, kept, strict=True):
            if isinstance(fraction, torch.Tensor):
                looped.add_(fraction * play)
            else:
                looped.add_(play, alpha=fraction)
        return looped.clamp_(min=0.0)


@register
@dataclass(frozen=True)
class Hysteresis(Play):
    """Play operators whose band lies evenly about f."""

    name: ClassVar[str] = "hysteresis"


@register
@dataclass(frozen=True)
class RestingHysteresis(Play):
    """The same, kept without contact: readings rest above idle once they were let go."""

    name: ClassVar[str] = "resting_hysteresis"
    rests: ClassVar[bool] = True


@register
@dataclass(frozen=True)
class LoadingHysteresis(Play):
    """The band lies behind f: only loading differs from f, as sums of relays have it."""

    name: ClassVar[str] = "loading_hysteresis"
    above: ClassVar[float] = 0.0


@register
@dataclass(frozen=True)
class ProportionalHysteresis(Loop):
    """A loop as wide as the load is high: f (1 + fraction b), with b from 0 to 1 over `width_m` of unloading.

    Loading takes b back, and it is zero without contact.
    """

    name: ClassVar[str] = "proportional_hysteresis"
    fraction: float = parameter(0.15, "1", 0.0, 0.3, minimum=None)
    width_m: float = parameter(2e-4, "m", 5e-5, 5e-4)

    @staticmethod
    def _moves(unloaded: Any, touching: Any) -> tuple[Any, ...]:
        """What moves b in a frame, of tensors or arrays: least, change and most.

        Args:
            unloaded: since the frame before, as a part of the width.
            touching: 1 where there is contact, else 0.
        """
        return 0.0 * unloaded, unloaded, touching

    @staticmethod
    def _turned(back: Any, least: Any, change: Any, most: Any, /) -> Any:
        """b after a frame."""
        return (back + change).clip(least, most)

    def _width(self, x: torch.Tensor, frame: Frame) -> torch.Tensor:
        """Of the loop [N]."""
        width = torch.as_tensor(self.width_m * frame.stiffness_n_per_m, dtype=x.dtype, device=x.device)
        return width.clamp(min=1e-12)

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        shape = (pads, layout.rows, layout.cols)
        return {name: np.zeros(shape, dtype=np.float32) for name in ("back", "before")}

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        unloaded = (state["before"] - x) / self._width(x, frame)
        back = self._turned(state["back"], *self._moves(unloaded, (x > 0).to(x)))
        return (x * (1.0 + self.fraction * back)).clamp(min=0.0), {**state, "back": back, "before": x}

    @override
    def sequence(self, x: torch.Tensor, times_s: torch.Tensor, frame: Frame) -> torch.Tensor:
        before = torch.cat([torch.zeros_like(x[:1]), x[:-1]])
        unloaded = (before - x) / self._width(x, frame)
        moves = self._moves(*(item.cpu().numpy() for item in (unloaded, (x > 0).to(x))))
        back = torch.from_numpy(memories(self._turned, *moves)).to(x)
        return (x * (1.0 + self.fraction * back)).clamp(min=0.0)


@register
@dataclass(frozen=True)
class DuhemHysteresis(ProportionalHysteresis):
    """The same where b turns gradually, by a part of what is left of its way for every bit of load (Duhem's
    and Dahl's models): 63 % of it over `width_m`.
    """

    name: ClassVar[str] = "duhem_hysteresis"

    @override
    @staticmethod
    def _moves(unloaded: Any, touching: Any) -> tuple[Any, ...]:
        """Where b's way ends, the part of it that is left, and whether there is contact (1 or 0)."""
        return 1.0 * (unloaded > 0), math.e ** -abs(unloaded), touching

    @override
    @staticmethod
    def _turned(back: Any, end: Any, left: Any, touching: Any, /) -> Any:
        return (end + (back - end) * left) * touching


@register
@dataclass(frozen=True)
class PeakHysteresis(Bounded):
    """A loop that closes at both ends: f (1 + 4 fraction s (1 - s)), s = f / (largest f of this contact)."""

    name: ClassVar[str] = "peak_hysteresis"
    fraction: float = parameter(0.15, "1", 0.0, 0.3, minimum=None)

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        return {"peak": np.zeros((pads, layout.rows, layout.cols), dtype=np.float32)}

    @override
    def _bounds(self, x: torch.Tensor, frame: Frame) -> Iterator[tuple[str, torch.Tensor, torch.Tensor]]:
        # Without contact there is no peak but f itself.
        yield "peak", x, torch.where(x > 0, torch.inf, x)

    @override
    def reading(self, x: torch.Tensor, kept: Iterable[torch.Tensor]) -> torch.Tensor:
        (peak,) = kept
        share = x / peak.clamp(min=1e-12)
        return (x * (1.0 + 4.0 * self.fraction * share * (1.0 - share))).clamp(min=0.0)


BY_LOOP: dict[str, type[Loop]] = {
    "even": Hysteresis,
    "resting": RestingHysteresis,
    "behind": LoadingHysteresis,
    "scaled": ProportionalHysteresis,
    "peak": PeakHysteresis,
}
"""`loop` in earlier files, which held all five as one stage -> the law's own."""


def without_loop(item: dict[str, Any]) -> dict[str, Any]:
    """A stage of a file in today's names; ValueError for a loop that there never was."""
    if item.get("stage") != Hysteresis.name or "loop" not in item:
        return item
    loop = item["loop"]
    if not isinstance(loop, str) or loop not in BY_LOOP:
        raise ValueError(f"hysteresis.loop must be one of {', '.join(BY_LOOP)}, got {loop!r:.60}")
    unused = ("loop", "width_m") if loop == "peak" else ("loop",)
    return {key: value for key, value in item.items() if key not in unused} | {"stage": BY_LOOP[loop].name}
