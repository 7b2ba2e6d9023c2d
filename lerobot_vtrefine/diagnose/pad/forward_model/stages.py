"""Stages on sheets: each runs its own code, on the columns that it concerns instead of on whole pads.

What stands here is only how a stage that knows its taxels finds them among a sheet's columns. A stage that is
neither `alike` nor listed runs on whole images, press by press.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch

from lerobot_vtrefine.diagnose.pad.forward_model.batches import Sheet
from lerobot_vtrefine.diagnose.pad.forward_model.fields import Context, Field
from lerobot_vtrefine.diagnose.pad.forward_model.sampling import hold, late, scan_skew
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import Frame, Stage
from lerobot_vtrefine.tactile.stages.contact import ContactStage
from lerobot_vtrefine.tactile.stages.cover import on_springs
from lerobot_vtrefine.tactile.stages.dividers import Divider, LaggingDroop, RowSharing, SupplyDroop
from lerobot_vtrefine.tactile.stages.host import Latency, SampleAndHold, ScanSkew
from lerobot_vtrefine.tactile.stages.hysteresis import Hysteresis, LoadingHysteresis, Play, RestingHysteresis
from lerobot_vtrefine.tactile.stages.mechanics import (
    MechanicalSpreading,
    ViscoelasticRelaxation,
    ring_matrix,
    spreading_matrix,
)
from lerobot_vtrefine.tactile.stages.readout import (
    BaselineDrift,
    Crosstalk,
    DeadTaxels,
    Idle,
    Quantisation,
    TaxelGainSpread,
)
from lerobot_vtrefine.tactile.stages.signals import low_passed
from lerobot_vtrefine.tactile.stages.softening import FirstLoadSoftening, PathSoftening, Remembering
from lerobot_vtrefine.tactile.stages.surface import ContactOffset, PadTilt, StiffeningDepth, UnevenFace

Work = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def run_stage(stage: Stage, field: Field, context: Context) -> Field:
    """The field after a stage."""
    sheet = context.sheet
    if isinstance(stage, ContactStage):
        return field if sheet.loaded else _contact(stage, field, context)
    if sheet.loaded and stage.domain == "depth":
        return field
    if field.damping is not None and (on_springs(stage) or stage.spreads):
        return _in_parts(stage, field, context)
    out = _passed(stage, field, context)
    return out if out.columns is not field.columns else replace(out, damping=field.damping)


def _in_parts(stage: Stage, field: Field, context: Context) -> Field:
    """What springs bear and what damping bears, apart (see `stages.cover.passed`)."""
    damping = replace(field, values=field.damping, damping=None)
    if stage.spreads:
        moved = _passed(stage, replace(field, damping=None), context)
        return replace(moved, damping=_passed(stage, damping, context).values)
    springs = replace(field, values=field.values - damping.values, damping=None)
    sprung = _passed(stage, springs, context).values
    values = np.maximum(sprung + damping.values, 0.0) * (field.values > 0)
    return replace(field, values=values)


def _passed(stage: Stage, field: Field, context: Context) -> Field:
    sheet = context.sheet
    if type(stage) in OWN_TAXELS:
        return OWN_TAXELS[type(stage)](stage, field, context)
    if not stage.alike or (sheet.loaded and stage.domain == "force" and not stage.has_state):
        # Where the sum is a measured load, mechanics keep it, for which they need the whole pad.
        return _whole(stage, field, context)
    return _alike(stage, field, context)


def treats_each_alone(stage: Stage) -> bool:
    """Whether no taxel's reading depends on another's."""
    return stage.alike or isinstance(stage, SEPARATE | ContactStage)


def by_press(field: Field, sheet: Sheet, work: Work) -> Field:
    """work(values (T, m), times (T,), columns (m,)) on every press."""
    out = np.zeros_like(field.values)
    for part, time_s in zip(field.parts(sheet), sheet.times_s, strict=True):
        out[: len(time_s), part] = work(field.values[: len(time_s), part], time_s, field.columns[part])
    return Field(out, field.columns, field.rate)


def _alike(stage: Stage, field: Field, context: Context, borne: tuple[np.ndarray, ...] = ()) -> Field:
    plain = Frame(context.sheet.layout, stiffness_n_per_m=context.stiffness)

    def work(x: np.ndarray, time_s: np.ndarray, columns: np.ndarray) -> np.ndarray:
        line = torch.from_numpy(np.ascontiguousarray(x))[:, None]
        frame = _remembering(plain, context.sheet, borne, columns) if borne else plain
        return stage.sequence(line, torch.from_numpy(time_s), frame)[:, 0].numpy()

    if not stage.has_state or stage.rate_free:  # then all presses are one
        frames = np.arange(len(field.values), dtype=float)
        return Field(work(field.values, frames, field.columns), field.columns, field.rate)
    return by_press(field, context.sheet, work)


def _remembering(frame: Frame, sheet: Sheet, borne: tuple[np.ndarray, ...], columns: np.ndarray) -> Frame:
    """The frame with what earlier recordings pressed some columns with."""
    drive, age_s, path = (torch.from_numpy(np.take(values, columns, axis=1))[:, None] for values in borne)
    return replace(frame, load_conserving=sheet.loaded, borne=(drive, age_s, path))


def _looped(stage: Play, field: Field, context: Context) -> Field:
    """All presses are one; fits change fractions more often than what comes before, or widths."""
    frame = Frame(context.sheet.layout, stiffness_n_per_m=context.stiffness)
    line = torch.from_numpy(np.ascontiguousarray(field.values))[:, None]
    law = (type(stage), stage.width_m, context.stiffness)
    if law not in field.memories:
        field.memories[law] = list(stage.kept(line, frame))
    return Field(stage.reading(line, field.memories[law])[:, 0].numpy(), field.columns, field.rate)


def _relaxing(stage: ViscoelasticRelaxation, field: Field, context: Context) -> Field:
    """All presses are one but for their memories, which fractions do not change."""
    laws = [(type(stage), float(tau_s)) for tau_s, _ in stage.branches()]
    for law in laws:
        if law not in field.memories:
            slow = by_press(field, context.sheet, partial(_low_passed, law[1]))
            field.memories[law] = [torch.from_numpy(slow.values)]
    kept = [field.memories[law][0] for law in laws]
    return Field(stage.relaxed(torch.from_numpy(field.values), kept).numpy(), field.columns, field.rate)


def _low_passed(tau_s: float, x: np.ndarray, time_s: np.ndarray, columns: np.ndarray) -> np.ndarray:
    line = torch.from_numpy(np.ascontiguousarray(x))
    return low_passed(line, torch.from_numpy(time_s), tau_s).numpy()


def _contact(stage: ContactStage, field: Field, context: Context) -> Field:
    assert field.rate is not None
    sheet = context.sheet
    depth, rate = (torch.from_numpy(np.ascontiguousarray(v))[:, None] for v in (field.values, field.rate))
    force, damping = stage.force(depth, rate, sheet.layout)[:, 0].numpy(), None
    if context.in_parts:
        damping = force - stage.undamped().force(depth, rate, sheet.layout)[:, 0].numpy()
    if field.reached:
        return Field(force, field.columns, damping=damping)
    felt = (force != 0.0).any(axis=0)
    damping = None if damping is None else np.ascontiguousarray(damping[:, felt])
    return Field(np.ascontiguousarray(force[:, felt]), field.columns[felt], damping=damping)


def _whole(stage: Stage, field: Field, context: Context) -> Field:
    """On whole images, press by press."""
    sheet = context.sheet
    columns = np.arange(len(sheet.taxels))
    out = np.zeros((len(field.values), len(columns)))
    shape = (-1, sheet.layout.rows, sheet.layout.cols)
    for block, part, time_s in zip(sheet.blocks, field.parts(sheet), sheet.times_s, strict=True):
        image = np.zeros((len(time_s), sheet.layout.num_taxels))
        image[:, sheet.taxels[field.columns[part]]] = field.values[: len(time_s), part]
        frame = Frame(sheet.layout, stiffness_n_per_m=context.stiffness, load_conserving=sheet.loaded)
        result = stage.sequence(torch.from_numpy(image.reshape(shape)), torch.from_numpy(time_s), frame)
        out[: len(time_s), block] = result.numpy().reshape(len(time_s), -1)[:, sheet.taxels[block]]
    return Field(out, columns)


@lru_cache(maxsize=64)
def _flat(stage: Stage, level: float, layout: PadLayout) -> np.ndarray:
    """What a pad that reads `level` everywhere reads after the stage (R*C,)."""
    flat = torch.full((layout.rows, layout.cols), level, dtype=torch.float64)
    return stage.step(flat, {}, Frame(layout))[0].numpy().ravel()


def _of_flat(stage: Stage, level: float, sheet: Sheet, columns: np.ndarray) -> np.ndarray:
    """The same at some of a sheet's columns."""
    return _flat(stage, level, sheet.layout)[sheet.taxels[columns]]


