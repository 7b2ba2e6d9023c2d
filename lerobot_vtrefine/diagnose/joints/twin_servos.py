"""Servo gains, damping and dry friction of the MuJoCo twin, fitted by replaying recorded commands through it.

The arms' joints hardly push one another at teleoperation's speeds, so all joints are changed at once: one
replay per kind of parameter gives every joint's derivative. Grippers are left as they are, since what they
hold is not replayed. Shapes: E episodes, J joints, R revolute ones, 3 kinds of parameter.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.joints.gravity import is_sliding
from lerobot_vtrefine.diagnose.recordings import RecordingSet, RobotTrial
from lerobot_vtrefine.sim.command_replay import replay_commands
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.scene import build_arms

Array = np.ndarray

KINDS = ("stiffness", "damping", "friction")
_STEP = np.array([0.05, 0.05, 0.1])
"""Finite differences: logarithms of the gains, friction in Nm."""
_FACTOR = np.log(5.0)
_FRICTION_NM = 10.0
_ITERATIONS = 6
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class TwinFit:
    """What the twin's servos are like after the fit, and how well it follows before and after."""

    joints: tuple[str, ...]
    """R revolute joints."""
    stiffness: Array
    """(R,) [Nm/rad]"""
    damping: Array
    """(R,) [Nms/rad]"""
    friction: Array
    """(R,) [Nm]"""
    rmse_before: Array
    """(R,) twin as it comes, against the recorded positions [rad]."""
    rmse_after: Array
    """(R,)"""


class _Replay:
    """Replays trials under parameters per joint."""

    def __init__(self, trials: Sequence[RobotTrial], names: tuple[str, ...], config: SceneConfig) -> None:
        self.trials, self.config = trials, config
        self.model, embodiment, _ = build_arms(config)
        if names != embodiment.joint_names:
            raise ValueError(f"the twin has the joints {', '.join(embodiment.joint_names)}; got other names")
        self.columns = [index for index, name in enumerate(names) if not is_sliding(name)]
        self.joints = tuple(names[index] for index in self.columns)
        self.dof = [int(self.model.joint(name).dofadr[0]) for name in self.joints]
        self.servo = [int(self.model.actuator(name).id) for name in self.joints]
        self.dt_s = float(np.median(np.concatenate([np.diff(trial.time_s) for trial in trials])))
        self.nominal = np.stack(
            [
                self.model.actuator_gainprm[self.servo, 0],
                np.reshape(self.model.dof_damping, (self.model.nv, -1))[self.dof, 0],
                self.model.dof_frictionloss[self.dof],
            ],
            1,
        )

    def physical(self, theta: Array) -> Array:
        """(R, 3) gains, dampings and frictions of parameters (R, 3)."""
        return np.concatenate([self.nominal[:, :2] * np.exp(theta[:, :2]), theta[:, 2:]], 1)

    def errors(self, many: Sequence[Array]) -> list[list[Array]]:
        """Twin minus recorded, per parameter set and trial: (N, R)."""
        count = len(self.trials)
        fields = self._fields(many)
        commands = [trial.command for trial in self.trials] * len(many)
        starts = np.stack([trial.position[0] for trial in self.trials] * len(many))
        paths = replay_commands(commands, starts, self.dt_s, self.config, fields=fields)
        left = [
            (path - trial.position)[:, self.columns]
            for path, trial in zip(paths, list(self.trials) * len(many), strict=True)
        ]
        return [left[place * count : (place + 1) * count] for place in range(len(many))]

    def _fields(self, many: Sequence[Array]) -> dict[str, Array]:
        names = ("actuator_gainprm", "actuator_biasprm", "dof_damping", "dof_frictionloss")
        own = {name: np.array(getattr(self.model, name), dtype=float) for name in names}
        out: dict[str, list[Array]] = {name: [] for name in names}
        for theta in many:
            stiffness, damping, friction = self.physical(theta).T
            values = {name: value.copy() for name, value in own.items()}
            values["actuator_gainprm"][self.servo, 0] = stiffness
            values["actuator_biasprm"][self.servo, 1] = -stiffness
            damped = values["dof_damping"].reshape(self.model.nv, -1)
            damped[self.dof, 0] = damping
            values["dof_frictionloss"][self.dof] = friction
            for name, value in values.items():
                out[name] += [value] * len(self.trials)
        return {name: np.stack(values) for name, values in out.items()}


def fit_twin(
    recordings: RecordingSet, episodes: Sequence[int] | None = None, config: SceneConfig | None = None
) -> TwinFit:
    """Fit the twin's servos to recorded commands and positions of ALOHA.

    Args:
        recordings: kind "robot", with the twin's 16 joints.
        episodes: trials to use, all by default; half a dozen are enough for the 36 parameters.
        config: gravity compensation, time step.

    Raises:
        ValueError: other joints than the twin's.
    """
    chosen = recordings.trials if episodes is None else [recordings.trials[index] for index in episodes]
    replay = _Replay(chosen, recordings.joints, config or SceneConfig())
    theta = np.zeros((len(replay.joints), len(KINDS)))
    theta[:, 2] = replay.nominal[:, 2]
    damping = np.full(len(theta), 1e-2)
    before = None
    for _ in range(_ITERATIONS):
        shifted = [theta + _STEP * (np.arange(len(KINDS)) == kind) for kind in range(len(KINDS))]
        here, *moved = (np.concatenate(item) for item in replay.errors([theta, *shifted]))
        before = _rms(here) if before is None else before
        jacobian = np.stack([(other - here) / step for other, step in zip(moved, _STEP, strict=True)], -1)
        proposed = _bounded(theta + _steps(jacobian, here, damping))
        then = np.concatenate(replay.errors([proposed])[0])
        better = _rms(then) < _rms(here)
        theta = np.where(better[:, None], proposed, theta)
        damping = np.where(better, damping * 0.2, damping * 10)
        gain = np.where(better, 1 - _rms(then) / _rms(here).clip(1e-300), 0.0)
        if (gain < _TOLERANCE).all() and better.any():
            break
    after = _rms(np.concatenate(replay.errors([theta])[0]))
    stiffness, viscous, dry = replay.physical(theta).T
    return TwinFit(replay.joints, stiffness, viscous, dry, np.asarray(before), after)


def _rms(errors: Array) -> Array:
    return np.sqrt(np.square(errors).mean(0))


def _steps(jacobian: Array, error: Array, damping: Array) -> Array:
    """(R, 3) damped Gauss-Newton steps, every joint for itself."""
    normal = np.einsum("nrp,nrq->rpq", jacobian, jacobian)
    slope = np.einsum("nrp,nr->rp", jacobian, error)
    scale = np.sqrt(np.einsum("rpp->rp", normal)).clip(1e-12)
    matrix = normal / (scale[:, :, None] * scale[:, None, :]) + damping[:, None, None] * np.eye(3)
    return -np.linalg.solve(matrix, (slope / scale)[..., None])[..., 0] / scale


def _bounded(theta: Array) -> Array:
    gains = theta[:, :2].clip(-_FACTOR, _FACTOR)
    return np.concatenate([gains, theta[:, 2:].clip(0.0, _FRICTION_NM)], 1)
