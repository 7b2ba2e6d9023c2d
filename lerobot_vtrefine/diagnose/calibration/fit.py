"""Stiffness, damping and readout from press recordings, with intervals from resampling whole recordings.

The model is the paper's (appendix, "Tactile Calibration"): f = max(0, k_n d + k_d d') per taxel, reading =
gain f on an idle level; a saturation is added only if recordings that its fit has not seen are predicted
better with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.diagnose.calibration.excitation import Excitation, excitation, problems
from lerobot_vtrefine.diagnose.core.heldout import out_of_fold
from lerobot_vtrefine.diagnose.core.resampling import one_sided
from lerobot_vtrefine.diagnose.pad.baseline import Baseline, fit_baseline, weigh
from lerobot_vtrefine.diagnose.pad.candidates import saturation
from lerobot_vtrefine.diagnose.pad.fitting import Fit, bounded_step, fit
from lerobot_vtrefine.diagnose.pad.intervals import interval
from lerobot_vtrefine.diagnose.pad.model import Composite, sensor_model
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet, prepare, usable
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.quality import check_quality
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.diagnose.verdict import DataIssue, Parameter
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.contact import Consistent, ContactStage
from lerobot_vtrefine.tactile.stages.readout import Idle
from lerobot_vtrefine.tactile.stages.readout import Noise as NoiseStage

CONTACTS = ("kelvin_voigt", "consistent")
DRAWS = 600
MAX_P = 0.01
MIN_GAIN = 0.01
"""A saturation must take this part of the squared error away on recordings left out."""


@dataclass(frozen=True)
class Wanted:
    """What to fit.

    Attributes:
        k_n: stiffness per taxel [N/m] if it is known; None fits it.
        static: leave k_d out (0).
        readout_only: fit the path from force to reading alone.
        contact: stage that the model gets: the paper's, or the same stiffness in the simulator's
            load-consistent foundation.
    """

    k_n: float | None = None
    static: bool = False
    readout_only: bool = False
    contact: str = "kelvin_voigt"

    @property
    def damping(self) -> bool:
        """Whether k_d is fitted."""
        return not (self.static or self.readout_only)

    @property
    def stiffness(self) -> bool:
        """Whether k_n is fitted."""
        return self.k_n is None and not self.readout_only

    def __post_init__(self) -> None:
        if self.k_n is not None and not (np.isfinite(self.k_n) and self.k_n > 0):
            raise ValueError(f"--k_n must be a positive number of N/m, got {self.k_n}")
        check_choice("--contact", self.contact, CONTACTS)


@dataclass(frozen=True)
class Calibration:
    """A fitted sensor."""

    model: SensorModel
    parameters: dict[str, Parameter]
    """k_n, k_d, gain and what else was fitted, with 95 % intervals."""
    excitation: Excitation
    issues: tuple[DataIssue, ...]
    """Recordings set aside or repaired before the fit."""
    presses: PressSet
    fitted: Fit
    draws: dict[str, np.ndarray]
    """Resampled values of every parameter that has an interval."""
    rms_counts: float
    noise_counts: float
    """Deviation of a single reading at rest."""
    saturation_p: float | None
    """Of the gain that a saturation brings on recordings left out; None where it does not improve the fit."""

    @property
    def explained(self) -> float:
        """Part of the readings' squared deviation from idle that the model accounts for."""
        left = sum(float((r**2).sum()) for r in self.fitted.residuals(self.presses))
        total = sum(float((press.signal**2).sum()) for press in self.presses.presses)
        return 1.0 - left / total if total > 0 else 0.0


def calibrate(recordings: RecordingSet, wanted: Wanted, seed: int = 0) -> Calibration:
    """Fit.

    Raises:
        ValueError: the recordings cannot identify what is wanted; one line says what to record.
    """
    if recordings.kind != "pad":
        raise ValueError(f'{recordings.path}: calibration needs presses of a pad, not "{recordings.kind}"')
    sound, issues = check_quality(recordings)
    presses = _presses(sound, wanted)
    found = excitation(presses)
    said = problems(found, damping=wanted.damping, stiffness=wanted.stiffness)
    if said:
        raise ValueError(f"{recordings.path} cannot be calibrated from: " + "; ".join(said))
    baseline = fit_baseline(presses)
    if wanted.k_n is not None:
        model = replace(baseline.fitted.model, k_n=wanted.k_n)
        baseline = replace(baseline, fitted=replace(baseline.fitted, model=model))
    fitted, p_value = _with_saturation(baseline, presses, seed)
    draws = _draws(fitted, presses, wanted, seed)
    residual = np.concatenate([values.ravel() for values in fitted.residuals(presses)])
    parameters = _parameters(fitted.model, draws, presses, baseline.noise.floor, wanted)
    return Calibration(
        model=_sensor(fitted.model, presses, baseline.noise.floor, wanted),
        parameters=parameters,
        excitation=found,
        issues=tuple(issues),
        presses=presses,
        fitted=fitted,
        draws=draws,
        rms_counts=float(np.sqrt(np.mean(residual**2))),
        noise_counts=baseline.noise.floor,
        saturation_p=p_value,
    )


