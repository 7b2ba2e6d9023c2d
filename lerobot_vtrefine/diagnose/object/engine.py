"""The diagnosis of parts: episodes of the twin's robot in, object_mass, object_friction and clearance out.

Each is named only where episodes show it: the estimate lessens the error of episodes left out of the fit, all
of them saying so together, and differs from what the simulation assumes by more than the method errs. Where
the recordings cannot tell, the evidence says what to record.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.evidence import Evidence, TrialError
from lerobot_vtrefine.diagnose.object.clearance import contacts_of, estimate_clearance
from lerobot_vtrefine.diagnose.object.episodes import AssumedScene, HandledEpisode
from lerobot_vtrefine.diagnose.object.friction import estimate_friction
from lerobot_vtrefine.diagnose.object.mass import PartMass, estimate_masses
from lerobot_vtrefine.diagnose.object.payload import GRAVITY_M_S2, Arms, replay_loaded
from lerobot_vtrefine.diagnose.object.regression import Line
from lerobot_vtrefine.diagnose.verdict import Cause, Heldout, Parameter, Status
from lerobot_vtrefine.sim.scene import build_scene

Array = np.ndarray

ALPHA = 0.02
LEAST_GAIN = 0.01
MASS_FORM = (0.06, 0.004)
"""What the method errs by on the twin's own recordings: part of the value, and at least so much [kg]."""
FRICTION_FORM = (0.1, 0.02)
CLEARANCE_FORM = (0.03, 6e-5)
_SURE = 4.0
UNKNOWN_PARTS = (
    "the parts are not known: datasets of vtrefine-record-demos note the assumed scene, others hold no part "
    "that the twin could carry"
)
PAD_FRICTION = (
    "friction between pads and part: not identifiable, because pads tell how hard they are pressed but not "
    "when the part slips, and no joint's load tells the pull; close the hand on a part that is clamped to "
    "the table, pull until it slips at two closing forces, five times each, and record the joints' load"
)
_ROUND = (
    "pads close along one axis only, and along that axis a round hole is as wide as assumed only where the "
    "plug is in its middle: use a pair with flat walls"
)


@dataclass(frozen=True)
class Estimate:
    """One number about the parts beside what the simulation assumes."""

    cause: str
    name: str
    assumed: float
    line: Line | None
    form: tuple[float, float]
    unit: str
    reason: str = ""

    @property
    def found(self) -> bool:
        """Whether episodes show that it differs from what is assumed."""
        if self.line is None or self.reason:
            return False
        sure = self.line.p_value < ALPHA and self.line.gain > LEAST_GAIN
        return sure and abs(self.line.value) > max(2 * self.line.error, 2 * self.slack)

    @property
    def slack(self) -> float:
        """What the method itself may err by."""
        value = self.assumed + (0.0 if self.line is None else self.line.value)
        return max(self.form[0] * abs(value), self.form[1])

    @property
    def believed(self) -> float:
        """The estimate where it is found to differ, else what is assumed."""
        return self.assumed + self.line.value if self.found and self.line is not None else self.assumed

    @property
    def parameter(self) -> Parameter:
        """The value, with the method's error in its interval."""
        assert self.line is not None
        half = float(np.hypot((self.line.ci95[1] - self.line.ci95[0]) / 2, self.slack))
        value = self.assumed + self.line.value
        return Parameter(value, (value - half, value + half), self.unit)

    @property
    def evidence(self) -> Evidence:
        """For the report."""
        if self.line is None:
            return Evidence(self.cause, None, None, None, "not identifiable", self.reason)
        value = f"{self.name} {self.assumed + self.line.value:.4g} {self.unit} against {self.assumed:.4g}"
        decision = "accepted" if self.found else "rejected"
        text = f"{value}; {self.reason}" if self.reason else value
        return Evidence(self.cause, self.line.p_value, self.line.p_value, self.line.gain, decision, text)


@dataclass(frozen=True)
class ObjectDiagnosis:
    """What was found about the parts."""

    causes: tuple[Cause, ...]
    evidence: tuple[Evidence, ...]
    minimum_detectable: Mapping[str, float]
    next_experiment: Mapping[str, Any] | None
    mass_kg: Array = field(repr=False)
    """(2,) of socket and plug, as found where they differ from what was assumed; zero where unknown."""
    ambiguous_with: tuple[tuple[str, ...], ...] = ()
    heldout: Heldout | None = None
    """Estimates differ in what they are errors of: each cause's own gain says what it takes away."""
    trial_errors: tuple[TrialError, ...] = ()
    unit: str = "rad"

    @property
    def status(self) -> Status:
        """explained where something was found, else adequate: nothing is known to be wrong."""
        return "explained" if self.causes else "adequate"


