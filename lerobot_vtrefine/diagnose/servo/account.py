"""How a servo's diagnosis is reported: sizes, the model file, what to record next, what to draw."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.detectable import smallest
from lerobot_vtrefine.diagnose.core.engine import Inference
from lerobot_vtrefine.diagnose.core.problem import OptionalRemarks
from lerobot_vtrefine.diagnose.core.resampling import jackknife
from lerobot_vtrefine.diagnose.core.rivals import Rival
from lerobot_vtrefine.diagnose.core.suspicion import Alarm
from lerobot_vtrefine.diagnose.evidence import ResidualView, Trace
from lerobot_vtrefine.diagnose.servo.candidates import CATALOGUE, NAMES
from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate
from lerobot_vtrefine.diagnose.servo.fitting import Fit, Refits
from lerobot_vtrefine.diagnose.servo.model import ServoModel
from lerobot_vtrefine.diagnose.servo.parameters import BASELINE, INDEX, LIMITS
from lerobot_vtrefine.diagnose.servo.problem import ServoProblem, encoder_step
from lerobot_vtrefine.diagnose.verdict import Parameter

Array = np.ndarray

_TRACES = 6
_FIRST_STEP = 2e-3
"""Of finite differences, as a part of a parameter's size."""


class ServoAccount(OptionalRemarks):
    """See `core.problem.Account`."""

    unit = "rad"
    metric = "rmse"

    def __init__(self, found: Inference[ServoProblem, Fit, Candidate]) -> None:
        self.selection = found.selection
        self.problem, self.fit = found.selection.problem, found.selection.fit
        self.without = _leave_one_out(self.problem, self.fit)

    def parameters(self, cause: str, channels: tuple[int, ...]) -> Mapping[str, Parameter]:
        """All that the cause's form frees, with intervals by leaving trials out."""
        names = [name for form in self.selection.candidates_of(cause, channels) for name in form.parameters]
        return {name: self._parameter(name) for name in names}

    def baseline_parameters(self) -> Mapping[str, Parameter]:
        """Those of motor and friction, in their units."""
        fitted = self.selection.baseline
        out = {}
        for name in BASELINE:
            value = fitted.value(name)
            value = float(np.exp(value)) if name.startswith("log_") else value
            out[name.removeprefix("log_")] = Parameter(value, None, LIMITS[name].unit)
        return out

    def model(self, fit: Fit) -> ServoModel:
        """The model that is written to a file."""
        return ServoModel.of(fit.theta)

    def minimum_detectable(self) -> Mapping[str, float]:
        """The main parameter's smallest size, with the speed at which fits begin and no other parameter."""
        fitter, fitted = self.problem.fitter, self.fit
        free = np.flatnonzero(fitted.free)
        own = fitter.derivatives(fitted.theta[None], fitted.residual[None], free, np.array([_FIRST_STEP]))
        out: dict[str, float] = {}
        for candidate in CATALOGUE:
            places = [INDEX[name] for name in candidate.parameters]
            if not candidate.possible(self.problem.bench) or fitted.free[places].any():
                continue
            step = _FIRST_STEP * fitter.start[places[0]]
            theta = fitted.theta.copy()
            theta[places[0]] = step
            for name, place in zip(candidate.parameters, places, strict=True):
                if name.endswith("_speed"):
                    theta[place] = fitter.start[place]
            moved = (fitted.residual - fitter.residuals(theta[None])[0]) / step
            size = smallest(moved, own[0].transpose(1, 2, 0), fitted.residual)
            if size is not None:
                out[candidate.cause] = min(size, out.get(candidate.cause, np.inf))
        return out

    def noise_floor(self) -> float | None:
        """The rounding error of the encoder; more noise could be seen only in repeated trials."""
        return encoder_step(self.problem.bench) / np.sqrt(12)

    def causes(self) -> Sequence[str]:
        """Names of the catalogue."""
        return NAMES

    def not_identifiable(self, cause: str) -> str:
        """What to record so that trials can show it."""
        forms = [item for item in CATALOGUE if item.cause == cause]
        hidden = not any(item.possible(self.problem.bench) for item in forms)
        return next((item.needs for item in forms), "") if hidden else ""

    def next_experiment(
        self, rivals: Sequence[Rival[Fit, Candidate]], alarms: Sequence[Alarm]
    ) -> Mapping[str, Any] | None:
        """What to record where laws of friction tie."""
        if not rivals:
            return None
        return {
            "decides": sorted({name for item in rivals for name in (item.cause, item.name)}),
            "text": "Record the same motions with a load twice as heavy and with half of it, and at one more "
            "gain: let the servo lift it, hold it, lower it slowly and let it fall. Laws that tie at one "
            "load differ at others, and between driving and being driven back.",
            "protocol": {"load_factors": [0.5, 1.0, 2.0], "gains": 4, "replicates": 2},
        }

    def drawings(self, test: ServoProblem, seed: int) -> tuple[tuple[Trace, ...], tuple[ResidualView, ...]]:
        """Traces of locked trials."""
        bench = test.bench
        fits = (self.selection.baseline, self.fit)
        before, after = (test.fitter.evaluate(item.theta, item.free).residual for item in fits)
        out = []
        for trial in range(min(len(bench.files), _TRACES)):
            valid = bench.valid[:, trial]
            measured = bench.position[valid, trial]
            out.append(
                Trace(
                    bench.files[trial],
                    bench.recorded[trial],
                    bench.time_s[valid, trial],
                    test.channels,
                    measured[:, None],
                    (measured - before[valid, trial])[:, None],
                    (measured - after[valid, trial])[:, None],
                    {"command": bench.command[valid, trial]},
                )
            )
        return tuple(out), ()

    def _parameter(self, name: str) -> Parameter:
        place = INDEX[name]
        value = float(self.fit.theta[place])
        return Parameter(value, jackknife(self.without[:, place], value), LIMITS[name].unit)


def _leave_one_out(problem: ServoProblem, fit: Fit) -> Array:
    """(T, P) without each trial."""
    again = Refits(problem.bench, fit)
    return np.stack([again.theta(row) for row in 1.0 - np.eye(len(problem.files))])
