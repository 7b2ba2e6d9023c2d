"""The method on a toy instrument: channels that are polynomials of a drive, none of which the core knows."""

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.core.engine import guarded, infer
from lerobot_vtrefine.diagnose.core.heldout import lock
from lerobot_vtrefine.diagnose.core.problem import OptionalSteps, PlainCandidate
from lerobot_vtrefine.diagnose.core.resampling import (
    Hypothesis,
    folds_of,
    jackknife,
    jointly_adjusted,
    one_sided,
)
from lerobot_vtrefine.diagnose.core.rivals import Rival, adopt, if_tied
from lerobot_vtrefine.diagnose.core.search import ALL
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion, raise_alarms

TRIALS, FRAMES = 24, 60
CONDITIONS = tuple(f"c{k // 2}" for k in range(TRIALS))


@dataclass(frozen=True)
class Fit:
    free: np.ndarray
    """(J, K) bool"""
    theta: np.ndarray
    mse: np.ndarray


@dataclass(frozen=True)
class Refits:
    problem: "Toy"
    free: np.ndarray
    channels: np.ndarray

    def errors(self, weights, trials):
        return self.problem.mse(self.problem.solved(self.free, weights))[trials][:, self.channels]


@dataclass(frozen=True)
class Toy(OptionalSteps):
    """y (T, N, J) against x (T, N): the baseline is a line, candidates add columns."""

    x: np.ndarray
    y: np.ndarray
    conditions: tuple[str, ...]
    found: tuple[Suspicion, ...] = ()
    offered: tuple[PlainCandidate, ...] = (PlainCandidate("1"), PlainCandidate("2"), PlainCandidate("3"))
    subject: str = "toy"

    @property
    def channels(self):
        return tuple(f"y{k}" for k in range(self.y.shape[2]))

    @property
    def files(self):
        return tuple(str(k) for k in range(len(self.x)))

    def columns(self):
        """x, then the candidates': |x|, x^2 and exp(x)."""
        return np.stack([self.x, np.abs(self.x), self.x**2, np.exp(self.x)], -1)

    def subset(self, trials):
        conditions = tuple(self.conditions[k] for k in trials)
        return replace(self, x=self.x[trials], y=self.y[trials], conditions=conditions)

    def solved(self, free, weights):
        z, out = self.columns(), np.zeros(free.shape)
        for channel, own in enumerate(free):
            root = np.sqrt(weights)[:, None]
            design = (root[..., None] * z[..., own]).reshape(-1, own.sum())
            out[channel, own] = np.linalg.lstsq(design, (root * self.y[..., channel]).ravel(), rcond=None)[0]
        return out

    def mse(self, theta):
        return np.square(self.y - self.columns() @ theta.T).mean(1)

    def fit(self, free):
        theta = self.solved(free, np.ones(len(self.x)))
        return Fit(free, theta, self.mse(theta))

    def baseline(self):
        return self.fit(np.arange(4) == np.zeros((self.y.shape[2], 1)))

    def candidates(self):
        return self.offered

    def own(self, candidate, channels):
        return (np.arange(4) == int(candidate.cause)) & (channels | candidate.shared)[:, None]

    def applicable(self, candidate, now):
        return ~now.free[:, int(candidate.cause)]

    def extended(self, now, candidate, channels, plainer=None):
        return self.fit(now.free | self.own(candidate, channels))

    def reduced(self, now, candidates, channels):
        gone = np.any([self.own(item, channels) for item in candidates], axis=0)
        return self.fit(now.free & ~gone)

    def refitted(self, now):
        return self.fit(now.free)

    def merged(self, one, other, take_other):
        return self.fit(np.where(take_other[:, None], other.free, one.free))

    def errors(self, fit):
        return self.mse(fit.theta)

    def reweighted(self, fit, channels=None):
        return Refits(self, fit.free, np.arange(len(fit.free)) if channels is None else channels)

    def credible(self, baseline, now, best, candidate):
        return np.ones(self.y.shape[2], dtype=bool)

    def suspicions(self, selection, seed):
        return self.found


