"""The engine's fitting problem with MuJoCo's arms in place of plain servos.

Parameters keep their names: frequency and damping now scale the twin's servo gains and joint damping around
`NOMINAL`, friction comes on top of the twin's own, play, delay and sag act on the commands and offsets on
readings only. Columns that repeat a joint are spread over worlds, a world being one trial under one set of
values for all joints; joints hardly push one another at the speeds of teleoperation.

Worlds take coarse steps and know neither parts nor the table: what the finely stepped twin with both does
beyond that is a known correction of the recorded positions (`on_twin`).

Shapes: N frames, T trials, J joints, C columns, S sheets (worlds per trial).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import override

import mujoco
import numpy as np
from mujoco.batch import Batch as Worlds

from lerobot_vtrefine.cores import usable_cores
from lerobot_vtrefine.diagnose.joints import gravity
from lerobot_vtrefine.diagnose.joints.batch import Batch, frame_s
from lerobot_vtrefine.diagnose.joints.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.joints.candidates.base import Candidate
from lerobot_vtrefine.diagnose.joints.fitting import SETTLING
from lerobot_vtrefine.diagnose.joints.parameters import INDEX, PARAMETERS, SAG
from lerobot_vtrefine.diagnose.joints.problem import JointProblem
from lerobot_vtrefine.diagnose.joints.servo import play_operator
from lerobot_vtrefine.diagnose.joints.servo_trials import Point
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.sim import task
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.scene import build_arms

Array = np.ndarray

NOMINAL = (20.0, 1.0)
"""Frequency [rad/s] and damping ratio that stand for the twin's servos as they come."""
COARSE_S, FINE_S = 0.02, 0.005
"""Steps of the replays by which causes are sought, and by which their sizes are settled."""


@dataclass(frozen=True)
class TwinProblem(JointProblem):
    """A `JointProblem` whose predictions are replays; trials are those of the twin's own robot,
    evenly spaced."""

    config: SceneConfig = SceneConfig()  # noqa: RUF009  frozen

    step_s: float = COARSE_S
    fine: "TwinProblem | None" = None
    """The same trials, to be replayed in fine steps."""

    asks_lags: bool = False
    """Its servos fade like low-passes of 75 to 170 ms: one on commands would change places with them."""
    shared_encoders: bool = True
    vague: float = 0.03
    misfit: float = 0.2
    """Coarse replays follow a fault only so exactly ..."""
    floor: float = 3e-4
    """... and the weight of carried parts is known only so well."""

    @classmethod
    def on(
        cls, names: tuple[str, ...], batch: Batch, config: SceneConfig, step_s: float = COARSE_S
    ) -> "TwinProblem":
        """From the joints' names and their trials."""
        plain = JointProblem.of(names, batch)
        parts = plain.names, plain.batch, plain.shapes, plain.scale
        return cls(*parts, config=config, step_s=step_s)

    @override
    def subset(self, trials: Array) -> "TwinProblem":
        part = super().subset(trials)
        assert isinstance(part, TwinProblem)
        return part if self.fine is None else replace(part, fine=self.fine.subset(trials))

    @override
    def bent(self, point: Point) -> "TwinProblem":
        """Itself: the twin's own gravity does that, and what it lacks is small."""
        return self

    @override
    def finer(self) -> "TwinProblem | None":
        return (
            None
            if self.fine is None
            else replace(self.fine, iterations=SETTLING, delay_spread_s=self.delay_spread_s)
        )

    @property
    @override
    def weight(self) -> Array:
        """Fingers tell nothing about a delay: where they hold something, their
        commands are their own positions."""
        out = np.zeros(self.batch.joints)
        arms = get_embodiment(self.config.embodiment).arm_columns
        out[arms] = super().weight[arms]
        return out

    @override
    def start(self) -> Point:
        """The twin as it comes."""
        theta = np.zeros((self.batch.joints, len(PARAMETERS)))
        theta[:, :2] = np.log(NOMINAL)
        return Point(theta, (gravity.ONE_TERM_FORMS[0],) * self.batch.joints)

    @override
    def candidates(self) -> tuple[Candidate, ...]:
        """Replays are slow: one form of each cause, and the decoys that are not forms of it."""
        known, forms = {"offset", "play", "friction", *SAG}, (None, "mass", "gain", "drift")
        return tuple(item for item in CATALOGUE if set(item.parameters) <= known and item.form in forms)

    @override
    def with_one_delay(self, point: Point, joint: Array | None = None, theta: Array | None = None) -> Array:
        if joint is None:
            joint = np.arange(self.batch.joints)
        if not len(joint):
            return np.zeros((*self.batch.time_s.shape, 0))
        theta = point.theta[joint] if theta is None else theta
        # How often each column's joint came before.
        sheet = np.tril(joint[:, None] == joint, -1).sum(1)
        sets = np.repeat(point.theta[None], int(sheet.max()) + 1, 0)
        sets[sheet, joint] = theta
        arms = _Arms.of(self.config, frame_s(self.batch), self.step_s)
        pushes = [self._push(point.forms, np.arange(self.batch.joints), values) for values in sets]
        push = np.stack([np.zeros_like(self.batch.command) if item is None else item for item in pushes])
        replayed = arms.replay(self.batch, push, sets, point.tau_s)
        return replayed[sheet, :, :, joint].transpose(1, 2, 0) + theta[:, INDEX["offset"]]


