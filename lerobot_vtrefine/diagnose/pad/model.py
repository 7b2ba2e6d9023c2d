"""A model under test: the baseline's coordinates, the forms added to it, and maps over taxels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.diagnose.pad.idle_map import IdleMap
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.readout import (
    BaselineDrift,
    Crosstalk,
    DeadTaxels,
    Gain,
    Idle,
    Noise,
    Quantisation,
    TaxelGainSpread,
)

BASE = (Value("log_gain", -60.0, 60.0, 1e-3), Value("damping_s", 0.0, 0.5, 2e-4))
"""Baseline's coordinates: log of counts per metre (or per newton when driven by load), and k_d / k_n."""
LOG_GAIN = 0
"""Number of the gain's coordinate."""
GAIN_RANGE = 1.5
"""How far a fit may move the logarithm of the plain baseline's gain."""
NOMINAL_K_N = 400.0
"""Stiffness where no load cell tells it [N/m]; then only gain * k_n matters."""


@dataclass(frozen=True)
class Composite:
    """Baseline plus forms. `values` are the baseline's coordinates, then those of every form in order."""

    setting: Setting
    values: np.ndarray
    forms: tuple[Form, ...] = ()
    gain_map: np.ndarray | None = None
    """Factor per taxel (R, C), or None."""
    gain_variances: tuple[float, ...] = ()
    """Of the map's parts (see `map_prior`)."""
    face_variances: tuple[float, ...] = ()
    """Of the parts of the face's map, where the contact offset is another at every taxel (`face_map`)."""
    dead: Mapping[tuple[int, int], float] = field(default_factory=dict)
    """Taxels that hardly answer -> what is left, a part of a sound one's answer."""
    k_n: float = NOMINAL_K_N

    @property
    def gain_sigma(self) -> float:
        """Deviation of the logarithms of taxels' gains."""
        return float(np.sqrt(sum(self.gain_variances)))

    @property
    def families(self) -> tuple[str, ...]:
        """Names of the causes in the model."""
        maps = (["taxel_gain_spread"] if self.gain_map is not None else []) + (
            ["dead_taxels"] if self.dead else []
        )
        return (*(form.family for form in self.forms), *maps)

    @property
    def coordinates(self) -> tuple[Value, ...]:
        """All fitted coordinates, with bounds."""
        return (*self._base, *(value for form in self.forms for value in form.values))

    @property
    def _base(self) -> tuple[Value, Value]:
        """The baseline's coordinates: no extension turns the gain into something else altogether.

        Weights forgive a recording its own gain, and so would forgive a model that predicts next to nothing.
        """
        middle = self.setting.log_gain
        if middle is None:
            return BASE
        return replace(BASE[0], low=middle - GAIN_RANGE, high=middle + GAIN_RANGE), BASE[1]

    @property
    def free(self) -> np.ndarray:
        """Numbers of the coordinates that a descent changes."""
        usable = [value.step > 0 for value in self.coordinates]
        usable[1] = not self.setting.loaded
        return np.flatnonzero(usable)

    def own(self, index: int) -> np.ndarray:
        """Coordinates of form number `index`."""
        return self.values[self.place(index)]

    def place(self, index: int) -> slice:
        """Where form number `index` has its coordinates."""
        begin = len(BASE) + sum(len(form.values) for form in self.forms[:index])
        return slice(begin, begin + len(self.forms[index].values))

    def at(self, values: np.ndarray) -> "Composite":
        """The same model elsewhere."""
        return replace(self, values=np.asarray(values, dtype=float))

    def plus(self, form: Form, values: np.ndarray) -> "Composite":
        """With a form added (in place of another form of its family)."""
        slim = self.minus(form.family) if form.family in [other.family for other in self.forms] else self
        return replace(
            slim, forms=(*slim.forms, form), values=np.concatenate([slim.values, np.asarray(values, float)])
        )

    def minus(self, family: str) -> "Composite":
        """Without a cause."""
        if family == "taxel_gain_spread":
            return replace(self, gain_map=None, gain_variances=())
        if family == "dead_taxels":
            return replace(self, dead={})
        keep = [index for index, form in enumerate(self.forms) if form.family != family]
        parts = [self.values[: len(BASE)], *(self.own(index) for index in keep)]
        return replace(self, forms=tuple(self.forms[index] for index in keep), values=np.concatenate(parts))

    def before_leaks(self) -> "Composite":
        """Without what leaks between readings after the taxels' gains; itself where nothing does."""
        for form in self.forms:
            if form.family == Crosstalk.name and (form.rank or Crosstalk.rank) > TaxelGainSpread.rank:
                return self.minus(form.family)
        return self

    def stages(self) -> tuple[Stage, ...]:
        """The simulator's stages without the idle level, in order."""
        gain, damping_s = float(np.exp(self.values[0])), float(self.values[1])
        loaded = self.setting.loaded
        contact = KelvinVoigt(k_n=self.k_n, k_d=0.0 if loaded else self.k_n * damping_s)
        stages: list[Stage] = [contact, Gain(gain if loaded else gain / self.k_n)]
        for index, form in enumerate(self.forms):
            stages += form.build(self.own(index), self.setting)
        if self.gain_map is not None:
            stages.append(TaxelGainSpread(self.gain_sigma, self.gain_map))  # ty: ignore[invalid-argument-type]
        if self.dead:
            stages.append(DeadTaxels(tuple(self.dead), left=tuple(self.dead.values())))
        stages.append(Quantisation(1.0, self.setting.full_scale))
        return self.in_order(stages)

    def in_order(self, stages: Sequence[Stage]) -> tuple[Stage, ...]:
        """Stages in the order in which they act."""
        elsewhere = {form.family: form.rank for form in self.forms if form.rank is not None}
        return tuple(sorted(stages, key=lambda stage: elsewhere.get(stage.name, stage.rank)))


