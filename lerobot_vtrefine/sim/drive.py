"""From the controller's commands to the servos': directly, or with a robot's faults in between.

Shapes: N worlds of which m are addressed by ids, nu servos, J joints.
"""

from collections.abc import Mapping
from typing import Any, override

import numpy as np

from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.sim import task
from lerobot_vtrefine.sim.backends import Backend, Trace
from lerobot_vtrefine.sim.config import TaskConfig
from lerobot_vtrefine.sim.reality import RobotFaults

Array = np.ndarray


class Drive:
    """Commands reach the servos as they are."""

    def __init__(self, backend: Backend, substeps: int) -> None:
        self._backend, self._substeps = backend, substeps

    def reset(self, ids: Array, command: Array) -> Array:
        """Start episodes with the servos at rest at `command` (m, nu); returns what the controller sees."""
        return command

    def advance(self, ids: Array, before: Array, after: Array) -> Trace:
        """One control step, in which the controller's command moves linearly (m, nu)."""
        return self._backend.advance_linearly(ids, before, after, self._substeps)

    def readings(self, joints: Array) -> Array:
        """What encoders say about joint positions (m, J)."""
        return joints

    def get_state(self, env: int) -> Any:
        """What world `env` remembers."""
        return None

    def set_state(self, env: int | Array, state: Any) -> None:
        """Continue from a state taken by `get_state`; of several worlds (m,), values are (m, ...)."""


class FaultyDrive(Drive):
    """Commands arrive late, through play, and in coordinates that the encoders shift.

    Raises:
        ValueError: a joint's name that no arm has.
    """

    def __init__(
        self,
        backend: Backend,
        robot: Embodiment,
        substeps: int,
        control_dt_s: float,
        faults: RobotFaults,
    ) -> None:
        super().__init__(backend, substeps)
        self._half_play = 0.5 * servo_values(robot, faults.backlash_rad)
        self._offset = servo_values(robot, faults.encoder_offset_rad)
        self._joint_offset = task.joint_targets(robot, self._offset[None])[0]
        delay = round(faults.control_latency_s / control_dt_s * substeps)
        self._whole, self._rest = divmod(delay, substeps)
        # Newest first: where the controller's commands, as the servos see them, end in each control step.
        self._history = np.zeros((backend.num_envs, self._whole + 3, len(self._offset)))
        self._servo = np.zeros((backend.num_envs, len(self._offset)))

    @override
    def reset(self, ids: Array, command: Array) -> Array:
        self._history[ids] = command[:, None]
        self._servo[ids] = command
        return command + self._offset

    @override
    def advance(self, ids: Array, before: Array, after: Array) -> Trace:
        history = np.concatenate([(after - self._offset)[:, None], self._history[ids, :-1]], axis=1)
        self._history[ids] = history
        controls = self._late(history)
        servo = self._servo[ids]
        for step in range(self._substeps):
            target = controls[:, step]
            servo = controls[:, step] = servo.clip(target - self._half_play, target + self._half_play)
        self._servo[ids] = servo
        return self._backend.advance(ids, controls)

    def _late(self, history: Array) -> Array:
        """What reaches the servos in the substeps of one control step (m, K, nu): a late command turns within
        the step.
        """
        new, turn, old = (history[:, self._whole + back, None] for back in range(3))
        past = ((np.arange(self._substeps) + 1.0 - self._rest) / self._substeps)[:, None]
        return turn + past * np.where(past > 0, new - turn, turn - old)

    @override
    def readings(self, joints: Array) -> Array:
        return joints + self._joint_offset

    @override
    def get_state(self, env: int) -> Any:
        return self._history[env].copy(), self._servo[env].copy()

    @override
    def set_state(self, env: int | Array, state: Any) -> None:
        self._history[env], self._servo[env] = state


def make_drive(
    backend: Backend, robot: Embodiment, substeps: int, config: TaskConfig, faults: RobotFaults | None
) -> Drive:
    """The drive with these faults; a plain one without any."""
    if faults is None or faults == RobotFaults():
        return Drive(backend, substeps)
    return FaultyDrive(backend, robot, substeps, config.control_dt_s, faults)


def servo_values(robot: Embodiment, values: Mapping[str, float]) -> Array:
    """Values by joint name as an array over servos (nu,), zero where none is given; arms' joints only."""
    valid = [robot.joint_names[column] for column in robot.arm_columns]
    for name in values:
        if name not in valid:
            raise ValueError(f"reality: no arm has a joint {name!r}; valid: {', '.join(valid)}")
    by_joint = np.array([float(values.get(name, 0.0)) for name in robot.joint_names])
    return task.servo_values(robot, by_joint[None])[0]
