"""Many presses through the simulator's stages at once, in double precision, for fitting.

Stages without memory run as they are, on whole recordings. Those with memory have a vectorised equal in
`SEQUENCES` (a test holds each to the stage's own `sequence`); a stage that is not listed runs its own.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from lerobot_vtrefine.diagnose.presses import Press
from lerobot_vtrefine.diagnose.refinement import needs_refinement
from lerobot_vtrefine.tactile.stages.base import Frame, Stage
from lerobot_vtrefine.tactile.stages.contact import ContactStage
from lerobot_vtrefine.tactile.stages.host import Latency, SampleAndHold, ScanSkew
from lerobot_vtrefine.tactile.stages.mechanics import Hysteresis, ViscoelasticRelaxation
from lerobot_vtrefine.tactile.stages.readout import BaselineDrift, DeadTaxels, Quantisation, TaxelGainSpread

Images = list[np.ndarray]
"""Per press (T, r, c)."""
MAX_EXPONENT = 200.0


def run_stages(stages: Sequence[Stage], presses: Sequence[Press], cache: "Prefix | None" = None) -> Images:
    """Counts above idle that the stages predict for every press: (T, n) of its scored taxels.

    With a cache, work that earlier stages did for the same parameters is not repeated.
    """
    fine = needs_refinement(tuple(stages))
    presses = [press.fine for press in presses] if fine else presses
    contact = next(stage for stage in stages if isinstance(stage, ContactStage))
    stiffness = float(contact.stiffness(presses[0].layout)) if presses else 1.0
    start, images = cache.lookup(stages, fine) if cache is not None else (0, None)
    if images is None:
        images = [press.drive for press in presses]
    for index in range(start, len(stages)):
        images = _apply(stages[index], images, presses, stiffness)
        if cache is not None:
            cache.store(index, images)
    return [image[:: press.substeps, press.scored] for image, press in zip(images, presses, strict=True)]


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
        return stage.name, id(stage.map)
    return stage


def _apply(stage: Stage, images: Images, presses: Sequence[Press], stiffness: float) -> Images:
    if isinstance(stage, ContactStage):
        if presses and presses[0].loaded:
            return images
        pairs = zip(images, presses, strict=True)
        return [_contact(stage, image, press) for image, press in pairs]
    if stage.domain == "depth" and presses and presses[0].loaded:
        return images
    together = TOGETHER.get(type(stage))
    if together is not None:
        return together(stage, images, presses, stiffness)
    return [_one(stage, image, press, stiffness) for image, press in zip(images, presses, strict=True)]


def _contact(stage: ContactStage, heights: np.ndarray, press: Press) -> np.ndarray:
    return stage.force(torch.from_numpy(heights), torch.from_numpy(press.rate), press.layout).numpy()


def _one(stage: Stage, image: np.ndarray, press: Press, stiffness: float) -> np.ndarray:
    special = SEQUENCES.get(type(stage))
    if special is not None:
        return special(stage, image, press)
    frame = Frame(press.layout, stiffness_n_per_m=stiffness, load_conserving=press.loaded)
    x = torch.from_numpy(image)
    if stage.has_state:
        return stage.sequence(x, torch.from_numpy(press.time_s), frame).numpy()
    return stage.step(x, {}, replace(frame, time_s=torch.from_numpy(press.time_s).view(-1, 1, 1)))[0].numpy()


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


def _relaxation(stage: ViscoelasticRelaxation, image: np.ndarray, press: Press) -> np.ndarray:
    taus = stage.tau_s if isinstance(stage.tau_s, tuple) else (stage.tau_s,)
    fractions = stage.fraction if isinstance(stage.fraction, tuple) else (stage.fraction,)
    relaxed = image.copy()
    for tau_s, fraction in zip(taus, fractions, strict=True):
        relaxed -= fraction * low_passed(image, press.time_s, tau_s)
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


def _latency(stage: Latency, image: np.ndarray, press: Press) -> np.ndarray:
    return delayed(image, press.time_s, float(stage.tau_s))


def _scan_skew(stage: ScanSkew, image: np.ndarray, press: Press) -> np.ndarray:
    rows = press.layout.full_rows
    share = [(press.layout.row0 + row) / max(rows - 1, 1) for row in range(image.shape[1])]
    late = [delayed(image[:, row], press.time_s, stage.skew_s * s) for row, s in enumerate(share)]
    return np.stack(late, axis=1)


def _hold(stage: SampleAndHold, image: np.ndarray, press: Press) -> np.ndarray:
    slot = np.floor(press.time_s / stage.period_s + 1e-6).astype(np.int64)
    new = np.concatenate([[True], slot[1:] != slot[:-1]])
    return image[np.maximum.accumulate(np.where(new, np.arange(len(slot)), 0))]


def _drift(stage: BaselineDrift, image: np.ndarray, press: Press) -> np.ndarray:
    return image + (stage.rate_counts_per_s * press.session_s)[:, None, None]


def _gain_map(stage: TaxelGainSpread, image: np.ndarray, press: Press) -> np.ndarray:
    return image if stage.map is None else image * press.layout.cut(np.asarray(stage.map))


def _dead(stage: DeadTaxels, image: np.ndarray, press: Press) -> np.ndarray:
    layout = press.layout
    whole = replace_layout(layout)
    return image * layout.cut(stage.alive(whole).astype(float))


def replace_layout(layout: Any) -> Any:
    """The whole pad of a window."""
    from lerobot_vtrefine.tactile.layout import PadLayout

    return PadLayout(layout.full_rows, layout.full_cols, layout.pitch_m)


def _convert(stage: Quantisation, image: np.ndarray, press: Press) -> np.ndarray:
    """Clipping alone: rounding is not differentiable, and the mean over noise is not rounded."""
    level = np.zeros(press.scored.shape)
    level[press.scored] = press.idle
    return image.clip(-level, np.maximum(stage.full_scale_counts - level, 0.0))


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


def _hysteresis(stage: Hysteresis, images: Images, presses: Sequence[Press], stiffness: float) -> Images:
    """All presses side by side, padded to the longest: the loop runs over frames once."""
    touched = [(image > 0).any(axis=0) for image in images]
    length = max(len(image) for image in images)
    joined = np.zeros((length, sum(int(mask.sum()) for mask in touched)))
    begin = 0
    for image, mask in zip(images, touched, strict=True):
        width = int(mask.sum())
        joined[: len(image), begin : begin + width] = image[:, mask]
        begin += width
    widths = stage.width_m if isinstance(stage.width_m, tuple) else (stage.width_m,)
    fractions = stage.fraction if isinstance(stage.fraction, tuple) else (stage.fraction,)
    held = (1.0 - math.fsum(fractions)) * joined
    for width_m, fraction in zip(widths, fractions, strict=True):
        held += fraction * play(joined, 0.5 * width_m * stiffness)
    outputs, begin = [], 0
    for image, mask in zip(images, touched, strict=True):
        width = int(mask.sum())
        out = image * (1.0 - math.fsum(fractions))
        out[:, mask] = held[: len(image), begin : begin + width]
        outputs.append(out)
        begin += width
    return outputs


SEQUENCES: dict[type, Callable[[Any, np.ndarray, Press], np.ndarray]] = {
    ViscoelasticRelaxation: _relaxation,
    Latency: _latency,
    ScanSkew: _scan_skew,
    SampleAndHold: _hold,
    BaselineDrift: _drift,
    TaxelGainSpread: _gain_map,
    DeadTaxels: _dead,
    Quantisation: _convert,
}
TOGETHER: dict[type, Callable[[Any, Images, Sequence[Press], float], Images]] = {Hysteresis: _hysteresis}
