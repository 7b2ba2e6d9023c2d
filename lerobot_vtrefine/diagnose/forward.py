"""Many presses through the simulator's stages at once, in double precision, for fitting.

Stages without memory run as they are, on whole recordings. Those with memory have a vectorised equal in
`SEQUENCES` (a test holds each to the stage's own `sequence`); a stage that is not listed runs its own.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from lerobot_vtrefine.diagnose.presses import CropLayout, Press
from lerobot_vtrefine.diagnose.refinement import needs_refinement
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import Frame, Stage
from lerobot_vtrefine.tactile.stages.contact import ContactStage
from lerobot_vtrefine.tactile.stages.host import Latency, SampleAndHold, ScanSkew
from lerobot_vtrefine.tactile.stages.mechanics import Hysteresis, ViscoelasticRelaxation
from lerobot_vtrefine.tactile.stages.readout import BaselineDrift, DeadTaxels, Quantisation, TaxelGainSpread

Images = list[np.ndarray]
"""Per group (T, r, c)."""
MAX_EXPONENT = 200.0


@dataclass(frozen=True)
class Group:
    """Presses that share a window of the pad, one after the other along time: arrays (sum of T, r, c)."""

    layout: CropLayout
    members: tuple[int, ...]
    """Their numbers among all presses."""
    bounds: tuple[slice, ...]
    """Where each of them is."""
    drive: np.ndarray
    rate: np.ndarray
    time_s: np.ndarray
    session_s: np.ndarray
    idle: np.ndarray
    """(r, c) idle level [counts]."""
    loaded: bool


def group_presses(presses: Sequence[Press], idle: np.ndarray) -> list[Group]:
    """Presses by window; work without memory is done for a whole group at once."""
    by_window: dict[CropLayout, list[int]] = {}
    for index, press in enumerate(presses):
        by_window.setdefault(press.layout, []).append(index)
    groups = []
    for layout, members in by_window.items():
        own = [presses[index] for index in members]
        ends = np.cumsum([len(press.drive) for press in own]).tolist()
        bounds = tuple(slice(e - len(press.drive), e) for e, press in zip(ends, own, strict=True))
        groups.append(
            Group(
                layout,
                tuple(members),
                bounds,
                np.concatenate([press.drive for press in own]),
                np.concatenate([press.rate for press in own]),
                np.concatenate([press.time_s for press in own]),
                np.concatenate([press.session_s for press in own]),
                layout.cut(idle),
                own[0].loaded,
            )
        )
    return groups


class Bench:
    """Presses ready to be run through models, as recorded and refined; built once per set."""

    def __init__(self, presses: Sequence[Press], idle: np.ndarray) -> None:
        self.presses, self._idle = presses, idle

    @cached_property
    def coarse(self) -> list[Group]:
        """Frame by frame."""
        return group_presses(self.presses, self._idle)

    @cached_property
    def fine(self) -> list[Group]:
        """With frames in between."""
        return group_presses([press.fine for press in self.presses], self._idle)

    def scatter(self, groups: Sequence[Group], images: Images, fine: bool) -> list[np.ndarray]:
        """From images per group to (T, n) per press, of its scored taxels."""
        result: list[np.ndarray] = [np.empty(0)] * len(self.presses)
        for group, image in zip(groups, images, strict=True):
            for index, bound in zip(group.members, group.bounds, strict=True):
                press = self.presses[index].fine if fine else self.presses[index]
                result[index] = image[bound][:: press.substeps, press.scored]
        return result


def run_stages(stages: Sequence[Stage], bench: Bench, cache: "Prefix | None" = None) -> list[np.ndarray]:
    """Counts above idle that the stages predict for every press: (T, n) of its scored taxels.

    With a cache, work that earlier stages did for the same parameters is not repeated.
    """
    if not bench.presses:
        return []
    fine = needs_refinement(tuple(stages))
    groups = bench.fine if fine else bench.coarse
    contact = next(stage for stage in stages if isinstance(stage, ContactStage))
    stiffness = float(contact.stiffness(groups[0].layout))
    start, images = cache.lookup(stages, fine) if cache is not None else (0, None)
    if images is None:
        images = [group.drive for group in groups]
    for index in range(start, len(stages)):
        images = _apply(stages[index], images, groups, stiffness)
        if cache is not None:
            cache.store(index, images)
    return bench.scatter(groups, images, fine)


class Prefix:
    """Images after every stage of one reference model; a model that differs later starts from there."""

    def __init__(self) -> None:
        self.keys: list[Any] = []
        self.images: list[Images] = []
        self.frozen = False

    def lookup(self, stages: Sequence[Stage], fine: bool) -> tuple[int, Images | None]:
        """Number of leading stages already done at that fineness, and their images."""
        keys = [(fine, _key(stage)) for stage in stages]
        same = 0
        while same < min(len(keys), len(self.keys)) and keys[same] == self.keys[same]:
            same += 1
        if not self.frozen:
            self.keys = keys
            self.images = self.images[:same]
        return same, (self.images[same - 1] if same else None)

    def store(self, index: int, images: Images) -> None:
        """Keep the images after stage `index`, unless frozen."""
        if not self.frozen:
            self.images[index:] = [images]


def _key(stage: Stage) -> Any:
    if isinstance(stage, TaxelGainSpread):
        return stage.name, _Same(stage.map)
    return stage


@dataclass(frozen=True, eq=False)
class _Same:
    """Equal only to the very same object, kept alive: the address of one that is gone may be used again."""

    value: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


def _apply(stage: Stage, images: Images, groups: Sequence[Group], stiffness: float) -> Images:
    if groups[0].loaded and (isinstance(stage, ContactStage) or stage.domain == "depth"):
        return images
    if isinstance(stage, Hysteresis):
        return _hysteresis(stage, images, groups, stiffness)
    return [_one(stage, image, group, stiffness) for image, group in zip(images, groups, strict=True)]


def _one(stage: Stage, image: np.ndarray, group: Group, stiffness: float) -> np.ndarray:
    if isinstance(stage, ContactStage):
        return stage.force(torch.from_numpy(image), torch.from_numpy(group.rate), group.layout).numpy()
    whole = WHOLE.get(type(stage))
    if whole is not None:
        return whole(stage, image, group)
    special = SEQUENCES.get(type(stage))
    if special is None and not stage.has_state:
        frame = Frame(
            group.layout,
            time_s=torch.from_numpy(group.time_s).view(-1, 1, 1),
            stiffness_n_per_m=stiffness,
            load_conserving=group.loaded,
        )
        return stage.step(torch.from_numpy(image), {}, frame)[0].numpy()
    pieces = []
    for bound in group.bounds:
        time_s = group.time_s[bound]
        if special is not None:
            pieces.append(special(stage, image[bound], time_s, group.layout))
        else:
            frame = Frame(group.layout, stiffness_n_per_m=stiffness, load_conserving=group.loaded)
            pieces.append(
                stage.sequence(torch.from_numpy(image[bound]), torch.from_numpy(time_s), frame).numpy()
            )
    return np.concatenate(pieces)


def low_passed(x: np.ndarray, time_s: np.ndarray, tau_s: float) -> np.ndarray:
    """x (T, ...) through one pole of `tau_s`, from rest at zero, exact for a signal linear between frames."""
    dt = np.diff(time_s)
    decay = np.exp(-dt / tau_s)
    ramp = 1.0 - np.where(dt > 0, (1.0 - decay) * tau_s / np.maximum(dt, 1e-12), 1.0)
    shape = (-1, *(1,) * (x.ndim - 1))
    push = (1.0 - decay).reshape(shape) * x[:-1] + ramp.reshape(shape) * (x[1:] - x[:-1])
    slow = np.zeros_like(x)
    begin = 0
    while begin < len(dt):
        # Growing exponentials instead of a recursion, in pieces short enough not to overflow.
        reach = np.searchsorted(time_s, time_s[begin] + MAX_EXPONENT * tau_s, side="right") - 1
        end = min(max(int(reach), begin + 1), len(dt))
        ages = np.minimum((time_s[begin + 1 : end + 1] - time_s[begin]) / tau_s, 600.0)
        grow = np.exp(ages).reshape(shape)
        slow[begin + 1 : end + 1] = (slow[begin] + np.cumsum(grow * push[begin:end], axis=0)) / grow
        begin = end
    return slow


def _relaxation(
    stage: ViscoelasticRelaxation, image: np.ndarray, time_s: np.ndarray, layout: CropLayout
) -> np.ndarray:
    taus = stage.tau_s if isinstance(stage.tau_s, tuple) else (stage.tau_s,)
    fractions = stage.fraction if isinstance(stage.fraction, tuple) else (stage.fraction,)
    relaxed = image.copy()
    for tau_s, fraction in zip(taus, fractions, strict=True):
        relaxed -= fraction * low_passed(image, time_s, tau_s)
    return relaxed


def delayed(x: np.ndarray, time_s: np.ndarray, delay_s: float) -> np.ndarray:
    """x (T, ...) as it was `delay_s` earlier, linear between frames, held before the first."""
    if len(time_s) < 2:
        return x
    wanted = time_s - delay_s
    after = np.searchsorted(time_s, wanted, side="right").clip(1, len(time_s) - 1)
    span = np.maximum(time_s[after] - time_s[after - 1], 1e-12)
    weight = ((wanted - time_s[after - 1]) / span).clip(0.0, 1.0).reshape(-1, *(1,) * (x.ndim - 1))
    return x[after - 1] + weight * (x[after] - x[after - 1])


def _latency(stage: Latency, image: np.ndarray, time_s: np.ndarray, layout: CropLayout) -> np.ndarray:
    return delayed(image, time_s, float(stage.tau_s))


def _scan_skew(stage: ScanSkew, image: np.ndarray, time_s: np.ndarray, layout: CropLayout) -> np.ndarray:
    rows = layout.full_rows
    share = [(layout.row0 + row) / max(rows - 1, 1) for row in range(image.shape[1])]
    late = [delayed(image[:, row], time_s, stage.skew_s * s) for row, s in enumerate(share)]
    return np.stack(late, axis=1)


def _hold(stage: SampleAndHold, image: np.ndarray, time_s: np.ndarray, layout: CropLayout) -> np.ndarray:
    slot = np.floor(time_s / stage.period_s + 1e-6).astype(np.int64)
    new = np.concatenate([[True], slot[1:] != slot[:-1]])
    return image[np.maximum.accumulate(np.where(new, np.arange(len(slot)), 0))]


def _drift(stage: BaselineDrift, image: np.ndarray, group: Group) -> np.ndarray:
    moved = stage.rate_counts_per_s * group.session_s
    if stage.knots_s:
        moved = moved + np.interp(group.session_s, stage.knots_s, stage.knot_counts)
    return image + moved[:, None, None]


def _gain_map(stage: TaxelGainSpread, image: np.ndarray, group: Group) -> np.ndarray:
    return image if stage.map is None else image * group.layout.cut(np.asarray(stage.map))


def _dead(stage: DeadTaxels, image: np.ndarray, group: Group) -> np.ndarray:
    layout = group.layout
    whole = PadLayout(layout.full_rows, layout.full_cols, layout.pitch_m)
    return image * layout.cut(stage.alive(whole).astype(float))


def _convert(stage: Quantisation, image: np.ndarray, group: Group) -> np.ndarray:
    """Clipping alone: rounding is not differentiable, and the mean over noise is not rounded."""
    return image.clip(-group.idle, np.maximum(stage.full_scale_counts - group.idle, 0.0))


def play(x: np.ndarray, half_width: float) -> np.ndarray:
    """Play operator on columns of x (T, n) with reset at zero, as in the hysteresis stage: (T, n)."""
    out = np.zeros_like(x)
    state = np.zeros(x.shape[1])
    upper, lower, free = x + half_width, x - half_width, x > 0
    for t in range(len(x)):
        np.minimum(state, upper[t], out=state)
        np.maximum(state, lower[t], out=state)
        np.maximum(state, 0.0, out=state)
        state *= free[t]
        out[t] = state
    return out


def _hysteresis(stage: Hysteresis, images: Images, groups: Sequence[Group], stiffness: float) -> Images:
    """All presses side by side, padded to the longest: the loop runs over frames once."""
    pieces = [image[bound] for image, group in zip(images, groups, strict=True) for bound in group.bounds]
    touched = [(piece > 0).any(axis=0) for piece in pieces]
    widths_taken = [int(mask.sum()) for mask in touched]
    joined = np.zeros((max(len(piece) for piece in pieces), sum(widths_taken)))
    starts = np.concatenate([[0], np.cumsum(widths_taken)]).tolist()
    for piece, mask, begin, end in zip(pieces, touched, starts[:-1], starts[1:], strict=True):
        joined[: len(piece), begin:end] = piece[:, mask]
    widths = stage.width_m if isinstance(stage.width_m, tuple) else (stage.width_m,)
    fractions = stage.fraction if isinstance(stage.fraction, tuple) else (stage.fraction,)
    held = (1.0 - math.fsum(fractions)) * joined
    for width_m, fraction in zip(widths, fractions, strict=True):
        held += fraction * play(joined, 0.5 * width_m * stiffness)
    outputs = []
    for piece, mask, begin, end in zip(pieces, touched, starts[:-1], starts[1:], strict=True):
        out = np.zeros_like(piece)
        out[:, mask] = np.maximum(held[: len(piece), begin:end], 0.0)
        outputs.append(out)
    counts = np.cumsum([0, *(len(group.bounds) for group in groups)]).tolist()
    return [np.concatenate(outputs[i:j]) for i, j in pairwise(counts)]


SEQUENCES: dict[type, Callable[[Any, np.ndarray, np.ndarray, CropLayout], np.ndarray]] = {
    ViscoelasticRelaxation: _relaxation,
    Latency: _latency,
    ScanSkew: _scan_skew,
    SampleAndHold: _hold,
}
"""Stages with memory: (stage, image of one press, its times, window)."""
WHOLE: dict[type, Callable[[Any, np.ndarray, Group], np.ndarray]] = {
    BaselineDrift: _drift,
    TaxelGainSpread: _gain_map,
    DeadTaxels: _dead,
    Quantisation: _convert,
}
"""Stages that need to know the whole pad or the session: (stage, image of a group, group)."""
