"""How often commands were cut to what a robot may do: told once, at the end of a session.

LeRobot records what was asked for, not what was sent: where the two differ often, a policy learns motions
that nobody saw.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.wording import plural

TELLING_RAD = 1e-3
"""Smaller differences are those of number formats."""


class CutCommands:
    """Counts the commands of one session.

    Args:
        bounds: what cuts them, for the message.

    Grippers are left out: to grip, one commands them past where they can go.
    """

    def __init__(self, body: Embodiment, bounds: str) -> None:
        self._columns, self._bounds = body.arm_columns, bounds
        self._names: Sequence[str] = [body.joint_names[column] for column in self._columns]
        self._restart()

    def _restart(self) -> None:
        self._commands = self._cut = 0
        self._times = np.zeros(len(self._names), int)
        self._most_rad = np.zeros(len(self._names))

    def count(self, wanted: ArrayLike, sent: ArrayLike) -> None:
        """Note joint targets (J,) that were asked for, and those that were sent."""
        away_rad = np.abs(np.asarray(wanted, float) - np.asarray(sent, float))[self._columns]
        cut = away_rad > TELLING_RAD
        self._commands += 1
        self._cut += bool(cut.any())
        self._times += cut
        self._most_rad = np.maximum(self._most_rad, away_rad)

    def describe(self) -> str:
        """What was cut since the last call, in one line; empty where nothing was."""
        worst = int(np.argmax(self._times))
        told = (
            f"{self._cut} of {plural(self._commands, 'command')} asked for more than {self._bounds} allow and"
            f" were cut; {self._names[worst]} most often, {plural(int(self._times[worst]), 'time')}, by up to"
            f" {self._most_rad[worst]:.2f} rad. A recording holds what was asked for"
        )
        told = told if self._cut else ""
        self._restart()
        return told