def _added(stage: PadTilt | UnevenFace, field: Field, context: Context) -> Field:
    """Every taxel is moved by an amount of its own."""
    return Field(field.values + _of_flat(stage, 0.0, context.sheet, field.columns), field.columns, field.rate)


def _multiplied(stage: TaxelGainSpread | DeadTaxels, field: Field, context: Context) -> Field:
    """Every taxel has a factor of its own."""
    return Field(field.values * _of_flat(stage, 1.0, context.sheet, field.columns), field.columns)


def _everywhere(field: Field, context: Context) -> Field:
    """At all columns that are asked for: untouched taxels move, too."""
    return field.spread(
        context.wanted if context.wanted is not None else np.arange(len(context.sheet.taxels))
    )


def _softened(stage: Remembering, field: Field, context: Context) -> Field:
    """Earlier recordings count where the law asks for them."""
    return _alike(stage, field, context, context.sheet.borne if stage.session else ())


def _idle(stage: Idle, field: Field, context: Context) -> Field:
    field = _everywhere(field, context)
    return Field(field.values + _of_flat(stage, 0.0, context.sheet, field.columns), field.columns)


def _drift(stage: BaselineDrift, field: Field, context: Context) -> Field:
    sheet, field, everywhere = context.sheet, _everywhere(field, context), context.wanted is None
    moved = sheet.once((stage, everywhere), lambda: _drifted(stage, sheet, field.columns))
    return Field(field.values + moved, field.columns)


