"""What passes from stage to stage while fitting: values of some of a sheet's columns."""

from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, starmap

import numpy as np
import torch

from lerobot_vtrefine.diagnose.pad.forward_model.batches import Sheet


@dataclass(frozen=True)
class Field:
    """Values (G, m) of some of a sheet's columns; all others are zero. Depths before the contact law."""

    values: np.ndarray
    columns: np.ndarray
    """Numbers of the columns in the sheet (m,), rising."""
    rate: np.ndarray | None = None
    damping: np.ndarray | None = None
    """Part of forces that damping bears, where a stage asks for it [N]."""
    reached: bool = False
    """Whether the indenter reaches all these columns."""
    recorded: bool = False
    """Whether a stage has left only the recorded frames."""

    @cached_property
    def memories(self) -> dict[Hashable, list[torch.Tensor]]:
        """Memories of loops and slow springs over these values, by the laws that they follow: other fractions
        have the same."""
        return {}

    def parts(self, sheet: Sheet) -> list[slice]:
        """Where every press's columns are among these."""
        ends = [sheet.blocks[0].start, *(block.stop for block in sheet.blocks)]
        return list(starmap(slice, pairwise(np.searchsorted(self.columns, ends).tolist())))

    def at_frames(self, sheet: Sheet) -> "Field":
        """At the recorded frames only, as `sheet.recorded` has them."""
        if self.recorded or sheet.recorded is sheet:
            return self

        def kept(values: np.ndarray) -> np.ndarray:
            out = np.zeros((max(len(frames) for frames in sheet.frames), len(self.columns)))
            for part, frames in zip(self.parts(sheet), sheet.frames, strict=True):
                out[: len(frames), part] = values[frames, part]
            return out

        return Field(
            kept(self.values), self.columns, damping=None if self.damping is None else kept(self.damping)
        )

    def spread(self, columns: np.ndarray) -> "Field":
        """At other columns, zero where these have none."""
        if columns is self.columns:
            return self
        out = np.zeros((len(self.values), len(columns)))
        _, here, there = np.intersect1d(self.columns, columns, assume_unique=True, return_indices=True)
        # Whole columns: an index of columns runs through an array five times as slowly as `take`.
        out[:, there] = np.take(self.values, here, axis=1)
        return Field(out, columns)


@dataclass(frozen=True)
class Context:
    """What a fast stage may know: the presses, one taxel's stiffness [N/m], and where results are needed."""

    sheet: Sheet
    stiffness: float
    wanted: np.ndarray | None = None
    """Numbers of the columns in which a stage that mixes taxels should answer; None for all."""
    in_parts: bool = False
    """Whether a later stage asks which part of a force damping bears."""
    frames_only: bool = False
    """Whether nothing later needs more than the recorded frames, so that a stage may leave out the others."""
