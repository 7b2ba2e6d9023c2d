"""A face that lies otherwise in every recording: first touches follow the recordings' own leans.

First touches of a sound rig scatter, and so may its indenter's lean and place; but these know nothing of each
other. Where the pad was mounted anew, or gives way to one side, it is the face that leans, and an indenter
meets it the sooner or the later, the farther from the pad's middle it presses. No lean need be larger than a
sound rig's for that.
"""

import numpy as np

from lerobot_vtrefine.diagnose.core.rules import LEAST_UNKNOWN
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.noise import DEFAULT_OFFSET_M
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.recording_scatter import LEAN_RAD, TOUCH, Deviations


def leaning_face(own: Deviations, presses: PressSet) -> Suspicion | None:
    """Whether touches follow what leans make of places; which lean comes with which touch is permuted.

    None where no depth is known.
    """
    if presses.loaded:
        return None
    touches, leans = own.sizes[:, TOUCH], own.sizes[:, TOUCH + 1 :]
    levers = np.array([_from_middle_m(press) for press in presses.presses]) * LEAN_RAD / DEFAULT_OFFSET_M
    expected = (leans * levers).sum(axis=1)
    power = float(touches @ touches)
    part = (power - float(((touches - expected) ** 2).sum())) / max(power, 1e-12)
    along = (expected - expected.mean()) / max(float(expected.std()), 1e-12)
    clue = "first touches of recordings follow their leans, as if the face lay otherwise in each"
    return Suspicion(0, clue, part * float(own.shares[TOUCH]), LEAST_UNKNOWN, touches, along=along)


def _from_middle_m(press: Press) -> tuple[float, float]:
    """Where the pad is pressed, from its middle [m]."""
    pressed = press.touching if press.touching.any() else slice(None)
    return float(press.trial.x_m[pressed].mean()), float(press.trial.y_m[pressed].mean())