def _presses(recordings: RecordingSet, wanted: Wanted) -> PressSet:
    """Usable trials; those that lack what is wanted are left out where others have it."""
    trials = [clean for trial in recordings.trials if (clean := usable(trial)) is not None]
    if wanted.readout_only:
        trials = [replace(trial, depth_m=None) for trial in trials if trial.force_n is not None]
        if not trials:
            raise ValueError(f"{recordings.path}: --readout_only needs force_n, which no recording has")
    deep = [trial for trial in trials if trial.depth_m is not None]
    trials = deep or trials
    if not trials:
        raise ValueError(f"{recordings.path}: no usable recording is left after quality control")
    presses = prepare(recordings, trials, list(range(len(trials))))
    if wanted.static:
        still = tuple(replace(press, rate=np.zeros_like(press.rate)) for press in presses.presses)
        presses = replace(presses, presses=still)
    return presses


def _with_saturation(baseline: Baseline, presses: PressSet, seed: int) -> tuple[Fit, float | None]:
    """The fit with a saturation where it predicts recordings better, else as it is; and the p-value."""
    plain = baseline.fitted
    richer = fit(plain.model.plus(saturation.FORMS[0], np.array([0.3])), presses, baseline.weights)
    if not richer.loss < plain.loss:
        return plain, None
    problem = PadProblem(presses, seed, baseline.weights)
    with_it, without = (out_of_fold(problem, item, problem.folds) for item in (richer, plain))
    p_value = float(one_sided(with_it.better_by(without)[:, None], seed)[0][0])
    if p_value > MAX_P or with_it.gain_over(without) < MIN_GAIN:
        return plain, p_value
    _, weights = weigh(richer, presses)
    return fit(richer.model, presses, weights), p_value


def _draws(fitted: Fit, presses: PressSet, wanted: Wanted, seed: int) -> dict[str, np.ndarray]:
    """Parameters under resampled recordings (DRAWS,).

    Draws are spread by Student's factor, and to the jackknife's deviation where that is larger: with few
    recordings, or few that carry the fit, a plain bootstrap is too sure.
    """
    count, free = len(fitted.grams), fitted.model.free
    rng = np.random.default_rng([seed, 11])
    shares = rng.multinomial(count, np.full(count, 1.0 / count), DRAWS).astype(float)
    drawn = _refitted(fitted, presses, wanted, shares)
    without_one = _refitted(fitted, presses, wanted, 1.0 - np.eye(count))
    best = _refitted(fitted, presses, wanted, np.ones((1, count)))
    freedom = max(count - len(free), 2)
    student = float(stats.t.ppf(0.975, freedom)) / 1.96
    spread = {}
    for name, values in drawn.items():
        jackknife = np.sqrt((count - 1) * np.var(without_one[name]))
        plain = np.sqrt(count / freedom) * np.std(values)
        wider = student * max(plain, jackknife) / max(np.std(values), 1e-300)
        spread[name] = np.maximum(best[name] + wider * (values - best[name]), 0.0)
    return spread


def _refitted(fitted: Fit, presses: PressSet, wanted: Wanted, shares: np.ndarray) -> dict[str, np.ndarray]:
    """Parameters (D,) when recordings count `shares` (D, K) times: one Gauss-Newton step from the fit."""
    model = fitted.model
    grams = np.tensordot(shares, fitted.grams, axes=1)
    values = np.array([bounded_step(model, gram, model.free, 1e-6) for gram in grams])
    found: dict[str, np.ndarray] = {"gain": np.exp(values[:, 0])}
    if not presses.loaded:
        k_n = np.full(len(shares), model.k_n)
        if wanted.stiffness:
            k_n = found["k_n"] = _stiffness(presses, shares, values[:, 1])
        found["gain"] = found["gain"] / k_n
        if wanted.damping:
            found["k_d"] = k_n * values[:, 1]
    for form in model.forms:
        own = values[:, -len(form.values) :].clip(form.low, form.high)
        reports = [form.report(row, model.setting) for row in own]
        found |= {name: np.array([report[name][0] for report in reports]) for name in reports[0]}
    return found


