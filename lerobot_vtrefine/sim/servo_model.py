"""What joint targets to command so that the servos reach the wanted positions in time.

A position servo with stiffness k and damping d lags behind its command, and dry friction holds it back:
tau dq/dt = command - load - friction sign(dq/dt) - q with tau = d / k; load and friction as offsets [rad].
The load is learnt from how the joint moved in the last control step.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.simulation import InsertionSim

Array = NDArray[np.float64]

LEARNING_RATE = 0.3
LOAD_LIMIT_RAD = 0.08
FEEDBACK = (
    0.4  # share of a remaining error that is to be made up for in `FEEDBACK_S`, whatever the control rate
)
FEEDBACK_S = 0.1
CREEP_RAD_S = 0.004  # below this speed a joint may as well stick: friction tells nothing about its direction


class ServoModel:
    """First-order model of every joint's servo, one load per environment (m) and joint (J)."""

    def __init__(self, sim: "InsertionSim") -> None:
        robot, scale = sim.scene.embodiment, sim.scene.config.servo_gain_scale
        # Grippers are only opened and closed: no model of theirs is needed.
        lag_s = [joint.damping / joint.stiffness / np.sqrt(scale) for joint in robot.joints]
        friction = [joint.friction_loss / joint.stiffness / scale for joint in robot.joints]
        grippers = [0.0] * len(robot.fingers.joint_names)
        self._period_s = sim.config.control_dt_s
        self._feedback = 1.0 - (1.0 - FEEDBACK) ** (self._period_s / FEEDBACK_S)
        self._lag_s = np.maximum([*lag_s, *grippers] * robot.num_arms, 1e-3)
        self._friction = np.array([*friction, *grippers] * robot.num_arms)
        self._decay = np.exp(-self._period_s / self._lag_s)
        shape = (sim.num_envs, robot.num_joints)
        self._q, self._before, self._command = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._load = np.zeros(shape)

    def reset(self, ids: NDArray[np.int64], q: Array, command: Array) -> None:
        """Begin at rest: what is lacking now, and friction cannot explain, is load."""
        self._q[ids], self._before[ids], self._command[ids] = q, command, command
        lacking = command - q
        load = lacking - lacking.clip(-self._friction, self._friction)
        self._load[ids] = load.clip(-LOAD_LIMIT_RAD, LOAD_LIMIT_RAD)

    def learn(self, ids: NDArray[np.int64], q: Array, trusted: NDArray[np.bool_]) -> None:
        """Compare where joints went with where the model says they should, in trusted environments."""
        before, command, decay = self._before[ids], self._command[ids], self._decay
        # Response to a command that moves linearly from `before` to `command` within the period.
        free = decay * self._q[ids] + command - decay * before
        free -= (command - before) * self._lag_s / self._period_s * (1 - decay)
        lacking = (free - q) / (1 - decay)
        speed = (q - self._q[ids]) / self._period_s
        moving = np.abs(speed) > CREEP_RAD_S
        surprise = lacking - self._load[ids]
        stuck = surprise - surprise.clip(-self._friction, self._friction)
        surprise = np.where(moving, surprise - self._friction * np.sign(speed), stuck)
        load = self._load[ids] + LEARNING_RATE * trusted[:, None] * surprise
        self._load[ids] = load.clip(-LOAD_LIMIT_RAD, LOAD_LIMIT_RAD)
        self._q[ids] = q

    def command(self, ids: NDArray[np.int64], start: Array, goal: Array) -> Array:
        """Command (m, J) under which joints, wanted at `start` now, move to `goal` within the next period."""
        speed = (goal - start + self._feedback * (start - self._q[ids])) / self._period_s
        push = self._friction * np.tanh(speed / CREEP_RAD_S)
        command = goal + self._lag_s * speed + push + self._load[ids]
        self._before[ids], self._command[ids] = self._command[ids], command
        return command