class _Arms:
    """Worlds of the twin's arms, kept between calls."""

    _known: Mapping[tuple[SceneConfig, float, float], "_Arms"] = {}

    def __init__(self, config: SceneConfig, dt_s: float, step_s: float) -> None:
        self.substeps = max(1, int(np.ceil(dt_s / step_s - 1e-6)))
        coarse = replace(config, timestep_s=min(config.timestep_s, 0.005))
        self.model, self.robot, self.joints = build_arms(coarse)
        self.model.opt.timestep = dt_s / self.substeps
        # A servo follows the target that it is given as if it had been in force at the step's start. Fine
        # steps are given the ramp's value at their end; coarse ones take the value of that same moment.
        ahead = min(config.timestep_s * self.substeps / dt_s, 1.0)
        self.weight = (np.arange(self.substeps) + ahead) / self.substeps
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.columns = self.robot.arm_columns.tolist()
        named = [self.robot.joint_names[k] for k in self.columns]
        self.servo = [int(self.model.actuator(name).id) for name in named]
        self.dof = [int(self.model.joint(name).dofadr[0]) for name in named]
        # Play widens both ways: of two fingers that mirror each other, the mean.
        self.side = np.where(self.robot.upper > 0, 1.0, -1.0)
        self.worlds: dict[int, Worlds] = {}

    @classmethod
    def of(cls, config: SceneConfig, dt_s: float, step_s: float) -> "_Arms":
        """The arms for one scene and frame rate, built once in either step."""
        key = (config, round(dt_s, 6), step_s)
        if key not in cls._known:
            same = {known: arms for known, arms in cls._known.items() if known[:2] == key[:2]}
            cls._known = {**same, key: cls(config, dt_s, step_s)}
        return cls._known[key]

    def replay(self, batch: Batch, push: Array, sets: Array, tau_s: float) -> Array:
        """Positions (S, N, T, J) under the parameters (S, J, P).

        Args:
            push: (S, N, T, J) added to commands behind the play.
        """
        sheets, frames, trials = len(sets), *batch.time_s.shape
        worlds = self._prepared(sheets * trials)
        self._set_fields(worlds, np.repeat(sets, trials, 0))
        start = batch.first_position - sets[:, None, :, INDEX["offset"]]
        first = start.reshape(sheets * trials, -1).clip(self.robot.lower, self.robot.upper)
        qpos, qvel = worlds.bind("qpos"), worlds.bind("qvel")
        worlds.reset(None, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        qpos[:] = 0.0
        qpos[:, self.joints] = first
        qvel[:] = 0.0
        controls = self._controls(batch.command, push, sets[..., INDEX["play"]], first, tau_s)
        out = worlds.rollout(controls.shape[1], control=controls, record=("qpos",), ids=None)["qpos"]
        moved = out[:, self.substeps - 1 :: self.substeps][:, :, self.joints]
        path = np.concatenate([first[:, None], moved], 1)
        return path.reshape(sheets, trials, frames, -1).transpose(0, 2, 1, 3)

    def _controls(self, command: Array, push: Array, play: Array, first: Array, tau_s: float) -> Array:
        """Servo targets (W, K, nu) of all steps; play (S, J) acts on the way between frames, too."""
        frames, trials, _ = command.shape
        own = task.servo_commands(self.robot, command.reshape(frames * trials, -1))
        servo = np.tile(own.reshape(frames, trials, -1).swapaxes(0, 1), (len(play), 1, 1))
        rest = task.servo_commands(self.robot, first)[:, None]
        wanted = self._between(rest, servo)
        width = np.abs(np.repeat(self._per_servo(play * self.side), trials, 0))
        out = play_operator(wanted.swapaxes(0, 1), width, rest[:, 0]).swapaxes(0, 1)
        if push.any():
            added = self._per_servo(push).transpose(0, 2, 1, 3).reshape(len(first), frames, -1)
            out += self._between(added[:, :1], added)
        return _late(out, rest[:, 0], tau_s / self.model.opt.timestep)

    def _per_servo(self, values: Array) -> Array:
        """Changes of joints (..., J) as changes of servos (..., nu)."""
        flat = task.servo_values(self.robot, values.reshape(-1, values.shape[-1]))
        return flat.reshape(*values.shape[:-1], -1)

    def _between(self, first: Array, values: Array) -> Array:
        """Values (W, N, nu) of frames, after `first` (W, 1, nu), at every step but the last frame's: targets
        ramp over a frame, as `InsertionSim` has it."""
        before = np.concatenate([first, values[:, :-1]], 1)[:, :-1, None]
        between = before + self.weight[:, None] * (values[:, :-1, None] - before)
        return between.reshape(len(values), -1, values.shape[-1])

    def _prepared(self, count: int) -> Worlds:
        """That many worlds: fits go back and forth between a few numbers of them."""
        if count not in self.worlds:
            self.worlds[count] = Worlds(self.model, nsim=count, nthread=usable_cores())
        return self.worlds[count]

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
