"""Many presses through the simulator's stages at once, in double precision, for fitting."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.pad.forward_model.batches import Sheet, build_sheets
from lerobot_vtrefine.diagnose.pad.forward_model.fields import Context, Field
from lerobot_vtrefine.diagnose.pad.forward_model.stages import KEEPS_ORDER, run_stage, treats_each_alone
from lerobot_vtrefine.diagnose.pad.motion import Kind, instants
from lerobot_vtrefine.diagnose.pad.press_trials import Press
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.contact import ContactStage
from lerobot_vtrefine.tactile.stages.cover import on_springs
from lerobot_vtrefine.tactile.stages.readout import TaxelGainSpread


class Bench:
    """Presses ready to be run through models; sheets are built once per set."""

    def __init__(self, presses: Sequence[Press], idle: np.ndarray) -> None:
        self.presses, self._idle = presses, idle
        self._sheets: dict[Kind, list[Sheet]] = {}
        self._building = threading.Lock()

    def sheets(self, kind: Kind) -> list[Sheet]:
        """The presses at a model's instants."""
        with self._building:
            if kind not in self._sheets:
                self._sheets[kind] = build_sheets(self.presses, self._idle, kind)
            return self._sheets[kind]

    def lowered_m(self, sheet: Sheet) -> np.ndarray | None:
        """How much lower than recorded the face is, at every column (M,); None: nowhere."""
        return None


@dataclass(frozen=True)
class LoweredBench:
    """The same presses with the face lowered: in all of them alike, in each by its own amount (K,), or at
    every taxel (R, C)."""

    bench: "Bench | LoweredBench"
    by_m: float | np.ndarray

    @property
    def presses(self) -> Sequence[Press]:
        """As recorded."""
        return self.bench.presses

    def sheets(self, kind: Kind) -> list[Sheet]:
        """The presses at a model's instants."""
        return self.bench.sheets(kind)

    def lowered_m(self, sheet: Sheet) -> np.ndarray | None:
        """See `Bench.lowered_m`."""
        before, own = self.bench.lowered_m(sheet), self._of_columns(sheet)
        return np.broadcast_to(own if before is None else before + own, sheet.taxels.shape)

    def _of_columns(self, sheet: Sheet) -> float | np.ndarray:
        if not isinstance(self.by_m, np.ndarray):
            return self.by_m
        if self.by_m.ndim == 2:
            return self.by_m.ravel()[sheet.taxels]
        widths = [block.stop - block.start for block in sheet.blocks]
        return np.repeat(self.by_m[list(sheet.members)], widths)


@dataclass(frozen=True)
class Plan:
    """What a model's stages need of the fields between them.

    Attributes:
        mixed: per stage, whether a later one may mix a taxel with its neighbours.
        remembered: per stage, whether a later one has memory, so that all instants count.
        in_parts: whether a stage asks which part of a force damping bears.
    """

    stages: Sequence[Stage]
    kind: Kind
    mixed: tuple[bool, ...]
    remembered: tuple[bool, ...]
    in_parts: bool

    @classmethod
    def of(cls, stages: Sequence[Stage]) -> "Plan":
        """The plan of a model."""
        rests = [tuple(stages[index + 1 :]) for index in range(len(stages))]
        remembered = tuple(instants(rest) != "frames" for rest in rests)
        in_parts = any(on_springs(stage) for stage in stages)
        return cls(
            stages, instants(tuple(stages)), tuple(mixes(rest) for rest in rests), remembered, in_parts
        )

    @property
    def keys(self) -> list[Any]:
        """What a stage's field depends on, beside the stages before it."""
        steps = zip(self.stages, self.mixed, self.remembered, strict=True)
        common = (self.kind, self.in_parts)
        return [(common, mixed, remembered, _key(stage)) for stage, mixed, remembered in steps]


