"""Readout stages: force to conductance, gains, leakage, and 8-bit counts on an idle level."""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import ClassVar, override

import numpy as np
import torch

from lerobot_vtrefine.files import limits
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.noise import noise_frames
from lerobot_vtrefine.tactile.stages.base import (
    LARGEST,
    Frame,
    Stage,
    State,
    Traits,
    as_map,
    as_tuple,
    parameter,
    register,
    taxel_map,
)


@register
@dataclass(frozen=True)
class Gain(Stage):
    """Reading of a lone taxel before any sharing: counts = counts_per_n * f (conductance is proportional to
    force)."""

    name: ClassVar[str] = "gain"
    domain: ClassVar[str] = "gain"
    rank: ClassVar[int] = 40
    alike: ClassVar[bool] = True
    counts_per_n: float = parameter(500.0, "counts/N", 250.0, 1000.0)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        return x * self.counts_per_n, state


@register
@dataclass(frozen=True)
class TaxelGainSpread(Stage):
    """Each taxel has its own gain: `map` (R, C) factors, or log-normal with deviation `sigma`, drawn per
    episode."""

    name: ClassVar[str] = "taxel_gain_spread"
    domain: ClassVar[str] = "counts"
    rank: ClassVar[int] = 50
    proportional: ClassVar[bool] = True
    sigma: float = parameter(0.1, "1", 0.0, 0.3, maximum=3.0)
    map: tuple[tuple[float, ...], ...] | None = limits(maximum=1e6, default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "map", as_map("taxel_gain_spread.map", self.map))

    @override
    def traits(self, layout: PadLayout, pads: int, rng: np.random.Generator) -> Traits:
        if self.map is not None:
            return {}
        return {"deviate": rng.standard_normal((pads, layout.rows, layout.cols)).astype(np.float32)}

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        if self.map is not None:
            return x * taxel_map(self.map, x), state
        if "deviate" not in state:
            return x, state
        return x * torch.exp(self.sigma * state["deviate"]), state


