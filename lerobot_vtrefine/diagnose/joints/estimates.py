"""Parameters as the verdict gives them: names and units of contract §5, intervals by leaving trials out."""

from itertools import pairwise

import numpy as np

from lerobot_vtrefine.diagnose.joints.candidates import FRICTION, LATENCY, resolution
from lerobot_vtrefine.diagnose.joints.fitting import INDEX, SAG, Problem
from lerobot_vtrefine.diagnose.joints.friction_load import friction_in_load, stiffness_in_load
from lerobot_vtrefine.diagnose.joints.gravity import full_reach, is_sliding
from lerobot_vtrefine.diagnose.joints.newton import jackknife, leave_out, without_ridge
from lerobot_vtrefine.diagnose.joints.selection import Selection
from lerobot_vtrefine.diagnose.verdict import Parameter
from lerobot_vtrefine.embodiments import ALOHA

Array = np.ndarray


_METHOD = {
    LATENCY: (0.01, 0.0),
    "backlash": (0.005, 0.2),
    FRICTION: (0.012, 0.1),
    "gravity_sag": (0.012, 0.03),
    "encoder_offset": (0.001, 0.04),
    "gripper_compliance": (0.015, 0.0),
}
"""What sizes are off by where trials agree on them: when servos act and encoders are read within a frame, and
coarse readings. Half-width of 95 %: part of the size, and encoder steps; set by robots of other code."""
_ROUNDING_VAGUE = 0.08
"""Where a play ends that is taken up bit by bit depends on its form: part of its width, per rounding."""
_AS_GOOD = 1.03
"""Held-out squared error of a form over the least one, up to which it tells the trials as well."""
_STICKING_VAGUE = 0.12
"""How friction falls from rest to motion is not resolved: part of it that intervals allow for."""


