"""The parts' masses, by how much further the servos deflect under them than in the twin.

The twin's arms are replayed twice with weights in the hands while these carry parts: as assumed, and heavier.
What the recorded joints do beyond the first replay is explained by a multiple of the difference of both, one
number per hand for all its joints, beside what the robot itself may add: an offset and a friction against
the direction of motion for every joint. Only if the mass reduces the error on episodes
left out of the fit, tested over all of them together, are the parts called heavier or lighter.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.parts.episodes import AssumedScene, HandledEpisode
from lerobot_vtrefine.diagnose.parts.payload import replay_loaded
from lerobot_vtrefine.diagnose.parts.problem import Measured, Quantity
from lerobot_vtrefine.diagnose.parts.regression import Blocks, Line, slope_of
from lerobot_vtrefine.diagnose.parts.rules import (
    AGAIN,
    DISAGREE,
    MASS_ERROR,
    MIN_EPISODES,
    MIN_JOINTS,
    TELLING_KG,
)
from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.embodiments.embodiment import PARTS

Array = np.ndarray

_HEAVIER_KG = 0.05
_LIGHTEST_KG = 0.005
_MOVES_RAD_S = 0.02


def masses(
    scene: AssumedScene, episodes: Sequence[HandledEpisode], assumed_kg: Array, seed: int
) -> tuple[Quantity, ...]:
    """Of socket and plug, from episodes in which they are picked up; `assumed_kg` is (2,)."""
    lines = _lines(scene, episodes, assumed_kg)
    out = []
    for part, known, item in zip(PARTS, assumed_kg, lines, strict=True):
        name = f"{part}_kg"
        if isinstance(item, str):
            out.append(Quantity("object_mass", name, float(known), "kg", MASS_ERROR, None, item))
            continue
        reason = _disagreement(scene.body, item, slope_of(Blocks.of(item), seed), seed)
        out.append(Quantity("object_mass", name, float(known), "kg", MASS_ERROR, Blocks.of(item), reason))
    return tuple(out)


def remeasured(
    scene: AssumedScene,
    episodes: Sequence[HandledEpisode],
    found: Sequence[Measured],
    seed: int,
) -> tuple[Measured, ...]:
    """Masses that are far off, taken anew where they were found: with friction in the joints the weight's
    effect is not linear. What was found stays found."""
    assumed = np.array([item.quantity.assumed for item in found])
    change = np.array([item.line.value if item.line and not item.quantity.reason else 0.0 for item in found])
    near = np.maximum(assumed + change, _LIGHTEST_KG) - assumed
    if not (np.abs(near) > AGAIN * assumed).any():
        return tuple(found)
    out = []
    again_lines = _lines(scene, episodes, assumed + near)
    for item, lines, step in zip(found, again_lines, near.tolist(), strict=True):
        if item.line is None or isinstance(lines, str):
            out.append(item)
            continue
        again = slope_of(Blocks.of(lines), seed)
        low, high = again.ci95
        moved = Line(again.value + step, (low + step, high + step), again.error)
        out.append(replace(item, line=moved))
    return tuple(out)


def _lines(
    scene: AssumedScene, episodes: Sequence[HandledEpisode], assumed_kg: Array
) -> list[list[tuple[Array, Array, Array]] | str]:
    """Of either part: blocks for `Blocks.of`, or why there are none."""
    masses_kg = assumed_kg, assumed_kg + _HEAVIER_KG
    replays = [replay_loaded(scene, episodes, scene.weights_n(episodes, mass)) for mass in masses_kg]
    out: list[list[tuple[Array, Array, Array]] | str] = []
    for part in PARTS:
        hand = scene.hand_of(part)
        if hand is None:
            out.append(f"{scene.unheld(part)}: its mass is not measured")
            continue
        seen = [bool(e.free[:, hand].any() and e.carried[:, hand].any()) for e in episodes]
        if sum(seen) < MIN_EPISODES:
            out.append(
                f"the {part} is never picked up: for a hand that always holds it, its weight cannot be "
                "distinguished from encoder offsets; record picking it up from the table"
            )
        else:
            paths = zip(episodes, *replays, strict=True)
            out.append([_block(scene.body, e, *item, hand) for e, *item in paths])
    return out


def _disagreement(body: Embodiment, blocks: list[tuple[Array, Array, Array]], line: Line, seed: int) -> str:
    """Why it is not the mass, although it helps: a mass loads every pitching joint, a fault only its own."""
    agree, differ = 0, []
    for channel, joint in enumerate(body.joints):
        own = [(item[0][:, [channel]], item[1][:, [channel]], item[2][:, [channel]]) for item in blocks]
        if not any(effect.any() for _, effect, _ in own):
            continue
        alone = slope_of(Blocks.of(own), seed)
        if alone.error > TELLING_KG:
            continue
        chance = 3 * np.hypot(alone.error, line.error)
        near = abs(alone.value - line.value) < max(DISAGREE * abs(line.value), chance)
        agree += near and alone.value * line.value > 0
        differ += [] if near else [joint.name]
    if agree >= MIN_JOINTS and len(differ) < agree:
        return ""
    those = ", ".join(differ) or "too few are sensitive to it"
    return f"joints contradict each other about it ({those}): it is the robot"


def _block(
    body: Embodiment, episode: HandledEpisode, light: Array, heavy: Array, hand: int
) -> tuple[Array, Array, Array]:
    """Per revolute joint of the arm: error (N, K), the mass's effect (N, K) per kg, nuisances (N, K, 2)."""
    first = body.joints_per_arm * hand
    joints = slice(first, first + len(body.joints))
    use = episode.free[:, hand] | episode.carried[:, hand]
    error = (episode.position - light)[use, joints]
    effect = ((heavy - light) / _HEAVIER_KG)[use, joints]
    step_s = float(np.median(np.diff(episode.time_s)))
    direction = np.tanh(np.gradient(light, step_s, axis=0)[use, joints] / _MOVES_RAD_S)
    return error, effect, np.stack([np.ones_like(error), direction], -1)