def toy(seed=0, effects=(0.0, 0.0), **changes):
    """Two lines, the k-th with so much of |x| in it; trials have a scale of their own."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (TRIALS, FRAMES))
    y = x[..., None] * (1 + 0.01 * rng.normal(size=(TRIALS, 1, 2))) + np.abs(x)[..., None] * np.array(effects)
    return replace(Toy(x, y + 0.1 * rng.normal(size=y.shape), CONDITIONS), **changes)


def names(found):
    return {channel: [item.cause for item in items] for channel, items in found.selection.chosen.items()}


def test_what_acts_is_found_where_it_acts_and_nothing_else() -> None:
    found = infer(toy(effects=(0.0, 0.3)))
    assert names(found) == {1: ["1"]}
    assert found.selection.p_value("1") < 0.02
    assert found.selection.fit.theta[1, 1] == pytest.approx(0.3, abs=0.02)
    assert found.locked
    assert not found.alarms
    assert names(infer(toy())) == {}


def test_what_all_channels_share_is_one_hypothesis() -> None:
    offered = (PlainCandidate("1", shared=True), PlainCandidate("2"))
    found = infer(toy(effects=(0.2, 0.2), offered=offered))
    assert names(found) == {ALL: ["1"]}
    assert found.selection.causes() == {"1": (0, 1)}


def test_a_decoy_is_an_alarm_and_never_handed_out() -> None:
    offered = (PlainCandidate("1", clue="as the size of x"), PlainCandidate("2"))
    found = infer(toy(effects=(0.0, 0.3), offered=offered))
    assert [(alarm.channel, alarm.clue) for alarm in found.alarms] == [(1, "as the size of x")]
    assert "1" not in found.selection.causes()
    assert found.selection.fit.theta[1, 1] == 0.0


class Lost(Toy):
    """Refitting without what was taken back ends in another optimum."""

    def reduced(self, now, candidates, channels):
        fitted = super().reduced(now, candidates, channels)
        return replace(fitted, theta=fitted.theta + np.where(channels, 1.0, 0.0)[:, None])


def test_what_lost_its_only_name_predicts_as_the_baseline() -> None:
    """It was handed out as the extended model, and erred ten times as much."""
    offered = (PlainCandidate("1", clue="as the size of x"), PlainCandidate("2"))
    sound = toy(effects=(0.0, 0.3), offered=offered)
    found = infer(Lost(**{field.name: getattr(sound, field.name) for field in fields(sound)}))
    assert [alarm.channel for alarm in found.alarms] == [1]
    before, after = (
        found.test.errors(fit).mean(0) for fit in (found.selection.baseline, found.selection.fit)
    )
    np.testing.assert_allclose(after, before)


def beyond_discovery():
    """A bump that exp(x) imitates in discovery, and locked trials far beyond, where it explodes."""
    problem = toy(offered=(PlainCandidate("3"),))
    x, y = problem.x.copy(), problem.y.copy()
    x[lock(CONDITIONS, 0)] *= 12
    y[..., 1] = x + 0.4 * np.exp(np.minimum(x, 1.0)) + 0.1 * np.random.default_rng(1).normal(size=x.shape)
    y[..., 0] = x + 0.1 * np.random.default_rng(2).normal(size=x.shape)
    return replace(problem, x=x, y=y)


def test_a_model_worse_than_the_baseline_on_locked_trials_is_not_handed_out() -> None:
    found = infer(beyond_discovery())
    tried = next(item for item in found.selection.first_round if item.cause == "3")
    assert tried.accepted[1]  # cross-validation alone chose it
    assert names(found) == {}
    before, after = (
        found.test.errors(fit).mean(0) for fit in (found.selection.baseline, found.selection.fit)
    )
    np.testing.assert_allclose(after, before)
    (refused,) = found.refused
    assert (refused.cause, refused.channel, refused.surely) == ("3", 1, True)
    assert refused.gain < -1.0
    # What is significant and yet predicts worse is something else than its name.
    assert [alarm.channel for alarm in found.alarms] == [1]
    assert "worse" in found.alarms[0].clue


def test_what_is_shared_goes_where_it_makes_the_whole_error_larger() -> None:
    problem = toy(effects=(0.3, 0.3), offered=(PlainCandidate("1", shared=True),))
    selection = infer(problem).selection
    assert names(infer(problem)) == {ALL: ["1"]}
    # New trials in which it helps a small error much, and makes a large one larger.
    rng = np.random.default_rng(3)
    bent = np.abs(problem.x)[..., None] * np.array([-0.3, 0.3])
    y = problem.x[..., None] + bent + np.array([2.0, 0.1]) * rng.normal(size=problem.y.shape)
    kept, refused = guarded(selection, replace(problem, y=y), 0)
    assert kept.chosen == {}
    assert [(item.cause, item.channel) for item in refused] == [("1", ALL)]


@pytest.mark.parametrize("shared", [False, True])
def test_a_rival_that_is_adopted_has_the_p_value_of_what_it_replaces(shared: bool) -> None:
    selection = infer(toy(effects=(0.0, 0.3))).selection
    (known,) = selection.p_values.values()
    other = PlainCandidate("2", shared=shared)
    rival = Rival("1", other, (1,), shared, 0.5, selection.fit, selection.errors)
    found = adopt(selection, rival)
    assert found.p_values == {("2", ALL if shared else 1): known}
    back = Rival("2", PlainCandidate("1"), (1,), shared, 0.5, selection.fit, selection.errors)
    assert adopt(found, back).p_values == {("1", 1): known}


def test_a_tie_ends_where_the_gain_falls_short_surely() -> None:
    """Not where a trial or two that count most make it short."""
    selection = infer(toy(effects=(0.0, 0.3))).selection
    without, now = np.ones((9, 1)), np.full((9, 1), 0.3)
    by_accident = now + np.where(np.arange(9) % 2, 0.01, -0.01)[:, None]
    by_accident[0] += 1.0
    # Five trials count and all say so; what the small ones say in parts of their errors is the contrary.
    surely = now + np.array([0.2] * 5 + [0.0] * 4)[:, None]
    now_small, small = (
        np.where(np.arange(9)[:, None] < 5, errors, tiny) for errors, tiny in ((now, 0.01), (surely, 0.001))
    )
    for errors, other, tied in ((now, by_accident, True), (now_small, small, False)):
        rival = Rival("1", PlainCandidate("2"), (0,), False, 0.0, selection.fit, other)
        assert bool(if_tied(rival, errors, without, seed=0)) is tied


def test_the_guard_leaves_other_channels_alone() -> None:
    problem = beyond_discovery()
    y = problem.y.copy()
    y[..., 0] += 0.3 * np.abs(problem.x)
    offered = (PlainCandidate("1"), PlainCandidate("3"))
    assert names(infer(replace(problem, y=y, offered=offered)))[0] == ["1"]


CHAIN = np.eye(18, k=1)
PLACE = (np.arange(18) - 8.5) / np.arange(18).std()


def of_all_kinds(rng: np.random.Generator) -> list[Suspicion]:
    """Forty suspicions of which none holds: signs, orders, neighbours, and scores that few trials carry."""
    found = []
    for k, row in enumerate(rng.standard_t(3, (40, 18))):
        along = (None, PLACE, None, CHAIN)[k % 4]
        # A trial's score scatters as its own size; the last kind of three trials only.
        size = np.where(np.arange(18) < 3, 1.0, 1e-3) if k % 4 == 2 else np.ones(18)
        scatter = float(np.sqrt(3.0 * np.square(size).sum()))
        found.append(Suspicion(0, "", 1.0, 0.1, row * size, along is not CHAIN, along, scatter))
    return found


def test_suspicions_have_one_error_rate() -> None:
    rng, alarms = np.random.default_rng(0), 0
    selection = infer(toy()).selection
    for number in range(40):
        alarms += bool(raise_alarms(selection, of_all_kinds(rng), number))
    assert alarms <= 3  # of 40 sets with forty suspicions each, at one in a hundred: one time in a thousand


def test_a_sum_that_few_trials_dominate_tells_where_all_trials_agree() -> None:
    # Its largest possible value is that of three equal trials, which sums of many pass by accident.
    rng = np.random.default_rng(5)
    many = [Hypothesis(row, either_sign=True) for row in rng.normal(size=(30, 18))]
    agreeing = np.where(np.arange(18) < 6, 1.0, 0.1) * rng.uniform(0.8, 1.2, 18)
    split = agreeing * np.where(np.arange(18) == 0, -1.0, 1.0)
    assert jointly_adjusted([*many, Hypothesis(agreeing, either_sign=True)], 0)[-1] < 0.01
    assert jointly_adjusted([*many, Hypothesis(split, either_sign=True)], 0)[-1] > 0.05


@pytest.mark.parametrize(("trials", "size", "told"), [(4, 15.0, True), (4, 4.0, False), (18, 15.0, False)])
def test_where_few_trials_carry_a_sum_its_size_tells(trials: int, size: float, told: bool) -> None:
    rng = np.random.default_rng(6)
    many = [Hypothesis(row, either_sign=True) for row in rng.normal(size=(30, 18))]
    scores = np.where(np.arange(18) < trials, 1.0, 0.0)
    # As many trials as there are have signs: these decide, whatever the noise should be.
    scores[: trials // 3] *= -1.0
    hypothesis = Hypothesis(scores, either_sign=True, scatter=abs(float(scores.sum())) / size)
    assert bool(jointly_adjusted([*many, hypothesis], 0)[-1] < 0.01) is told


def test_suspicions_that_hold_are_told_and_what_was_observed_has_no_p_value() -> None:
    selection = infer(toy()).selection
    rng = np.random.default_rng(3)
    place = (np.arange(18) - 8.5) / np.arange(18).std()
    found = [
        Suspicion(0, "one way", 0.5, 0.1, 1 + 0.3 * rng.normal(size=18)),
        Suspicion(0, "follows the order", 0.4, 0.1, place + 0.3 * rng.normal(size=18), True, place),
        Suspicion(0, "too small", 0.05, 0.1, 1 + 0.3 * rng.normal(size=18)),
        Suspicion(0, "the other way", 0.5, 0.1, -1 + 0.3 * rng.normal(size=18)),
        Suspicion(1, "seen", 0.9, 0.5),
    ]
    alarms = raise_alarms(selection, found, 0)
    assert [alarm.clue for alarm in alarms] == ["seen", "one way", "follows the order"]
    assert alarms[0].p_value is None
    assert all(alarm.p_value is not None and alarm.p_value < 0.01 for alarm in alarms[1:])


def test_decisive_suspicions_silence_others_of_their_channel() -> None:
    selection = infer(toy()).selection
    found = [
        Suspicion(0, "a", 0.9, 0.1),
        Suspicion(0, "b", 0.2, 0.1, decisive=True),
        Suspicion(1, "c", 0.3, 0.1),
    ]
    assert [alarm.clue for alarm in raise_alarms(selection, found, 0)] == ["b", "c"]


def test_flips_are_exact_where_trials_are_few() -> None:
    alone, adjusted = one_sided(np.array([[1.0, -1.0], [1.0, 1.0], [1.0, 1.0], [1.0, -1.0]]), 0)
    np.testing.assert_allclose(alone, [1 / 16, 11 / 16])
    assert adjusted[0] >= alone[0]
    few = jointly_adjusted([Hypothesis(np.ones(5))], 0)
    assert few[0] == pytest.approx(1 / 32, abs=0.01)


def test_folds_keep_conditions_together_and_the_jackknife_is_students() -> None:
    folds = folds_of(CONDITIONS, 0)
    assert all(len({folds[k] for k in range(TRIALS) if CONDITIONS[k] == name}) == 1 for name in CONDITIONS)
    values = np.random.default_rng(0).normal(size=200)
    without = (values.sum() - values) / 199
    low, high = jackknife(without, values.mean())
    half = 1.97 * values.std(ddof=1) / np.sqrt(200)
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), rel=0.02, abs=0.003)
