"""Stages that say when a reading was taken: asked at the recorded frames alone, where no more is needed."""

from collections.abc import Callable

import numpy as np
import torch

from lerobot_vtrefine.diagnose.pad.forward_model.fields import Context, Field
from lerobot_vtrefine.diagnose.pad.repeated_frames import Rhythm
from lerobot_vtrefine.tactile.stages.host import Latency, SampleAndHold, ScanSkew, taken_at_frames
from lerobot_vtrefine.tactile.stages.signals import joined, neighbours

Show = Callable[[int, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def _as_asked(field: Field, context: Context, show: Show) -> Field:
    """show(number of a press, values (T, m), columns (m,), instants (N,)) of every press: (N, m), at the
    recorded frames where nothing later needs more."""
    sheet = context.sheet
    asked = sheet.frames if context.frames_only else [np.arange(len(time_s)) for time_s in sheet.times_s]
    out = np.zeros((max(len(own) for own in asked), len(field.columns)))
    presses = zip(sheet.times_s, asked, field.parts(sheet), strict=True)
    for press, (time_s, own, part) in enumerate(presses):
        x = np.ascontiguousarray(field.values[: len(time_s), part])
        out[: len(own), part] = show(press, x, field.columns[part], own)
    return Field(out, field.columns, recorded=context.frames_only)


def scan_skew(stage: ScanSkew, field: Field, context: Context) -> Field:
    """Every row is read at a time of its own."""
    layout, taxels, times_s = context.sheet.layout, context.sheet.taxels, context.sheet.times_s

    def show(press: int, x: np.ndarray, columns: np.ndarray, own: np.ndarray) -> np.ndarray:
        row, col = (torch.from_numpy(part.astype(float)) for part in np.divmod(taxels[columns], layout.cols))
        late_s = stage.late_s(row, col, layout.rows, layout.cols).numpy()
        # Taxels of a row are read as one.
        each_s, which = np.unique(late_s, return_inverse=True)
        after, share = neighbours(times_s[press], times_s[press][own, None] - each_s)
        return joined(x, np.take(after, which, axis=1), np.take(share, which, axis=1))

    return _as_asked(field, context, show)


def late(stage: Latency, field: Field, context: Context) -> Field:
    """Of a delay alone."""
    times_s = context.sheet.times_s

    def show(press: int, x: np.ndarray, columns: np.ndarray, own: np.ndarray) -> np.ndarray:
        when_s = times_s[press][own]
        return joined(x, *neighbours(times_s[press], when_s - np.asarray(stage.late_s(when_s))))

    return _as_asked(field, context, show)


def hold(stage: SampleAndHold, field: Field, context: Context) -> Field:
    """The instants of a free board, or of each of its groups of rows, are those that the recording shows."""
    sheet = context.sheet

    def show(press: int, x: np.ndarray, columns: np.ndarray, own: np.ndarray) -> np.ndarray:
        shown = np.zeros((len(own), len(columns)))
        group = stage.group_of(sheet.rows[columns], sheet.layout.rows) if stage.groups else None
        for number, known in enumerate(sheet.rhythms[press].parts(stage.groups)):
            mine = slice(None) if group is None else np.flatnonzero(group == number)
            shown[:, mine] = _held(stage, x[:, mine], known, sheet.times_s[press], own)
        return shown

    return _as_asked(field, context, show)


def _held(
    stage: SampleAndHold, x: np.ndarray, rhythm: Rhythm, time_s: np.ndarray, own: np.ndarray
) -> np.ndarray:
    """What taxels x (T, n) of one rhythm show at some of the instants (T,)."""
    if stage.ages_s or (stage.frame_s and stage.free):
        return joined(x, *neighbours(time_s, rhythm.taken_s(time_s[own]) - stage.lag_s))
    if stage.frame_s:
        return joined(x, *neighbours(time_s, taken_at_frames(time_s[own], stage.period_s, stage.frame_s)))
    phase = rhythm.phase(stage.period_s) if stage.free else 0.0
    return np.take(x, stage.shown(torch.from_numpy(time_s), phase).numpy()[own], axis=0)