def unknown_parts() -> ObjectDiagnosis:
    """Of a dataset whose parts the twin does not know."""
    names = ("object_mass", "object_friction", "clearance")
    evidence = tuple(Evidence(name, None, None, None, "not identifiable", UNKNOWN_PARTS) for name in names)
    return ObjectDiagnosis((), evidence, {}, None, np.zeros(2))


def assumed_masses(scene: AssumedScene) -> Array:
    """(2,) of socket and plug [kg]."""
    built = build_scene(scene.scene)
    return np.array([built.model.body_mass[built.socket_body], built.model.body_mass[built.plug_body]])


def found_masses(arms: Arms, scene: AssumedScene, episodes: Sequence[HandledEpisode], seed: int) -> Array:
    """(2,) of socket and plug as episodes show them, as assumed where they show nothing else."""
    masses = estimate_masses(arms, episodes, assumed_masses(scene), seed)
    return np.array([_of_mass(item).believed for item in masses])


def diagnose_objects(
    arms: Arms,
    scene: AssumedScene,
    episodes: Sequence[HandledEpisode],
    seed: int = 0,
) -> ObjectDiagnosis:
    """Judge the parts of episodes whose encoders are trusted (what robots get wrong taken off before)."""
    estimates = [_of_mass(item) for item in estimate_masses(arms, episodes, assumed_masses(scene), seed)]
    mass = np.array([item.believed for item in estimates])
    weights = [episode.hanging * mass * GRAVITY_M_S2 for episode in episodes]
    untouched = replay_loaded(arms, episodes, weights, contacts=False)
    contacts = contacts_of(arms, scene, episodes, untouched)
    line, reason = estimate_friction(scene, episodes, contacts, seed)
    known = scene.scene.part_friction
    estimates.append(Estimate("object_friction", "friction", known, line, FRICTION_FORM, "1", reason))
    slip = scene.scene.pad_friction
    estimates.append(
        Estimate("object_friction", "pad_friction", slip, None, FRICTION_FORM, "1", PAD_FRICTION)
    )
    line, reason = estimate_clearance(scene, episodes, contacts, seed)
    if line is not None and scene.pair.name == "round" and line.value < 0:
        reason = _ROUND
    known = scene.scene.hole_clearance_m
    estimates.append(Estimate("clearance", "clearance", known, line, CLEARANCE_FORM, "m", reason))
    return _summary(estimates, mass)


def _of_mass(item: PartMass) -> Estimate:
    name = f"{item.part}_kg"
    return Estimate("object_mass", name, item.assumed_kg, item.line, MASS_FORM, "kg", item.reason)


def _summary(estimates: list[Estimate], mass: Array) -> ObjectDiagnosis:
    causes, evidence, detectable = [], [], {}
    for cause in dict.fromkeys(item.cause for item in estimates):
        own = [item for item in estimates if item.cause == cause]
        found = [item for item in own if item.found and item.line]
        evidence.append(_merged([item.evidence for item in own]))
        sizes = [max(_SURE * item.line.error, 2 * item.slack) for item in own if item.line is not None]
        if sizes:
            detectable[cause] = max(sizes)
        if found:
            lines = [item.line for item in found if item.line]
            params = {item.name: item.parameter for item in found}
            p_value, gain = min(line.p_value for line in lines), max(line.gain for line in lines)
            causes.append(Cause(cause, "cause", params, p_value, gain))
    return ObjectDiagnosis(tuple(causes), tuple(evidence), detectable, _next(evidence), mass)


def _merged(items: list[Evidence]) -> Evidence:
    """One line per cause: the strongest of its parts', with every part's sentence."""
    order = ("accepted", "rejected", "not identifiable")
    best = min(items, key=lambda item: (order.index(item.decision), item.p_value or 0.0))
    reason = "; ".join(dict.fromkeys(item.reason for item in items))
    return Evidence(best.name, best.p_value, best.p_adjusted, best.cv_gain, best.decision, reason)


def _next(evidence: list[Evidence]) -> dict[str, Any] | None:
    """What to record so that everything about the parts can be told."""
    missing = [item for item in evidence if item.decision == "not identifiable"]
    if not missing:
        return None
    protocol = {"episodes": 8, "pick_up_from_table": True, "drag_m": 0.03, "press_n": 5.0, "wiggle_m": 0.01}
    text = " ".join(f"{item.name}: {item.reason}." for item in missing)
    return {"decides": [item.name for item in missing], "text": text, "protocol": protocol}