def sensor_model(
    composite: Composite, idle: IdleMap, step_counts: float, noise_counts: float = 0.0
) -> SensorModel:
    """The model as users load it: with the idle map, and the converter that clips (and rounds).

    `noise_counts` is what simulations add; predictions leave it out.
    """
    stages = [stage for stage in composite.stages() if not isinstance(stage, Idle | Quantisation)]
    drift = next((stage for stage in stages if isinstance(stage, BaselineDrift)), None)
    level = idle.level
    if drift is not None:
        level = level - np.asarray(drift.rate_counts_per_s) * (idle.time_s if drift.anew else idle.session_s)
    # Plain floats: the file is JSON.
    stages.append(Idle(tuple(tuple(float(v) for v in row) for row in level), 0.0))
    if noise_counts > 0.0:
        stages.append(Noise(noise_counts))
    stages.append(Quantisation(step_counts or 1e-3, composite.setting.full_scale))
    return SensorModel(composite.in_order([_plain(stage) for stage in stages]))


def _plain(stage: Stage) -> Stage:
    if isinstance(stage, TaxelGainSpread) and stage.map is not None:
        rows = tuple(tuple(round(float(v), 6) for v in row) for row in np.asarray(stage.map))
        return TaxelGainSpread(stage.sigma, rows)
    return stage


def stiffness_from_load(presses: PressSet, composite: Composite) -> float | None:
    """k_n that makes forces add up to the load cell's, by least squares; None without load [N/m]."""
    if presses.loaded:
        return None
    damping_s = float(composite.values[1])
    top, bottom = 0.0, 0.0
    for press in presses.presses:
        load = press.trial.force_n
        if load is None or not np.isfinite(load).all():
            continue
        depth = np.where(press.drive > 0, np.maximum(press.drive + damping_s * press.rate, 0.0), 0.0)
        total = depth.sum(axis=(1, 2))
        top, bottom = top + float(total @ load), bottom + float(total @ total)
    return top / bottom if bottom > 0 and top > 0 else None
