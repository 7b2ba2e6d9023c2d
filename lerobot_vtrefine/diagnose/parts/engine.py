"""The diagnosis of parts: episodes of the twin's robot in, object_mass, object_friction and clearance out.

Each is named only where episodes show it: the estimate reduces the error on episodes left out of the fit,
tested over all of them together, and differs from what the simulation assumes by more than the method's own
error. Where the recordings do not determine a number, the evidence says what to record.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.evidence import Evidence, not_tested
from lerobot_vtrefine.diagnose.parts import friction as sliding
from lerobot_vtrefine.diagnose.parts.clearance import clearance, contacts_of
from lerobot_vtrefine.diagnose.parts.episodes import AssumedScene, HandledEpisode
from lerobot_vtrefine.diagnose.parts.mass import masses, remeasured
from lerobot_vtrefine.diagnose.parts.payload import replay_loaded
from lerobot_vtrefine.diagnose.parts.problem import Measured, Quantity, measure
from lerobot_vtrefine.diagnose.parts.rules import FRICTION_ERROR
from lerobot_vtrefine.diagnose.verdict import Cause, Verdict
from lerobot_vtrefine.sim.scene import build_scene

Array = np.ndarray

NAMES = ("object_mass", "object_friction", "clearance")
UNKNOWN_PARTS = (
    "the parts are not known: datasets of vtrefine-record-demos and of the simulated robot note the assumed "
    "scene, others have no part that the twin could carry"
)
PAD_FRICTION = (
    "friction between pads and part: not identifiable, because pads measure how hard they are pressed but "
    "not when the part slips, and no joint's load measures the pull; close the hand on a part clamped to "
    "the table, pull until it slips at two closing forces, five times each, and record the joints' load"
)


def unknown_parts() -> Diagnosis:
    """Of a dataset whose parts the twin does not know."""
    evidence = tuple(Evidence(name, None, None, None, "not identifiable", UNKNOWN_PARTS) for name in NAMES)
    return Diagnosis(Verdict("adequate", not_tested=not_tested(evidence)), evidence=evidence)


def assumed_masses(scene: AssumedScene) -> Array:
    """(2,) of socket and plug [kg]."""
    built = build_scene(scene.scene)
    return np.array([built.model.body_mass[built.socket_body], built.model.body_mass[built.plug_body]])


def weigh(scene: AssumedScene, episodes: Sequence[HandledEpisode], seed: int = 0) -> tuple[Measured, ...]:
    """The masses of socket and plug, as far as episodes determine them."""
    found = measure(masses(scene, episodes, assumed_masses(scene), seed), seed)
    return remeasured(scene, episodes, found, seed)


def masses_kg(found: Sequence[Measured]) -> Array:
    """(2,) of socket and plug as episodes show them, or as assumed where they do not."""
    return np.array([item.believed for item in found])


def diagnose_parts(
    scene: AssumedScene, episodes: Sequence[HandledEpisode], weighed: Sequence[Measured], seed: int = 0
) -> Diagnosis:
    """Judge the parts of episodes whose encoders are trusted (the robot's own errors having been removed).

    Args:
        weighed: the masses as `weigh` finds them in these episodes.
    """
    found = list(weighed)
    untouched = replay_loaded(scene, episodes, scene.weights_n(episodes, masses_kg(found)), contacts=False)
    contacts = contacts_of(scene, episodes, untouched)
    found += measure([sliding.friction(scene, episodes, contacts)], seed)
    known = scene.scene.pad_friction
    pads = Quantity("object_friction", "pad_friction", known, "1", FRICTION_ERROR, None, PAD_FRICTION)
    found.append(Measured(pads))
    found += measure([clearance(scene, episodes, contacts)], seed)
    return _summary(found)


def _summary(measured: Sequence[Measured]) -> Diagnosis:
    causes, evidence, detectable = [], [], {}
    for name in NAMES:
        own = [item for item in measured if item.quantity.cause == name]
        evidence.append(_strongest([item.evidence for item in own]))
        if sizes := [item.detectable for item in own if item.detectable is not None]:
            detectable[name] = max(sizes)
        if found := [item for item in own if item.found]:
            params = {item.quantity.name: item.parameter for item in found}
            p_value = min(item.p_adjusted for item in found if item.p_adjusted is not None)
            # No episode is locked away, so that there is no gain on locked ones.
            causes.append(Cause(name, "cause", params, p_value, None))
    verdict = Verdict(
        "explained" if causes else "adequate",
        tuple(causes),
        minimum_detectable=detectable,
        next_experiment=_next(evidence),
        not_tested=not_tested(evidence),
    )
    return Diagnosis(verdict, evidence=tuple(evidence))


def _strongest(items: list[Evidence]) -> Evidence:
    """One line per cause: its strongest evidence, with the sentences of all."""
    order = ("accepted", "rejected", "not identifiable")
    best = min(items, key=lambda item: (order.index(item.decision), item.p_value or 0.0))
    reason = "; ".join(dict.fromkeys(item.reason for item in items))
    return replace(best, reason=reason)


def _next(evidence: list[Evidence]) -> dict[str, Any] | None:
    """What to record so that everything about the parts can be identified."""
    missing = [item for item in evidence if item.decision == "not identifiable"]
    if not missing:
        return None
    protocol = {"episodes": 8, "pick_up_from_table": True, "drag_m": 0.03, "press_n": 5.0, "wiggle_m": 0.01}
    text = " ".join(f"{item.name}: {item.reason}." for item in missing)
    return {"decides": [item.name for item in missing], "text": text, "protocol": protocol}