def _drifted(stage: BaselineDrift, sheet: Sheet, columns: np.ndarray) -> np.ndarray:
    """By how much readings move (G, m): every taxel's do, touched or not."""
    starts_s = np.zeros(len(sheet.starts_s)) if stage.anew else sheet.starts_s
    session_s = [time_s + start_s for time_s, start_s in zip(sheet.times_s, starts_s, strict=True)]
    ends = np.cumsum([len(time_s) for time_s in session_s])[:-1]
    # What all taxels do knows the time alone: the presses one after the other are one recording.
    known = [np.full(len(time_s), stage.reference_c) for time_s in session_s]
    warm_c = [old if warm is None else warm for old, warm in zip(known, sheet.warmth_c, strict=True)]
    frame = Frame(sheet.layout, temperature_c=torch.from_numpy(np.concatenate(warm_c)))
    when = torch.from_numpy(np.concatenate(session_s))
    nothing = torch.zeros((len(when), 1, 1), dtype=torch.float64)
    shared = replace(stage, rate_counts_per_s=0.0).sequence(nothing, when, frame)[:, 0].numpy()
    pad = (sheet.layout.rows, sheet.layout.cols)
    rates = np.broadcast_to(np.asarray(stage.rate_counts_per_s), pad).ravel()[sheet.taxels[columns]]
    out = np.zeros((max(len(time_s) for time_s in session_s), len(columns)))
    moves = zip(np.split(shared, ends), session_s, Field(out, columns).parts(sheet), strict=True)
    for part, time_s, own in moves:
        out[: len(part), own] = time_s[:, None] * rates[own] + part
    return out