@register
@dataclass(frozen=True)
class DeadTaxels(Stage):
    """Taxels that no longer answer: those in `taxels` ((r, c) pairs), whole `rows` and `cols`, and each
    further one with `probability`, drawn per episode. Those in `taxels` may still answer with a part `left`
    of what they should, one number for each; none: with nothing."""

    name: ClassVar[str] = "dead_taxels"
    domain: ClassVar[str] = "counts"
    rank: ClassVar[int] = 52
    proportional: ClassVar[bool] = True
    taxels: tuple[tuple[int, int], ...] = limits(0, 9999, default=())
    rows: tuple[int, ...] = limits(0, 9999, default=())
    cols: tuple[int, ...] = limits(0, 9999, default=())
    left: tuple[float, ...] = limits(0, 1, default=())
    probability: float = parameter(0.0, "1", 0.0, 0.02, maximum=1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("taxels", "rows", "cols", "left"):
            object.__setattr__(self, name, as_tuple(getattr(self, name)))
        if len(self.left) not in (0, len(self.taxels)):
            raise ValueError(f"dead_taxels: {len(self.left)} numbers in left for {len(self.taxels)} taxels")

    def alive(self, layout: PadLayout) -> np.ndarray:
        """The part (R, C) that every taxel answers with; ValueError when a listed one is not on the pad."""
        mask = np.ones((layout.rows, layout.cols), dtype=np.float32)
        for row, col in [*self.taxels, *((r, 0) for r in self.rows), *((0, c) for c in self.cols)]:
            if not (0 <= row < layout.rows and 0 <= col < layout.cols):
                raise ValueError(f"dead_taxels: ({row}, {col}) is not on a {layout.rows} x {layout.cols} pad")
        for (row, col), part in zip(self.taxels, self.left or [0.0] * len(self.taxels), strict=True):
            mask[row, col] = part
        mask[list(self.rows)] = 0.0
        mask[:, list(self.cols)] = 0.0
        return mask

    @override
    def traits(self, layout: PadLayout, pads: int, rng: np.random.Generator) -> Traits:
        return {"draw": rng.random((pads, layout.rows, layout.cols)).astype(np.float32)}

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        x = x * taxel_map(self.alive(frame.layout), x)
        return (x * (state["draw"] >= self.probability) if "draw" in state else x), state


@register
@dataclass(frozen=True)
class Saturation(Stage):
    """The reading levels off at `knee_counts`: knee * tanh(s / knee), slope 1 at zero.

    With a `sharpness` n it is s / (1 + (s / knee)^n)^(1/n) instead: n = 1 bends from the start, as a divider
    does, a large n cuts off.
    """

    name: ClassVar[str] = "saturation"
    domain: ClassVar[str] = "counts"
    rank: ClassVar[int] = 54
    alike: ClassVar[bool] = True
    knee_counts: float = parameter(200.0, "counts", 120.0, 400.0, minimum=1e-6)
    sharpness: float | None = limits(above=0.0, maximum=100.0, default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sharpness is not None and not self.sharpness > 0:
            raise ValueError(f"saturation.sharpness must be positive, got {self.sharpness}")

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        if self.sharpness is None:
            return self.knee_counts * torch.tanh(x / self.knee_counts), state
        share = (x.clamp(min=0.0) / self.knee_counts) ** self.sharpness
        return x / (1.0 + share) ** (1.0 / self.sharpness), state


@register
@dataclass(frozen=True)
class Crosstalk(Stage):
    """Additive leakage: every taxel gets the fraction `row` of each other reading in its row, `col` of its
    column.

    With `reach` the next reading leaks that much, further ones less by exp(-1 / reach) per taxel. A `side` of
    +1 lets a line's readings leak to taxels of larger index only, -1 to smaller ones; with what lies between,
    the weaker side gets the part 1 - |side|.
    """

    name: ClassVar[str] = "crosstalk"
    domain: ClassVar[str] = "counts"
    rank: ClassVar[int] = 58
    proportional: ClassVar[bool] = True
    row: float = parameter(0.005, "1", 0.0, 0.02, maximum=10.0)
    col: float = parameter(0.005, "1", 0.0, 0.02, maximum=10.0)
    reach: float | None = limits(above=0.0, maximum=1e6, default=None)
    row_side: float = limits(-1, 1, default=0.0)
    col_side: float = limits(-1, 1, default=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reach is not None and not self.reach > 0:
            raise ValueError(f"crosstalk.reach must be positive, got {self.reach}")
        if not max(abs(self.row_side), abs(self.col_side)) <= 1:
            raise ValueError("crosstalk.row_side and col_side must lie between -1 and 1")

    @property
    def even(self) -> bool:
        """Whether all other readings of a line leak alike."""
        return self.reach is None and not self.row_side and not self.col_side

    def line(self, count: int, side: float) -> np.ndarray:
        """What a taxel gets (first index) of each of its line (second): (count, count), 0 of itself."""
        ahead = np.arange(count)[:, None] - np.arange(count)[None]
        decay = np.ones(ahead.shape) if self.reach is None else np.exp((1.0 - np.abs(ahead)) / self.reach)
        return decay * (ahead != 0) * np.where(ahead * side < 0, 1.0 - abs(side), 1.0)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        if not self.even:
            down, along = (
                torch.as_tensor(self.line(count, side), dtype=x.dtype, device=x.device)
                for count, side in zip(x.shape[-2:], (self.col_side, self.row_side), strict=True)
            )
            return x + self.row * (x @ along.T) + self.col * (down @ x), state
        along_row = x.sum(dim=-1, keepdim=True) - x
        along_col = x.sum(dim=-2, keepdim=True) - x
        return x + self.row * along_row + self.col * along_col, state


@register
@dataclass(frozen=True)
class Idle(Stage):
    """Reading of an untouched taxel, added: `level_counts` (a number or (R, C)), spread uniformly by
    +-`spread_counts` between taxels, drawn per episode."""

    name: ClassVar[str] = "idle"
    domain: ClassVar[str] = "counts"
    rank: ClassVar[int] = 60
    level_counts: float | tuple[tuple[float, ...], ...] = field(
        default=25.0, metadata={"range": (15.0, 35.0), "maximum": LARGEST["counts"]}
    )
    spread_counts: float = parameter(15.0, "counts", 0.0, 15.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "level_counts", as_map("idle.level_counts", self.level_counts))

    @override
    def traits(self, layout: PadLayout, pads: int, rng: np.random.Generator) -> Traits:
        return {"deviate": rng.uniform(-1.0, 1.0, (pads, layout.rows, layout.cols)).astype(np.float32)}

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        x = x + taxel_map(self.level_counts, x)
        return (x + self.spread_counts * state["deviate"] if "deviate" in state else x), state


@register
@dataclass(frozen=True)
class BaselineDrift(Stage):
    """The idle level moves with session time: counts += rate_counts_per_s * t (a number or (R, C)).

    `knots_s` and `knot_counts`, equally long, add a curve that is straight between its knots and level beyond
    them; `counts_per_c` follows the temperature around `reference_c`, where a recording knows it. With `anew`
    time counts from each recording's start, as where a board warms up whenever its scan is switched on.
    """

    name: ClassVar[str] = "baseline_drift"
    domain: ClassVar[str] = "counts"
    rank: ClassVar[int] = 62
    has_state: ClassVar[bool] = True  # The clock advances with the frames, so none may be left out.
    rate_counts_per_s: float | tuple[tuple[float, ...], ...] = field(
        default=0.0, metadata={"range": (-3e-3, 3e-3), "maximum": LARGEST["counts/s"]}
    )
    knots_s: tuple[float, ...] = ()
    knot_counts: tuple[float, ...] = ()
    counts_per_c: float = parameter(0.0, "counts/degC", 0.0, 0.0, minimum=None)
    reference_c: float = 22.0
    anew: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        rates = as_map("baseline_drift.rate_counts_per_s", self.rate_counts_per_s)
        object.__setattr__(self, "rate_counts_per_s", rates)
        for name in ("knots_s", "knot_counts"):
            object.__setattr__(self, name, as_tuple(getattr(self, name)))
        rising = all(later > earlier for earlier, later in pairwise(self.knots_s))
        if len(self.knots_s) != len(self.knot_counts) or not rising:
            raise ValueError("baseline_drift: knots_s must rise and knot_counts be as many")

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        time_s = torch.as_tensor(frame.time_s)
        begin_counts = self.knot_counts[0] if self.knot_counts else 0.0
        moved = taxel_map(self.rate_counts_per_s, x) * time_s + begin_counts
        knots = zip(pairwise(self.knots_s), pairwise(self.knot_counts), strict=True)
        for (begin, end), (first, last) in knots:
            moved = moved + (last - first) / (end - begin) * (time_s - begin).clamp(0.0, end - begin)
        if frame.temperature_c is not None:
            moved = moved + self.counts_per_c * (frame.temperature_c - self.reference_c)
        return x + moved.to(x), state

    @override
    def sequence(self, x: torch.Tensor, times_s: torch.Tensor, frame: Frame) -> torch.Tensor:
        shape = (-1,) + (1,) * (x.ndim - 1)
        warmth = None if frame.temperature_c is None else frame.temperature_c.view(shape)
        return self.step(x, {}, replace(frame, time_s=times_s.view(shape), temperature_c=warmth))[0]


@register
@dataclass(frozen=True)
class Noise(Stage):
    """White Gaussian noise of `sigma_counts` per taxel and frame; a function of the episode's seed and the
    frame's number."""

    name: ClassVar[str] = "noise"
    domain: ClassVar[str] = "counts"
    rank: ClassVar[int] = 80
    stochastic: ClassVar[bool] = True
    sigma_counts: float = parameter(1.0, "counts", 0.5, 2.0)

    @override
    def traits(self, layout: PadLayout, pads: int, rng: np.random.Generator) -> Traits:
        return {"seed": rng.integers(0, 2**62, pads, dtype=np.int64)}

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        return {"frame": np.zeros(pads, dtype=np.int64)}

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        noise = noise_frames(state["seed"], state["frame"], x.shape[-2] * x.shape[-1]).view(x.shape)
        return x + self.sigma_counts * noise, {**state, "frame": state["frame"] + 1}


@register
@dataclass(frozen=True)
class Quantisation(Stage):
    """The converter: rounded to `step_counts` and clipped to [0, full_scale_counts]."""

    name: ClassVar[str] = "quantisation"
    domain: ClassVar[str] = "counts"
    rank: ClassVar[int] = 82
    step_counts: float = parameter(1.0, "counts", 1.0, 4.0, minimum=1e-6)
    full_scale_counts: float = parameter(255.0, "counts", 255.0, 255.0, minimum=1.0)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        return (torch.round(x / self.step_counts) * self.step_counts).clamp(
            0.0, self.full_scale_counts
        ), state