def run_stages(
    stages: Sequence[Stage], bench: Bench | LoweredBench, cache: "Prefix | None" = None
) -> list[np.ndarray]:
    """Counts above idle that the stages predict for every press: (T, n) of its scored taxels.

    With a cache, work that earlier stages did for the same parameters is not repeated.
    """
    if not bench.presses:
        return []
    plan = Plan.of(stages)
    sheets = bench.sheets(plan.kind)
    start, fields = cache.lookup(plan) if cache is not None else (0, None)
    if fields is None:
        fields = [_begin(stages, sheet, bench.lowered_m(sheet)) for sheet in sheets]
    for index in range(start, len(stages)):
        fields = [_step(plan, index, field, sheet) for field, sheet in zip(fields, sheets, strict=True)]
        if cache is not None:
            cache.store(index, fields)
    found: list[np.ndarray] = [np.empty(0)] * len(bench.presses)
    for field, sheet in zip(fields, sheets, strict=True):
        _scatter(field, sheet.recorded, found)
    return found


def _begin(stages: Sequence[Stage], sheet: Sheet, lowered_m: np.ndarray | None) -> Field:
    moved = [stage for stage in stages if stage.domain == "depth"]
    if sheet.loaded or not moved:
        if lowered_m is None:
            return Field(*sheet.pressed, reached=True)
        return Field(*sheet.moving(np.flatnonzero(sheet.top > lowered_m), lowered_m), reached=True)
    lowered_m = np.zeros(len(sheet.taxels)) if lowered_m is None else lowered_m
    return Field(*sheet.moving(_reached(moved, sheet, lowered_m), lowered_m))


def _reached(stages: Sequence[Stage], sheet: Sheet, lowered_m: np.ndarray) -> np.ndarray:
    """Numbers of the columns that are pressed at all after stages that move the face, as their highest tell;
    of all columns where a stage may take a higher one for a lower one."""
    columns = np.arange(len(sheet.taxels))
    if not all(isinstance(stage, KEEPS_ORDER) for stage in stages):
        return columns
    highest = (sheet.top - lowered_m)[None]
    field = Field(highest, columns, np.zeros_like(highest))
    for stage in stages:
        field = run_stage(stage, field, Context(sheet, 0.0))
    return np.flatnonzero(field.values[0] > 0)


def _step(plan: Plan, index: int, field: Field, sheet: Sheet) -> Field:
    """Stage number `index`; once no later one has memory, only recorded frames are kept."""
    stages = plan.stages
    contact = next(stage for stage in stages if isinstance(stage, ContactStage))
    before = plan.remembered[index - 1] if index else True
    # What nothing mixes with others any more is needed at scored taxels only.
    wanted = None if plan.mixed[index] else sheet.all_scored
    place = sheet if before else sheet.recorded
    stiffness = float(contact.stiffness(sheet.layout))
    last = before and not plan.remembered[index]
    field = run_stage(stages[index], field, Context(place, stiffness, wanted, plan.in_parts, last))
    return field.at_frames(place) if last else field


def mixes(stages: Sequence[Stage]) -> bool:
    """Whether any of the stages may mix a taxel with its neighbours."""
    return not all(treats_each_alone(stage) for stage in stages)


def _scatter(field: Field, sheet: Sheet, found: list[np.ndarray]) -> None:
    """(T, n) of each press's scored taxels into its place among all presses."""
    presses = zip(sheet.members, sheet.frames, sheet.scored, field.parts(sheet), strict=True)
    for member, frames, scored, part in presses:
        own = field.columns[part]
        if np.array_equal(own, scored):
            found[member] = np.ascontiguousarray(field.values[: len(frames), part])
            continue
        place = np.searchsorted(scored, own).clip(max=len(scored) - 1)
        kept = scored[place] == own
        found[member] = np.zeros((len(frames), len(scored)))
        found[member][:, place[kept]] = field.values[: len(frames), part][:, kept]


class Prefix:
    """Fields after every stage of one reference model; a model that differs later starts from there."""

    def __init__(self) -> None:
        self.keys: list[Any] = []
        self.fields: list[list[Field]] = []
        self.frozen = False

    def lookup(self, plan: Plan) -> tuple[int, list[Field] | None]:
        """Number of leading stages already done at those instants, and their fields."""
        keys = plan.keys
        same = 0
        while same < min(len(keys), len(self.keys)) and keys[same] == self.keys[same]:
            same += 1
        if not self.frozen:
            self.keys = keys
            self.fields = self.fields[:same]
        return same, (self.fields[same - 1] if same else None)

    def store(self, index: int, fields: list[Field]) -> None:
        """Keep the fields after stage `index`, unless frozen."""
        if not self.frozen:
            self.fields[index:] = [fields]


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
