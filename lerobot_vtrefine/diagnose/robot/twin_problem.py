"""The engine's fitting problem with MuJoCo's arms in place of plain servos.

Parameters keep their names: frequency and damping now scale the twin's servo gains and joint damping around
`NOMINAL`, friction comes on top of the twin's own, play, delay and sag act on the commands and offsets on
encoders. Columns that repeat a joint are spread over worlds, a world being one trial under one set of values
for all joints; joints hardly push one another at the speeds of teleoperation.

Worlds take coarse steps and know neither parts nor the table: what the finely stepped twin with both does
beyond that is a known correction of the recorded positions (`on_twin`).

Shapes: N frames, T trials, J joints, C columns, S sheets (worlds per trial).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from mujoco.batch import Batch as Worlds

from lerobot_vtrefine.diagnose.robot import gravity
from lerobot_vtrefine.diagnose.robot.batch import Batch
from lerobot_vtrefine.diagnose.robot.candidates import STOP
from lerobot_vtrefine.diagnose.robot.fitting import INDEX, PARAMETERS, Point, Problem
from lerobot_vtrefine.sim import task
from lerobot_vtrefine.sim.backends.batch import usable_cores
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.scene import build_arms

Array = np.ndarray

NOMINAL = (20.0, 1.0)
"""Frequency [rad/s] and damping ratio that stand for the twin's servos as they come."""
_STEP_S = 0.02


@dataclass(frozen=True)
class TwinProblem(Problem):
    """A `Problem` whose predictions are replays; trials are those of the twin's own robot, evenly spaced."""

    hold: str = "linear"
    """linear or zero_order, see `command_replay.HOLDS`."""
    config: SceneConfig = SceneConfig()  # noqa: RUF009  frozen

    misfit: float = 0.2
    """Coarse replays follow a fault only so exactly ..."""
    floor: float = 3e-4
    """... and the weight of carried parts is known only so well."""

    @classmethod
    def on(cls, names: tuple[str, ...], batch: Batch, config: SceneConfig, hold: str) -> "TwinProblem":
        """From the joints' names and their trials."""
        plain = Problem.of(names, batch)
        return cls(plain.names, plain.batch, plain.shapes, plain.scale, hold=hold, config=config)

    def start(self) -> Point:
        """The twin as it comes."""
        theta = np.zeros((self.batch.joints, len(PARAMETERS)))
        theta[:, :2] = np.log(NOMINAL)
        return Point(theta, (gravity.ONE_TERM_FORMS[0],) * self.batch.joints)

    def offers(self, parameters: tuple[str, ...], form: str | None) -> bool:
        """Replays are slow: one form of each cause, and the decoys that are not forms of it."""
        return parameters not in (("loose",), ("bend",), STOP) and form in (None, "mass", "gain", "drift")

    def predict(self, point: Point, joint: Array | None = None, theta: Array | None = None) -> Array:
        """See `Problem.predict`."""
        if joint is None:
            joint = np.arange(self.batch.joints)
        if not len(joint):
            return np.zeros((*self.batch.time_s.shape, 0))
        theta = point.theta[joint] if theta is None else theta
        sheet = _occurrence(joint)
        sets = np.repeat(point.theta[None], int(sheet.max()) + 1, 0)
        sets[sheet, joint] = theta
        paths = np.stack([self._inputs(point, values) for values in sets])
        arms = _Arms.of(self.config, self.dt_s)
        replayed = arms.replay(paths, sets, self._starts(sets), self.hold, point.tau_s)
        return replayed[sheet, :, :, joint].transpose(1, 2, 0) + theta[:, INDEX["offset"]]

    @property
    def dt_s(self) -> float:
        """Time between frames [s]."""
        dt = np.diff(self.batch.time_s, axis=0)
        return float(np.median(dt[dt > 0]))

    def _inputs(self, point: Point, theta: Array) -> Array:
        """Targets (N, T, J) that reach the servos under parameters (J, P), but for the delay."""
        target = self.batch.command - theta[:, INDEX["offset"]]
        half, state = theta[:, INDEX["play"]] / 2, self.batch.first_position - theta[:, INDEX["offset"]]
        if half.any():
            target = target.copy()
            for k in range(len(target)):
                state = target[k] = np.clip(state, target[k] - half, target[k] + half)
        push = self._push(point.forms, np.arange(self.batch.joints), theta)
        return target if push is None else target + push

    def _starts(self, sets: Array) -> Array:
        """(S, T, J) true positions at the first frames."""
        return self.batch.first_position - sets[:, None, :, INDEX["offset"]]


def _occurrence(joint: Array) -> Array:
    """(C,) how often each column's joint came before."""
    seen: dict[int, int] = {}
    out = np.empty(len(joint), dtype=int)
    for place, index in enumerate(joint.tolist()):
        out[place] = seen.get(index, 0)
        seen[index] = out[place] + 1
    return out


