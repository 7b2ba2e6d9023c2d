"""Many presses through the simulator's stages at once, in double precision, for fitting.

Every stage of the catalogue has a fast equal on sheets (a test holds each to the stage itself); a stage that
is not listed runs its own code, press by press.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from lerobot_vtrefine.diagnose.fields import Context, Field
from lerobot_vtrefine.diagnose.memory_stages import MEMORY
from lerobot_vtrefine.diagnose.momentary_stages import MIXING, SEPARATE
from lerobot_vtrefine.diagnose.presses import Press
from lerobot_vtrefine.diagnose.refinement import Kind, instants
from lerobot_vtrefine.diagnose.sheets import Sheet, build_sheet
from lerobot_vtrefine.tactile.stages.base import Frame, Stage
from lerobot_vtrefine.tactile.stages.contact import ContactStage
from lerobot_vtrefine.tactile.stages.mechanics import NonlinearStiffness
from lerobot_vtrefine.tactile.stages.readout import TaxelGainSpread

FAST = MEMORY | SEPARATE | MIXING


class Bench:
    """Presses ready to be run through models; sheets are built once per set."""

    def __init__(self, presses: Sequence[Press], idle: np.ndarray) -> None:
        self.presses, self._idle = presses, idle
        self._sheets: dict[Kind, Sheet] = {}

    def sheet(self, kind: Kind) -> Sheet:
        """The presses at a model's instants."""
        if kind not in self._sheets:
            self._sheets[kind] = build_sheet(self.presses, self._idle, kind)
        return self._sheets[kind]


def run_stages(stages: Sequence[Stage], bench: Bench, cache: "Prefix | None" = None) -> list[np.ndarray]:
    """Counts above idle that the stages predict for every press: (T, n) of its scored taxels.

    With a cache, work that earlier stages did for the same parameters is not repeated.
    """
    if not bench.presses:
        return []
    kind = instants(tuple(stages))
    sheet = bench.sheet(kind)
    contact = next(stage for stage in stages if isinstance(stage, ContactStage))
    context = Context(sheet, float(contact.stiffness(sheet.layout)))
    start, field = cache.lookup(stages, kind) if cache is not None else (0, None)
    if field is None:
        field = Field(sheet.drive, np.arange(len(sheet.taxels)), sheet.rate)
        if sheet.loaded or not any(stage.domain == "depth" for stage in stages):
            field = Field(sheet.drive[:, sheet.touched], sheet.touched, sheet.rate[:, sheet.touched])
    for index in range(start, len(stages)):
        # What nothing mixes with others any more is needed at scored taxels only.
        wanted = None if mixes(stages[index + 1 :]) else sheet.all_scored
        field = _apply(stages[index], field, context, wanted)
        if cache is not None:
            cache.store(index, field)
    return _scatter(field, sheet)


def mixes(stages: Sequence[Stage]) -> bool:
    """Whether any of the stages may mix a taxel with its neighbours."""
    own = tuple(SEPARATE) + tuple(MEMORY)
    return any(not isinstance(stage, own) and not isinstance(stage, ContactStage) for stage in stages)


def _scatter(field: Field, sheet: Sheet) -> list[np.ndarray]:
    """(T, n) per press, of its scored taxels at the recorded frames."""
    full = field.spread(sheet.all_scored)
    ends = np.cumsum([0, *(len(columns) for columns in sheet.scored)]).tolist()
    return [
        np.ascontiguousarray(full.values[frames, begin:end])
        for frames, begin, end in zip(sheet.frames, ends[:-1], ends[1:], strict=True)
    ]


class Prefix:
    """Fields after every stage of one reference model; a model that differs later starts from there."""

    def __init__(self) -> None:
        self.keys: list[Any] = []
        self.fields: list[Field] = []
        self.frozen = False

    def lookup(self, stages: Sequence[Stage], kind: Kind) -> tuple[int, Field | None]:
        """Number of leading stages already done at those instants, and their field."""
        later = [mixes(stages[index + 1 :]) for index in range(len(stages))]
        keys = [(kind, mixed, _key(stage)) for stage, mixed in zip(stages, later, strict=True)]
        same = 0
        while same < min(len(keys), len(self.keys)) and keys[same] == self.keys[same]:
            same += 1
        if not self.frozen:
            self.keys = keys
            self.fields = self.fields[:same]
        return same, (self.fields[same - 1] if same else None)

    def store(self, index: int, field: Field) -> None:
        """Keep the field after stage `index`, unless frozen."""
        if not self.frozen:
            self.fields[index:] = [field]


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


def _apply(stage: Stage, field: Field, context: Context, wanted: np.ndarray | None) -> Field:
    sheet = context.sheet
    if sheet.loaded and (isinstance(stage, ContactStage) or stage.domain == "depth"):
        return field
    if isinstance(stage, ContactStage):
        return _contact(stage, field, sheet)
    context = Context(sheet, context.stiffness, wanted)
    fast = FAST.get(type(stage))
    if fast is None or (sheet.loaded and isinstance(stage, NonlinearStiffness)):
        return _own(stage, field, context)
    return fast(stage, field, context)


def _contact(stage: ContactStage, field: Field, sheet: Sheet) -> Field:
    depth, rate = (torch.from_numpy(np.ascontiguousarray(v)) for v in (field.values, field.rate))
    force = stage.force(depth[:, None], rate[:, None], sheet.layout)[:, 0].numpy()
    if field.columns is sheet.touched:
        return Field(force, field.columns)
    felt = force.any(axis=0)
    return Field(np.ascontiguousarray(force[:, felt]), field.columns[felt])


def _own(stage: Stage, field: Field, context: Context) -> Field:
    """The stage's own code on whole images, press by press."""
    sheet = context.sheet
    columns = np.arange(len(sheet.taxels))
    out = np.zeros((len(field.values), len(columns)))
    shape = (-1, sheet.layout.rows, sheet.layout.cols)
    for press, (block, time_s) in enumerate(zip(sheet.blocks, sheet.times_s, strict=True)):
        part = field.within(sheet, press)
        image = np.zeros((len(time_s), sheet.layout.num_taxels))
        image[:, sheet.taxels[field.columns[part]]] = field.values[: len(time_s), part]
        frame = Frame(sheet.layout, stiffness_n_per_m=context.stiffness, load_conserving=sheet.loaded)
        result = stage.sequence(torch.from_numpy(image.reshape(shape)), torch.from_numpy(time_s), frame)
        out[: len(time_s), block] = result.numpy().reshape(len(time_s), -1)[:, sheet.taxels[block]]
    return Field(out, columns)
