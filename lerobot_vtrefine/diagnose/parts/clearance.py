"""The hole's clearance, from how far the plug goes sideways in it before the walls push back.

Fingers centre their parts across the pads, so both hands' encoders measure the plug's place in the hole along
that axis, and the arms' deflection shows when a wall pushes. In frames with a push, place = zero -+ half the
clearance - give x force, the sign being the force's. The zero is fitted, too: walls on both sides are needed.
So is the give, with a prior: arms with soft servos push too evenly to show it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.parts.episodes import AssumedScene, HandledEpisode, hands
from lerobot_vtrefine.diagnose.parts.forces import places, point_forces
from lerobot_vtrefine.diagnose.parts.problem import Quantity
from lerobot_vtrefine.diagnose.parts.regression import Blocks
from lerobot_vtrefine.diagnose.parts.rules import (
    CLEARANCE_ERROR,
    INSERTED_M,
    MIN_EPISODES,
    MIN_ON_A_WALL,
    PUSH_N,
    RESTS_M_S,
)
from lerobot_vtrefine.sim.starts import HAND_RETREAT_M

Array = np.ndarray

_ROUND = (
    "pads close along one axis only, and along that axis a round hole is as wide as assumed only where the "
    "plug is in its middle: use a pair with flat walls"
)
GIVE_M_PER_N = 8e-5
"""How far preloaded pads let the parts give way: on the twins 7.5e-5 (ALOHA) and 8.6e-5 (Kinova) ..."""
GIVE_WEIGHT_N = 3.0
"""... and how much an episode counts that: places err by 3e-5 m, so that it is known to 1e-5 m/N."""


@dataclass(frozen=True)
class Contact:
    """Forces on the hands and where the parts are in one episode."""

    force_n: Array
    """(T, A, 3) on the mouth and on the tip, world axes."""
    place_m: Array
    """(T, A, 3) of mouth and tip, if the hands hold their parts ideally."""


def contacts_of(
    scene: AssumedScene, episodes: Sequence[HandledEpisode], untouched: Sequence[Array]
) -> list[Contact]:
    """Of every episode; `untouched` are the twin's positions (T, J) with the parts' weights."""
    out = []
    for episode, path in zip(episodes, untouched, strict=True):
        held = np.flatnonzero(episode.held.all(1))
        turns = hands(scene.body, episode.position[held[:1]] if len(held) else episode.position[:1])[1]
        points = _tip_and_mouth(scene, turns[0])
        force = point_forces(scene, episode, path, points)
        out.append(Contact(force, places(scene.body, episode.position, points)))
    return out


def _tip_and_mouth(scene: AssumedScene, rotation: Array) -> Array:
    """(A, 3) [m]: the mouth, or the tip, in the TCP's frame of the hand that holds the socket, or the plug.

    Fingers centre a part between them: across the pads (the hand's y) the part is where this says, whatever
    its slip along the fingers.

    Args:
        rotation: (A, 3, 3) of the hands while their parts stand upright.
    """
    out = np.zeros((len(scene.parts), 3))
    pitch_rad = np.arcsin(np.clip(-rotation[..., 2, 0], -1.0, 1.0))
    for hand, part in enumerate(scene.parts):
        # In a frame at the TCP whose z is up: ahead to the part's axis, down (or up) to its origin.
        ahead, up = HAND_RETREAT_M, -part.grip.centre_m[2]
        cos, sin = np.cos(pitch_rad[hand]), np.sin(pitch_rad[hand])
        # Pitch about y tips the hand's x down.
        out[hand] = [cos * ahead - sin * up, 0.0, sin * ahead + cos * up]
    return out


def clearance(
    scene: AssumedScene, episodes: Sequence[HandledEpisode], contacts: Sequence[Contact]
) -> Quantity:
    """The hole's, across the pads."""
    known = scene.scene.hole_clearance_m
    blocks, reason = None, scene.unheld("socket") or scene.unheld("plug")
    if not reason:
        blocks, reason = _blocks(known, episodes, contacts)
    round_hole = blocks is not None and scene.pair.name == "round"
    if round_hole and blocks.solve(np.ones(len(blocks.rows)), slope=True)[-1] < 0:
        reason = _ROUND
    return Quantity("clearance", "clearance", known, "m", CLEARANCE_ERROR, blocks, reason)


def _blocks(
    assumed: float, episodes: Sequence[HandledEpisode], contacts: Sequence[Contact]
) -> tuple[Blocks | None, str]:
    """None with the reason where there is no contact with the walls."""
    blocks, walls = [], np.zeros(2, dtype=int)
    for episode, contact in zip(episodes, contacts, strict=True):
        offset = contact.place_m[:, 1] - contact.place_m[:, 0]
        push = (contact.force_n[:, 1, 0] - contact.force_n[:, 0, 0]) / 2
        speed = np.gradient(offset[:, 0], float(np.median(np.diff(episode.time_s))))
        use = episode.together & (offset[:, 2] < -INSERTED_M) & (np.abs(push) > PUSH_N)
        use &= np.abs(speed) < RESTS_M_S
        if not use.any():
            continue
        side, force, place = np.sign(push[use]), push[use], offset[use, 0]
        walls += [int((side > 0).sum()), int((side < 0).sum())]
        # A wall pushes the plug back: the force on it points away from the wall.
        error = np.append(place + side * assumed / 2, -GIVE_WEIGHT_N * GIVE_M_PER_N)
        effect = np.append(-side / 2, 0.0)
        zero, give = np.append(np.ones_like(side), 0.0), np.append(force, GIVE_WEIGHT_N)
        blocks.append((error[:, None], effect[:, None], np.stack([zero, give], -1)[:, None]))
    if len(blocks) < MIN_EPISODES or walls.min() < MIN_ON_A_WALL:
        return None, (
            "the inserted plug is not pushed against both walls across the pads in three episodes; insert it "
            "and move the hand 10 mm to either side across the pads, twice, slowly"
        )
    return Blocks.of(blocks), ""