class _Arms:
    """Worlds of the twin's arms, kept between calls."""

    _known: Mapping[tuple[SceneConfig, float], "_Arms"] = {}

    def __init__(self, config: SceneConfig, dt_s: float) -> None:
        self.substeps = max(1, int(np.ceil(dt_s / _STEP_S - 1e-6)))
        coarse = replace(config, timestep_s=min(config.timestep_s, 0.005))
        self.model, self.robot, self.joints = build_arms(coarse)
        self.model.opt.timestep = dt_s / self.substeps
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.columns = [k for k, name in enumerate(self.robot.joint_names) if not gravity.is_sliding(name)]
        named = [self.robot.joint_names[k] for k in self.columns]
        self.servo = [int(self.model.actuator(name).id) for name in named]
        self.dof = [int(self.model.joint(name).dofadr[0]) for name in named]
        self.worlds: Worlds | None = None

    @classmethod
    def of(cls, config: SceneConfig, dt_s: float) -> "_Arms":
        """The arms for one scene and frame rate, built once."""
        key = (config, round(dt_s, 6))
        if key not in cls._known:
            cls._known = {key: cls(config, dt_s)}
        return cls._known[key]

    def replay(self, targets: Array, sets: Array, starts: Array, hold: str, tau_s: float) -> Array:
        """Positions (S, N, T, J) under targets (S, N, T, J) that come late by `tau_s`, parameters (S, J, P),
        from (S, T, J) at rest.
        """
        sheets, frames, trials, _ = targets.shape
        worlds = self._prepared(sheets * trials)
        self._set_fields(worlds, np.repeat(sets, trials, 0))
        flat = targets.transpose(1, 0, 2, 3).reshape(frames, sheets * trials, -1)
        first = starts.reshape(sheets * trials, -1).clip(self.robot.lower, self.robot.upper)
        qpos, qvel = worlds.bind("qpos"), worlds.bind("qvel")
        worlds.reset(None, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        qpos[:] = 0.0
        qpos[:, self.joints] = first
        qvel[:] = 0.0
        servo = np.stack([task.servo_commands(self.robot, row) for row in flat])
        before = np.concatenate([task.servo_commands(self.robot, first)[None], servo[:-1]])
        weight = (
            (np.arange(self.substeps) + 1.0) / self.substeps if hold == "linear" else np.ones(self.substeps)
        )
        controls = before[:-1, :, None] + weight[:, None] * (servo - before)[:-1, :, None]
        controls = controls.transpose(1, 0, 2, 3).reshape(sheets * trials, -1, servo.shape[-1])
        controls = _late(controls, before[0], tau_s / self.model.opt.timestep)
        out = worlds.rollout(controls.shape[1], control=controls, record=("qpos",), ids=None)["qpos"]
        moved = out[:, self.substeps - 1 :: self.substeps][:, :, self.joints]
        path = np.concatenate([first[:, None], moved], 1)
        return path.reshape(sheets, trials, frames, -1).transpose(0, 2, 1, 3)

    def _prepared(self, count: int) -> Worlds:
        if self.worlds is None or self.worlds.bind("qpos").shape[0] != count:
            self.worlds = Worlds(self.model, nsim=count, nthread=usable_cores())
            self.worlds.bind("qvel")
        return self.worlds

    def _set_fields(self, worlds: Worlds, sets: Array) -> None:
        omega, zeta = (np.exp(sets[:, self.columns, k]) / NOMINAL[k] for k in range(2))
        gain = self.model.actuator_gainprm[self.servo, 0] * omega**2
        gains, bias = worlds.expand("actuator_gainprm"), worlds.expand("actuator_biasprm")
        gains[:, self.servo, 0], bias[:, self.servo, 1] = gain, -gain
        damping = np.reshape(self.model.dof_damping, (self.model.nv, -1))[self.dof, 0] * omega * zeta
        field = worlds.expand("dof_damping")
        field.reshape(len(sets), self.model.nv, -1)[:, self.dof, 0] = damping
        friction = self.model.dof_frictionloss[self.dof] + gain * sets[:, self.columns, INDEX["friction"]]
        worlds.expand("dof_frictionloss")[:, self.dof] = friction


def _late(controls: Array, first: Array, steps: float) -> Array:
    """Controls (W, K, nu) that come late by a number of steps, after `first` (W, nu)."""
    if steps <= 0:
        return controls
    whole, part = divmod(steps, 1.0)
    before = np.repeat(first[:, None], int(whole) + 1, 1)
    late = np.concatenate([before, controls], 1)
    count = controls.shape[1]
    return (1 - part) * late[:, 1 : count + 1] + part * late[:, :count]