def _mixed(field: Field, context: Context, weights: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Field:
    """Every reading a weighted sum over its press: weights(columns out, columns in) -> (out, in)."""
    sheet = context.sheet
    columns = context.wanted if context.wanted is not None else np.arange(len(sheet.taxels))
    out = np.zeros((len(field.values), len(columns)))
    to_parts = Field(out, columns).parts(sheet)
    for part, to, time_s in zip(field.parts(sheet), to_parts, sheet.times_s, strict=True):
        lines = len(time_s)
        mix = weights(columns[to], field.columns[part]).T
        np.matmul(field.values[:lines, part], mix, out=out[:lines, to])
    return Field(out, columns)


def _spreading(stage: MechanicalSpreading, field: Field, context: Context) -> Field:
    sheet = context.sheet
    if stage.rings:
        matrix = ring_matrix(sheet.layout.rows, sheet.layout.cols, stage.rings, stage.kept)
        return _mixed(field, context, lambda to, of: matrix[np.ix_(sheet.taxels[to], sheet.taxels[of])])
    sigma = torch.full((1, 1), stage.sigma_m / sheet.layout.pitch_m, dtype=torch.float64)
    rows, cols = sheet.layout.rows, sheet.layout.cols
    down, along = (spreading_matrix(count, sigma, stage.kept).numpy() for count in (rows, cols))

    def weights(to: np.ndarray, of: np.ndarray) -> np.ndarray:
        spread = down[np.ix_(sheet.rows[to], sheet.rows[of])] * along[np.ix_(sheet.cols[to], sheet.cols[of])]
        return spread * stage.share + (1.0 - stage.share) * (sheet.taxels[to][:, None] == sheet.taxels[of])

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


def _lowered(stage: Divider, field: Field, context: Context, group: np.ndarray) -> Field:
    """Readings under the load of their group: of all the sheet's columns (M,) the group's number, rising."""
    idle = np.asarray(stage.idle_counts, dtype=float)
    if idle.any():
        # Untouched taxels move, and touched ones count, whether or not they are asked for.
        field = field.spread(np.union1d(field.columns, _everywhere(field, context).columns))
    if not len(field.columns):
        return field
    begins = np.diff(group[field.columns], prepend=-1) > 0
    load = np.add.reduceat(field.values, np.flatnonzero(begins), axis=1)
    if isinstance(stage, LaggingDroop):
        for press, own in zip(group[field.columns[begins]], load.T, strict=True):
            time_s = context.sheet.times_s[press]
            known, seconds = (torch.from_numpy(item) for item in (own[: len(time_s)].copy(), time_s))
            own[: len(time_s)] = low_passed(known, seconds, stage.tau_s).numpy()
    every = np.take(load, np.cumsum(begins) - 1, axis=1)
    at_rest = idle.ravel()[context.sheet.taxels[field.columns]] if idle.ndim else idle
    return Field(stage.lowered(field.values, every, at_rest), field.columns)


def _row_sharing(stage: RowSharing, field: Field, context: Context) -> Field:
    sheet = context.sheet
    return _lowered(stage, field, context, sheet.press * sheet.layout.rows + sheet.rows)


def _supply_droop(stage: SupplyDroop, field: Field, context: Context) -> Field:
    return _lowered(stage, field, context, context.sheet.press)


def _late(stage: Latency, field: Field, context: Context) -> Field:
    return late(stage, field, context) if stage.plain else _alike(stage, field, context)


def _convert(stage: Quantisation, field: Field, context: Context) -> Field:
    """Clipping alone: rounding is not differentiable, and the mean over noise is not rounded."""
    idle = context.sheet.idle[field.columns]
    clipped = np.maximum(field.values, -idle)
    np.minimum(clipped, np.maximum(stage.full_scale_counts - idle, 0.0), out=clipped)
    return Field(clipped, field.columns)


OWN_TAXELS: dict[type, Callable[[Any, Field, Context], Field]] = {
    PadTilt: _added,
    UnevenFace: _added,
    MechanicalSpreading: _spreading,
    Hysteresis: _looped,
    RestingHysteresis: _looped,
    LoadingHysteresis: _looped,
    ViscoelasticRelaxation: _relaxing,
    FirstLoadSoftening: _softened,
    PathSoftening: _softened,
    TaxelGainSpread: _multiplied,
    DeadTaxels: _multiplied,
    RowSharing: _row_sharing,
    SupplyDroop: _supply_droop,
    LaggingDroop: _supply_droop,
    Crosstalk: _crosstalk,
    Idle: _idle,
    BaselineDrift: _drift,
    Latency: _late,
    ScanSkew: scan_skew,
    SampleAndHold: hold,
    Quantisation: _convert,
}
"""Stages that know which taxel they act on, or what else the recording tells."""
SEPARATE = (
    PadTilt
    | UnevenFace
    | TaxelGainSpread
    | DeadTaxels
    | Idle
    | BaselineDrift
    | ScanSkew
    | SampleAndHold
    | Quantisation
)
"""Of these, those that do not mix a taxel with others."""
KEEPS_ORDER = (ContactOffset, StiffeningDepth, PadTilt, UnevenFace)
"""Stages of the face that leave the higher of two heights of a taxel the higher one."""
