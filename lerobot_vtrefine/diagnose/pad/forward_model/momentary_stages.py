"""Fast equals, on sheets, of the stages that know one instant only."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from lerobot_vtrefine.diagnose.pad.forward_model.fields import Context, Field, by_press
from lerobot_vtrefine.tactile.stages.base import Frame, Stage
from lerobot_vtrefine.tactile.stages.mechanics import (
    MechanicalSpreading,
    NonlinearStiffness,
    ring_matrix,
    spreading_matrix,
)
from lerobot_vtrefine.tactile.stages.readout import (
    BaselineDrift,
    Crosstalk,
    DeadTaxels,
    Gain,
    Idle,
    Quantisation,
    RowSharing,
    Saturation,
    TaxelGainSpread,
)
from lerobot_vtrefine.tactile.stages.surface import ContactOffset, PadTilt, StiffeningDepth


def _elementwise(stage: Stage, field: Field, context: Context) -> Field:
    """A stage that treats every reading alike, whatever its taxel and time."""
    frame = Frame(context.sheet.layout, stiffness_n_per_m=context.stiffness)
    return Field(
        stage.step(torch.from_numpy(field.values)[:, None], {}, frame)[0][:, 0].numpy(), field.columns
    )


def _deepened(stage: ContactOffset | StiffeningDepth, field: Field, context: Context) -> Field:
    """Depths become others, alike for all taxels; their rates stay."""
    out = _elementwise(stage, field, context)
    return Field(out.values, field.columns, field.rate)


def _lowered(stage: PadTilt, field: Field, context: Context) -> Field:
    """Depths move by an amount that belongs to the taxel."""
    sheet = context.sheet
    flat = torch.zeros((sheet.layout.rows, sheet.layout.cols), dtype=torch.float64)
    moved = stage.step(flat, {}, Frame(sheet.layout))[0].numpy().ravel()
    return Field(field.values + moved[sheet.taxels[field.columns]], field.columns, field.rate)


def _mixed(field: Field, context: Context, weights: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Field:
    """Every reading a weighted sum over its press: weights(columns out, columns in) -> (out, in)."""
    sheet = context.sheet
    columns = context.wanted if context.wanted is not None else np.arange(len(sheet.taxels))
    out = np.zeros((len(field.values), len(columns)))
    for press, block in enumerate(sheet.blocks):
        part = field.within(sheet, press)
        to = slice(*np.searchsorted(columns, (block.start, block.stop)).tolist())
        lines = len(sheet.times_s[press])
        out[:lines, to] = field.values[:lines, part] @ weights(columns[to], field.columns[part]).T
    return Field(out, columns)


def _spreading(stage: MechanicalSpreading, field: Field, context: Context) -> Field:
    sheet = context.sheet
    if stage.rings:
        matrix = ring_matrix(sheet.layout.rows, sheet.layout.cols, stage.rings, stage.kept)
        return _mixed(field, context, lambda to, of: matrix[np.ix_(sheet.taxels[to], sheet.taxels[of])])
    sigma = torch.full((1, 1), stage.sigma_m / sheet.layout.pitch_m, dtype=torch.float64)
    down, along = (spreading_matrix(n, sigma).numpy() for n in (sheet.layout.rows, sheet.layout.cols))

    def weights(to: np.ndarray, of: np.ndarray) -> np.ndarray:
        return down[np.ix_(sheet.rows[to], sheet.rows[of])] * along[np.ix_(sheet.cols[to], sheet.cols[of])]

    return _mixed(field, context, weights)


def _crosstalk(stage: Crosstalk, field: Field, context: Context) -> Field:
    sheet = context.sheet
    along, down = stage.line(sheet.layout.cols, stage.row_side), stage.line(sheet.layout.rows, stage.col_side)

    def weights(to: np.ndarray, of: np.ndarray) -> np.ndarray:
        row = sheet.rows[to][:, None] == sheet.rows[of][None]
        col = sheet.cols[to][:, None] == sheet.cols[of][None]
        leaks = stage.row * row * along[np.ix_(sheet.cols[to], sheet.cols[of])]
        leaks += stage.col * col * down[np.ix_(sheet.rows[to], sheet.rows[of])]
        return np.where(row & col, 1.0, leaks)

    return _mixed(field, context, weights)


def _row_sharing(stage: RowSharing, field: Field, context: Context) -> Field:
    sheet = context.sheet

    def work(x: np.ndarray, time_s: np.ndarray, rows: np.ndarray) -> np.ndarray:
        if not len(rows):
            return x
        # Columns are in the order of their rows.
        first = np.flatnonzero(np.diff(rows, prepend=-1))
        total = np.add.reduceat(x, first, axis=1)
        line = np.repeat(np.arange(len(first)), np.diff(first, append=len(rows)))
        load = total[:, line]
        load -= (1.0 - stage.own) * x
        load *= stage.conductance_per_count
        load += 1.0
        return x / load

    return by_press(field, sheet, work)


def _drift(stage: BaselineDrift, field: Field, context: Context) -> Field:
    sheet = context.sheet
    field = field.spread(context.wanted if context.wanted is not None else np.arange(len(sheet.taxels)))
    out = field.values.copy()
    when = zip(sheet.times_s, sheet.starts_s, sheet.warmth_c, strict=True)
    for press, (time_s, start_s, warm) in enumerate(when):
        session_s = time_s + start_s
        moved = stage.rate_counts_per_s * session_s
        if stage.knots_s:
            moved = moved + np.interp(session_s, stage.knots_s, stage.knot_counts)
        if warm is not None:
            moved = moved + stage.counts_per_c * (warm - stage.reference_c)
        out[: len(time_s), field.within(sheet, press)] += moved[:, None]
    return Field(out, field.columns)


def _idle(stage: Idle, field: Field, context: Context) -> Field:
    sheet = context.sheet
    field = field.spread(context.wanted if context.wanted is not None else np.arange(len(sheet.taxels)))
    shape = (sheet.layout.rows, sheet.layout.cols)
    level = np.broadcast_to(np.asarray(stage.level_counts, dtype=float), shape).ravel()
    return Field(field.values + level[sheet.taxels[field.columns]], field.columns)


def _gain_map(stage: TaxelGainSpread, field: Field, context: Context) -> Field:
    if stage.map is None:
        return field
    factors = np.asarray(stage.map, dtype=float).ravel()
    return Field(field.values * factors[context.sheet.taxels[field.columns]], field.columns)


def _dead(stage: DeadTaxels, field: Field, context: Context) -> Field:
    alive = stage.alive(context.sheet.layout).astype(float).ravel()
    return Field(field.values * alive[context.sheet.taxels[field.columns]], field.columns)


def _convert(stage: Quantisation, field: Field, context: Context) -> Field:
    """Clipping alone: rounding is not differentiable, and the mean over noise is not rounded."""
    idle = context.sheet.idle[field.columns]
    return Field(field.values.clip(-idle, np.maximum(stage.full_scale_counts - idle, 0.0)), field.columns)


SEPARATE: dict[type, Callable[[Any, Field, Context], Field]] = {
    ContactOffset: _deepened,
    StiffeningDepth: _deepened,
    PadTilt: _lowered,
    NonlinearStiffness: _elementwise,
    Gain: _elementwise,
    TaxelGainSpread: _gain_map,
    DeadTaxels: _dead,
    Saturation: _elementwise,
    Idle: _idle,
    BaselineDrift: _drift,
    Quantisation: _convert,
}
"""Stage -> its equal, of stages that treat every taxel by itself."""
MIXING: dict[type, Callable[[Any, Field, Context], Field]] = {
    MechanicalSpreading: _spreading,
    RowSharing: _row_sharing,
    Crosstalk: _crosstalk,
}
"""Stage -> its equal, of stages that mix a taxel with its neighbours."""
