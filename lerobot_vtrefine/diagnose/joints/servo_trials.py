"""Trials, and what the servo model predicts of them. Shapes: N frames, T trials, J joints, C columns,
P = `len(PARAMETERS)`.
"""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from lerobot_vtrefine.diagnose.joints import gravity, stages
from lerobot_vtrefine.diagnose.joints.batch import Batch
from lerobot_vtrefine.diagnose.joints.parameters import INDEX, PARAMETERS, SAG, TIMES
from lerobot_vtrefine.diagnose.joints.servo import Columns, simulate, two_delays

Array = np.ndarray

_START_OMEGA = (4.0, 10.0, 25.0, 60.0)
_START_ZETA = (0.4, 1.0, 2.0)


@dataclass(frozen=True)
class Point:
    """Parameter values of all joints."""

    theta: Array
    """(J, P); angles in rad, slides in m, frequencies and damping as logarithms."""
    forms: tuple[str, ...]
    """Shape of each joint's sag."""
    tau_s: float = 0.0

    def with_values(self, name: str, values: Array | float, joints: Array | None = None) -> "Point":
        """With one parameter set, for some joints or all."""
        theta = self.theta.copy()
        rows = np.arange(len(theta)) if joints is None else joints
        theta[rows, INDEX[name]] = values
        return replace(self, theta=theta)

    def value(self, name: str) -> Array:
        """One parameter of all joints (J,)."""
        return self.theta[:, INDEX[name]]


@dataclass(frozen=True)
class ServoTrials:
    """Trials and the servo model's predictions of them, with gravity's shapes at their commands worked out
    once."""

    names: tuple[str, ...]
    batch: Batch
    shapes: dict[str, Array]
    """Form -> (N, T, J, K)."""
    scale: Array = field(repr=False)
    """(J,) typical error: what finite differences and starts are measured by."""
    misfit: float = 0.0
    """What is called a cause must change a joint's prediction by this part of its baseline's error ..."""
    floor: float = 0.0
    """... and by this much [rad; a tenth of it in m for slides]."""
    shared_encoders: bool = False
    """Servos close their loop on the encoders that are read: an offset of these moves commands and readings
    alike, and only one that comes behind the servo shows."""
    vague: float = 0.0
    """Part of a play's width that 95 % intervals allow for the method's own error."""
    iterations: int = 20
    """Most steps of a fit."""
    scatter_s: float = 0.0
    """Deviation of single commands' delays that predictions are means over [s]."""

    @classmethod
    def of(cls, names: tuple[str, ...], batch: Batch) -> Self:
        """From the joints' names and their trials."""
        error = np.where(batch.valid[..., None], batch.position - batch.command, 0.0)
        moved = np.ptp(batch.command, axis=(0, 1))
        scale = np.maximum(error.reshape(-1, batch.joints).std(0), 1e-3 * moved)
        session = batch.start_s + batch.time_s
        known = np.array([session.min(), session.max()])
        shapes = gravity.shapes(names, batch.command) | gravity.decoys(batch.command, session, known)
        return cls(names, batch, shapes, np.maximum(scale, 1e-7))

    def subset(self, trials: Array) -> Self:
        """The same problem on fewer trials."""
        batch = self.batch.subset(trials)
        length = len(batch.time_s)
        shapes = {form: values[:length][:, np.asarray(trials)] for form, values in self.shapes.items()}
        return replace(self, batch=batch, shapes=shapes)

    def bent(self, point: Point) -> Self:
        """With gravity's shapes where the arm stands once it has sagged, not where it was commanded to."""
        bare = point.with_values("bend", 0.0).theta
        push = self._push(point.forms, np.arange(self.batch.joints), bare)
        if push is None:
            return self
        return replace(self, shapes=self.shapes | gravity.shapes(self.names, self.batch.command + push))

    @property
    def weight(self) -> Array:
        """(J,) that makes the joints' squared errors comparable where they share the delay."""
        return 1.0 / self.scale**2

    def start(self) -> Point:
        """Where fits of the baseline begin: the best of a few plain servos per joint."""
        count = self.batch.joints
        theta = np.zeros((count, len(PARAMETERS)))
        grid = [(np.log(omega), np.log(zeta)) for omega in _START_OMEGA for zeta in _START_ZETA]
        columns = np.tile(np.arange(count), len(grid))
        many = theta[columns].copy()
        many[:, :2] = np.repeat(np.array(grid), count, 0)
        point = Point(theta, (gravity.ONE_TERM_FORMS[0],) * count)
        left = self.residual(self.predict(point, columns, many), columns)
        cost = (left**2).sum((0, 1)).reshape(len(grid), count)
        point.theta[:, :2] = np.array(grid)[cost.argmin(0)]
        return point

    def predict(self, point: Point, joint: Array | None = None, theta: Array | None = None) -> Array:
        """Positions (N, T, C) of columns: joints (C,) under parameters (C, P); by default all joints.

        Where delays scatter, these are means: exact but for dry friction.
        """
        if not self.scatter_s:
            return self.with_one_delay(point, joint, theta)
        delays = two_delays(point.tau_s, self.scatter_s)
        one, other = (self.with_one_delay(replace(point, tau_s=tau_s), joint, theta) for tau_s, _ in delays)
        return delays[0][1] * one + delays[1][1] * other

    def with_one_delay(self, point: Point, joint: Array | None = None, theta: Array | None = None) -> Array:
        """The same where every command is as late as every other."""
        joint = np.arange(self.batch.joints) if joint is None else joint
        theta = point.theta[joint] if theta is None else theta
        value = dict(zip(PARAMETERS, theta.T, strict=True))
        plain = ("offset", "play", "loose", "friction", "stop", "give", "stick", *TIMES)
        columns = Columns(
            joint=joint,
            omega=np.exp(value["log_omega"]),
            zeta=np.exp(value["log_zeta"]),
            rounding=value["round"],
            tau_s=point.tau_s,
            push=self._push(point.forms, joint, theta),
            stages={name: value[name] for name in stages.parameters()},
            **{name: value[name] for name in plain},
        )
        return simulate(self.batch, columns)

    def residual(self, prediction: Array, joint: Array | None = None) -> Array:
        """Measured minus predicted (N, T, C), zero where there is nothing to compare."""
        position = self.batch.position if joint is None else self.batch.position[..., joint]
        return np.where(self.batch.valid[..., None], position - prediction, 0.0)

    def _push(self, forms: tuple[str, ...], joint: Array, theta: Array) -> Array | None:
        sag = theta[:, [INDEX[name] for name in SAG]]
        bend = theta[:, INDEX["bend"]]
        load = self.batch.load
        if not sag.any() and (load is None or not bend.any()):
            return None
        push = np.zeros((*self.batch.time_s.shape, len(joint)))
        for column, index in enumerate(joint):
            if sag[column].any():
                push[..., column] = self.shapes[forms[index]][:, :, index] @ sag[column]
        if load is not None and bend.any():
            values = {name: theta[:, INDEX[name]] for name in stages.parameters()}
            push -= bend * stages.spring(load[..., joint], values)
        return push