def _stiffness(presses: PressSet, shares: np.ndarray, damping_s: np.ndarray) -> np.ndarray:
    """k_n under which forces add up to the load cell's, for every draw (D,): shares (D, K), damping (D,)."""
    products = np.array(
        [_load_products(press.drive, press.rate, press.trial.force_n) for press in presses.presses]
    )
    load_depth, load_rate, depth2, depth_rate, rate2 = (shares @ products).T
    top = load_depth + damping_s * load_rate
    return top / (depth2 + 2 * damping_s * depth_rate + damping_s**2 * rate2)


def _load_products(drive: np.ndarray, rate: np.ndarray, load: np.ndarray | None) -> Sequence[float]:
    """Inner products over frames of load, summed depth and summed rate of the taxels in contact."""
    if load is None or not np.isfinite(load).all():
        return (0.0,) * 5
    touched = drive > 0
    depth = np.where(touched, drive, 0.0).sum(axis=(1, 2))
    speed = np.where(touched, rate, 0.0).sum(axis=(1, 2))
    return load @ depth, load @ speed, depth @ depth, depth @ speed, speed @ speed


def _parameters(
    model: Composite, draws: dict[str, np.ndarray], presses: PressSet, noise: float, wanted: Wanted
) -> dict[str, Parameter]:
    gain, damping_s = float(np.exp(model.values[0])), float(model.values[1])

    def known(name: str, value: float, unit: str) -> Parameter:
        return Parameter(float(value), interval(draws[name]) if name in draws else None, unit)

    found = {}
    if not presses.loaded:
        found["k_n"] = known("k_n", model.k_n, "N/m")
        found["k_d"] = known("k_d", 0.0 if wanted.static else model.k_n * damping_s, "N*s/m")
    found["gain"] = known("gain", gain if presses.loaded else gain / model.k_n, "counts/N")
    for index, form in enumerate(model.forms):
        for name, (value, unit) in form.report(model.own(index), model.setting).items():
            found[name] = known(name, value, unit)
    found["idle_mean"] = Parameter(float(presses.idle.level.mean()), None, "counts")
    found["noise_sigma"] = Parameter(float(noise), None, "counts")
    return found


def _sensor(model: Composite, presses: PressSet, noise: float, wanted: Wanted) -> SensorModel:
    """The model that simulation and prediction load, noise at rest included."""
    if wanted.static:
        model = model.at(np.array([model.values[0], 0.0, *model.values[2:]]))
    sensor = sensor_model(model, presses.idle, presses.step_counts)
    sensor = sensor.with_stage(NoiseStage(round(float(noise), 4))).with_stage(_idle(presses))
    return sensor.with_stage(_contact(sensor.contact, presses, wanted))


def fits_the_simulation(presses: PressSet) -> bool:
    """Whether the idle map can be laid over the simulator's pads: one value, or their lattice."""
    shape = presses.layout.rows, presses.layout.cols
    return shape in ((1, 1), (PadLayout.rows, PadLayout.cols))


def _idle(presses: PressSet) -> Idle:
    """The idle map; of a pad of another shape its mean and spread (uniform, of the same deviation)."""
    level = presses.idle.level
    if fits_the_simulation(presses):
        return Idle(level.tolist(), 0.0)
    return Idle(float(level.mean()), float(np.sqrt(3.0) * level.std()))


def _contact(contact: ContactStage, presses: PressSet, wanted: Wanted) -> ContactStage:
    """The paper's stage, or the foundation that equals it under prescribed depths."""
    if presses.loaded:
        return Consistent()  # the load is the solver's: only the readout was fitted
    if wanted.contact == "kelvin_voigt":
        return contact
    k_n = float(contact.stiffness(presses.layout))
    return Consistent(k_n / presses.layout.taxel_area_m2, getattr(contact, "k_d", 0.0) / k_n)
