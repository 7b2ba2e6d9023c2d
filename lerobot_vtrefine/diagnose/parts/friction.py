"""Friction of the plug, from the pull against sliding while it is pressed down on the table.

The arm's deflection measures both forces. Only slides across the pads count: there, the joints of ALOHA that
measure them have almost no dry friction of their own.
"""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.parts.clearance import Contact
from lerobot_vtrefine.diagnose.parts.episodes import AssumedScene, HandledEpisode
from lerobot_vtrefine.diagnose.parts.problem import Quantity
from lerobot_vtrefine.diagnose.parts.regression import Blocks
from lerobot_vtrefine.diagnose.parts.rules import (
    FLAT_M,
    FRICTION_ERROR,
    MIN_EPISODES,
    MIN_SLIDING,
    PRESS_N,
    SLIDES_M_S,
)


def friction(
    scene: AssumedScene, episodes: Sequence[HandledEpisode], contacts: Sequence[Contact]
) -> Quantity:
    """The plug's coefficient."""
    known = scene.scene.part_friction
    hand = scene.hand_of("plug")
    if hand is None:
        return Quantity("object_friction", "friction", known, "1", FRICTION_ERROR, None, scene.unheld("plug"))
    blocks, reason = _blocks(known, hand, scene.scene.table_height_m, episodes, contacts)
    return Quantity("object_friction", "friction", known, "1", FRICTION_ERROR, blocks, reason)


def _blocks(
    assumed: float,
    hand: int,
    table_m: float,
    episodes: Sequence[HandledEpisode],
    contacts: Sequence[Contact],
) -> tuple[Blocks | None, str]:
    """None with the reason where nothing slides under load."""
    blocks = []
    for episode, contact in zip(episodes, contacts, strict=True):
        step_s = float(np.median(np.diff(episode.time_s)))
        place, force = contact.place_m[:, hand], contact.force_n[:, hand]
        speed = np.gradient(place, step_s, axis=0)
        use = episode.held[:, hand] & ~episode.together & (np.abs(place[:, 2] - table_m) < FLAT_M)
        use &= (force[:, 2] > PRESS_N) & (np.abs(speed[:, 0]) > SLIDES_M_S)
        use &= np.abs(speed[:, 0]) > 2 * np.hypot(speed[:, 1], speed[:, 2])
        if use.sum() < MIN_SLIDING:
            continue
        normal, pull = force[use, 2], -force[use, 0] * np.sign(speed[use, 0])
        error = pull - assumed * normal
        blocks.append((error[:, None], normal[:, None], np.zeros((len(normal), 1, 0))))
    if len(blocks) < MIN_EPISODES:
        return None, (
            "no held part slides under load in three episodes; press the plug on the table with 5 N or more "
            "and drag it 30 mm to either side across the pads, twice, slowly"
        )
    return Blocks.of(blocks), ""