class Estimates:
    """Fitted values of a selection, and what they become without each condition."""

    def __init__(self, selection: Selection, seed: int) -> None:
        self.selection, self.seed = selection, seed
        self.theta, self.tau = leave_out(selection.problem, selection.fit)
        self.steps = resolution(selection.problem)
        self.unheld = without_ridge(selection.problem, selection.fit)

    def of(self, cause: str, joints: tuple[int, ...]) -> dict[str, Parameter]:
        """The cause's parameters on those joints."""
        if cause == LATENCY:
            value = self.selection.fit.point.tau_s
            # A uniform error of width w has the standard deviation w / sqrt(12).
            tick = 1.96 * self.selection.problem.tick_s / np.sqrt(12)
            own = float(np.hypot(np.hypot(tick, self.selection.delay_spread_s), self._method(LATENCY, value)))
            return {"tau_s": Parameter(value, widened(jackknife(self.tau, value), value, own), "s")}
        if cause == "gripper_compliance":
            return self._gripper(joints)
        out: dict[str, Parameter] = {}
        for joint in joints:
            name = self.selection.problem.names[joint]
            if cause == FRICTION:
                key, parameter = self._friction(joint, name)
                out[key] = parameter
            else:
                unit = "m" if is_sliding(name) else "rad"
                out[f"{name}_{unit}"] = self._length(cause, joint, unit)
        return out

    def baseline(self, theta: Array) -> dict[str, Parameter]:
        """Frequency and damping of every joint of a fit (J, P), without intervals."""
        out: dict[str, Parameter] = {}
        for joint, name in enumerate(self.selection.problem.names):
            out[f"{name}.natural_frequency"] = Parameter(float(np.exp(theta[joint, 0])), None, "rad/s")
            out[f"{name}.damping_ratio"] = Parameter(float(np.exp(theta[joint, 1])), None, "1")
        return out

    def _length(self, cause: str, joint: int, unit: str) -> Parameter:
        now, loose = self.selection.fit.point.theta[joint], 0.0
        drawn = self.theta[:, joint]
        if cause == "gravity_sag":
            form = self.selection.fit.point.forms[joint]
            columns = [INDEX[name] for name in SAG]
            value = full_reach(form, now[columns])
            loose = full_reach(form, self.unheld[joint, columns])
            spread = np.array([full_reach(form, terms) for terms in drawn[:, columns]])
        else:
            names = ("play", "loose") if cause == "backlash" else ("offset",)
            columns = [INDEX[name] for name in names]
            value, spread = float(now[columns].sum()), drawn[:, columns].sum(1)
        vague = self.selection.problem.vague + _ROUNDING_VAGUE * now[INDEX["round"]]
        own = vague * abs(value) if cause == "backlash" else 0.0
        if cause == "gravity_sag":
            own = max(abs(loose - value), self._among_forms(joint, value))
        own = float(np.hypot(own, self._method(cause, value, joint)))
        return Parameter(value, widened(jackknife(spread, value), value, own), unit)

    def _method(self, cause: str, value: float, joint: int | None = None) -> float:
        """What the method itself errs by, see `_METHOD`."""
        part, steps = _METHOD[cause]
        step = 0.0 if joint is None else float(self.steps[joint])
        return float(np.hypot(part * value, steps * step))

    def _among_forms(self, joint: int, value: float) -> float:
        """How far a sag's size at full reach is off by forms that tell the trials as well: where all of them
        do, the postures seen do not reach as far as the number does."""
        tried = [item for item in self.selection.first_round if item.cause == "gravity_sag"]
        errors = {k: float(item.held_out.mean(0)[joint]) for k, item in enumerate(tried)}
        least = min(errors.values(), default=0.0)
        sizes = [value]
        for k, error in errors.items():
            point = tried[k].fit.point
            terms = point.theta[joint, [INDEX[name] for name in SAG]]
            if error < _AS_GOOD * least and terms.any():
                sizes.append(full_reach(point.forms[joint], terms))
        return float(np.max(np.abs(np.array(sizes) - value)))

    def _friction(self, joint: int, name: str) -> tuple[str, Parameter]:
        """In Nm where loads or the robot's known servo gains give the scale; else as the servo's error."""
        problem = self.selection.problem
        sliding = is_sliding(name)
        column = INDEX["friction"]
        value = float(self.selection.fit.point.theta[joint, column])
        own = _STICKING_VAGUE * value if self.selection.fit.free[joint, INDEX["stick"]] else 0.0
        own = float(np.hypot(own, self._method(FRICTION, value, joint)))
        low, high = widened(jackknife(self.theta[:, joint, column], value), value, own)
        stiffness = stiffness_in_load(problem, self.selection.fit, joint)
        if stiffness is None and problem.batch.load is not None:
            seen = friction_in_load(problem, self.selection.fit, joint, self.seed)
            if seen.seen:
                unit = "N" if sliding else "Nm"
                return f"{name}_{unit.lower()}", Parameter(seen.torque, seen.ci95, unit)
        stiffness = stiffness or _stiffness(name)
        if stiffness is None:
            unit = "m" if sliding else "rad"
            return f"{name}_{unit}", Parameter(value, (low, high), f"{unit} of servo error")
        unit = "N" if sliding else "Nm"
        scaled = (low * stiffness, high * stiffness)
        return f"{name}_{unit.lower()}", Parameter(value * stiffness, scaled, unit)

    def _gripper(self, joints: tuple[int, ...]) -> dict[str, Parameter]:
        """By its load, or by where the gripper stops and how far it gives there."""
        free, theta = self.selection.fit.free, self.selection.fit.point.theta
        loaded = tuple(joint for joint in joints if free[joint, INDEX["bend"]])
        out = {"m_per_n": self._compliance(loaded)} if loaded else {}
        for joint in joints:
            for parameter, unit in (("stop", "m"), ("give", "1")):
                column = INDEX[parameter]
                if free[joint, column]:
                    value = float(theta[joint, column])
                    key = f"{self.selection.problem.names[joint]}_{parameter}" + ("_m" if unit == "m" else "")
                    out[key] = Parameter(value, jackknife(self.theta[:, joint, column], value), unit)
        return out

    def _compliance(self, joints: tuple[int, ...]) -> Parameter:
        """One number for all grippers: their mean, each weighted by how well it is known; fingers that move
        the other way have loads of the other sign or not, so sizes are averaged."""
        column = INDEX["bend"]
        index = list(joints)
        value = self.selection.fit.point.theta[index, column]
        drawn = self.theta[:, index, column]
        weight = 1 / drawn.var(0).clip(1e-300)
        sign = np.sign(value)
        mean = float((weight * np.abs(value)).sum() / weight.sum())
        spread = (drawn * sign * weight).sum(1) / weight.sum()
        overall = 1.0 if (sign >= 0).any() else -1.0
        low, high = widened(jackknife(spread, mean), mean, self._method("gripper_compliance", mean))
        if overall < 0:
            low, high = -high, -low
        return Parameter(overall * mean, (low, high), "m/N")


def widened(ci95: tuple[float, float], value: float, own: float) -> tuple[float, float]:
    """An interval about a value with an independent error of 95 % half-width `own`; what is surely positive
    stays so."""
    low, high = (float(np.hypot(end - value, own)) for end in ci95)
    least = min(ci95[0], 0.0) if value >= 0 else -np.inf
    return max(value - low, least), value + high


def _stiffness(name: str) -> float | None:
    """Servo gain [Nm/rad, N/m] of a joint that is named as ALOHA's."""
    plain = name.removesuffix(".pos")
    if plain not in ALOHA.joint_names:
        return None
    if is_sliding(plain):
        return ALOHA.fingers.stiffness
    return next(joint.stiffness for joint in ALOHA.joints if plain.endswith(joint.name))


def repeatability(problem: Problem, residual: Array) -> float | None:
    """Root mean square error that no model could undo: half the squared difference of repeated trials; None
    without repeated commands."""
    batch = problem.batch
    found = []
    for condition in set(batch.conditions):
        trials = [index for index, name in enumerate(batch.conditions) if name == condition]
        for a, b in pairwise(trials):
            valid = batch.valid[:, a] & batch.valid[:, b]
            same = np.abs(batch.command[valid][:, a] - batch.command[valid][:, b])
            if valid.sum() > 1 and same.max() < 1e-6:
                found.append(0.5 * np.square(residual[valid, a] - residual[valid, b]).mean())
    return float(np.sqrt(np.mean(found))) if found else None
