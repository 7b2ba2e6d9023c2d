"""The method where a score test comes before fits, on a toy instrument of one channel."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.core import memory
from lerobot_vtrefine.diagnose.core.engine import guarded, infer
from lerobot_vtrefine.diagnose.core.heldout import OutOfFold
from lerobot_vtrefine.diagnose.core.preference import better, clearly_better, few_suffice, preferable
from lerobot_vtrefine.diagnose.core.problem import OptionalSteps, PlainCandidate, Promise
from lerobot_vtrefine.diagnose.core.rivals import settled
from lerobot_vtrefine.diagnose.core.score_test import Probe, cleared, screen
from lerobot_vtrefine.diagnose.core.screened_rivals import rivals_seen_twice, screened_rivals, tied
from lerobot_vtrefine.diagnose.core.screened_search import ScreenedSearch, still_found

TRIALS, FRAMES, NOISE, COLUMNS = 24, 60, 0.1, 5
CONDITIONS = tuple(f"c{k // 2}" for k in range(TRIALS))


@dataclass(frozen=True)
class Form(PlainCandidate):
    column: int = 1
    terms: int = 1
    peer: bool = False
    disturbs: bool = False
    others: tuple["Form", ...] = ()


@dataclass(frozen=True)
class Fit:
    free: tuple[int, ...]
    theta: np.ndarray
    mse: np.ndarray
    told: bool = True
    """Whether users get what was found."""

    @property
    def scores(self):
        return -0.5 * FRAMES * self.mse / NOISE**2


@dataclass(frozen=True)
class Refits:
    problem: "Toy"
    fit: Fit

    def errors(self, weights, trials):
        return self.problem.mse(self.problem.solved(self.fit.free, weights))[trials]

    def log_scores(self, weights, trials):
        return -0.5 * FRAMES * self.errors(weights, trials) / NOISE**2


@dataclass(frozen=True)
class Toy(OptionalSteps):
    """y (T, N) against x (T, N): the baseline is a line, candidates add columns."""

    x: np.ndarray
    y: np.ndarray
    conditions: tuple[str, ...] = CONDITIONS
    offered: tuple[Form, ...] = (Form("bend", column=1), Form("square", column=2))
    seen: str = ""
    subject: str = "toy"
    channels: tuple[str, ...] = ("y",)
    screens: bool = True
    further_gain: float = 0.025
    in_nats: bool = True
    scatter: float = 0.0

    @property
    def files(self):
        return tuple(str(k) for k in range(len(self.x)))

    def columns(self):
        """x, |x|, x^2, nearly |x| again, and x^4."""
        x = self.x
        return np.stack([x, np.abs(x), x**2, np.sqrt(x**2 + 1e-3), x**4], -1)

    def subset(self, trials):
        conditions = tuple(self.conditions[k] for k in trials)
        return replace(self, x=self.x[trials], y=self.y[trials], conditions=conditions)

    def solved(self, free, weights):
        theta = np.zeros(COLUMNS)
        root = np.sqrt(weights)[:, None]
        design = (root[..., None] * self.columns()[..., list(free)]).reshape(-1, len(free))
        theta[list(free)] = np.linalg.lstsq(design, (root * self.y).ravel(), rcond=None)[0]
        return theta

    def mse(self, theta):
        return np.square(self.y - self.columns() @ theta).mean(1, keepdims=True)

    def fit(self, free):
        theta = self.solved(free, np.ones(len(self.x)))
        return Fit(tuple(free), theta, self.mse(theta))

    def baseline(self):
        return self.fit((0,))

    def weighed(self, now):
        return self, now or self.baseline()

    def unweighed(self, now):
        return self, now

    def far_off(self, now):
        return False

    def screened(self, now, only=None):
        z, left, probes = self.columns(), self.y - self.columns() @ now.theta, []
        offered = [item for item in self.offered if item.column not in now.free]
        for item in offered:
            vectors = np.stack([*(z[..., k] for k in now.free), z[..., item.column], left], -1)
            scores, information = cleared(np.einsum("tni,tnj->tij", vectors, vectors))
            observed = item.cause == self.seen
            probes.append(Probe(item.cause, item, np.ones(1), scores, information, False, observed=observed))
        tests = screen(probes, len(self.x), 0)
        wanted = [item for item in offered if only is None or item.cause in only]
        return [Promise(item, tests[item.cause]) for item in wanted]

    def refinements(self, candidate):
        return candidate.others

    def extended(self, now, candidate, channels, plainer=None):
        return self.fit((*now.free, candidate.column))

    def refitted(self, now):
        return now

    def reduced(self, now, candidates, channels):
        return self.fit([k for k in now.free if k not in [item.column for item in candidates]])

    def errors(self, fit):
        return self.mse(fit.theta)

    def reweighted(self, fit):
        return Refits(self, fit)

    def credible(self, baseline, now, best, candidate):
        return np.ones(1, dtype=bool)

    def without_effect(self, fit, baseline):
        seen = [item.column for item in self.offered if item.cause == self.seen]
        kept = np.where(np.isin(np.arange(COLUMNS), seen), fit.theta, baseline.theta)
        return replace(fit, theta=kept, told=False)

    def log_scores(self, fit):
        """Trials have gains of their own, which log scores allow for."""
        left = self.y - self.columns() @ fit.theta
        shared = self.scatter**2 / (NOISE**2 + self.scatter**2 * np.square(self.x).sum(1))
        return -0.5 * (np.square(left).sum(1) - shared * (left * self.x).sum(1) ** 2) / NOISE**2


@dataclass(frozen=True)
class Unseeing(Toy):
    """Weights forgive what is seen."""

    even: bool = False

    def extended(self, now, candidate, channels, plainer=None):
        if candidate.cause == self.seen and not self.even:
            return now
        return super().extended(now, candidate, channels, plainer)

    def unweighed(self, now):
        return replace(self, even=True), now


def toy(effect=0.0, seed=0, **changes):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (TRIALS, FRAMES))
    return replace(Toy(x, x + effect * np.abs(x) + NOISE * rng.normal(size=x.shape)), **changes)


def names_of(selection):
    return [item.cause for items in selection.chosen.values() for item in items]


def names(found):
    return names_of(found.selection)


def test_what_acts_is_found_and_nothing_else() -> None:
    found = infer(toy(0.3))
    assert names(found) == ["bend"]
    assert found.selection.p_value("bend") < 0.02
    assert found.selection.fit.theta[1] == pytest.approx(0.3, abs=0.02)
    assert found.selection.examined["square"].p_adjusted is not None
    assert not found.rivals
    assert names(infer(toy())) == []


def test_what_predicts_too_little_is_not_accepted_however_sure_it_is() -> None:
    # 0.03 in 0.1 of noise: 0.7 % of the error, in 1440 readings.
    found = infer(toy(0.03))
    assert found.selection.examined["bend"].p_adjusted < 0.05
    assert names(found) == []


def test_what_is_seen_needs_no_test() -> None:
    found = infer(toy(0.3, seen="bend"))
    assert names(found) == ["bend"]
    assert found.selection.observed("bend")
    assert found.selection.p_value("bend") is None


def test_what_is_seen_comes_before_what_imitates_it() -> None:
    plain, accepted = toy(0.3), []

    class Telling(ScreenedSearch):
        def _accepted(self, step, found):
            accepted.append(step.candidate.cause)
            return super()._accepted(step, found)

    Telling(Unseeing(plain.x, plain.y, seen="bend"), 0, lambda text: None).run()
    assert accepted == ["bend"]


class Contrary(ScreenedSearch):
    """Beside a square nothing else stands under its own weights."""

    def _stands(self, problem, fitted, candidate):
        return "square" not in {item.cause for item in self.chosen}


@pytest.mark.parametrize(("acting", "expected"), [([1, 4], ["bend", "quartic"]), ([2], ["square"])])
def test_what_contradicts_the_first_name_leads_to_the_next_best_where_that_predicts_better(
    acting: list[int], expected: list[str]
) -> None:
    offered = (Form("bend", column=1), Form("square", column=2), Form("quartic", column=4))
    plain = toy(offered=offered)
    problem = replace(plain, y=plain.y + 0.5 * plain.columns()[..., acting].sum(-1))
    search = Contrary(problem, 0, lambda text: None)
    assert sorted(names_of(search.run())) == expected


def test_look_alikes_tie_and_others_do_not() -> None:
    offered = (Form("bend", column=1), Form("square", column=2), Form("round", column=3))
    found = infer(toy(0.15, offered=offered))
    assert len(names(found)) == 1
    assert {names(found)[0], *(rival.name for rival in found.rivals)} == {"bend", "round"}


@dataclass(frozen=True)
class Elsewhere(Toy):
    """The fifth column is odd, and scores see forms beyond the plain ones."""

    def columns(self):
        return np.concatenate([super().columns()[..., :4], self.x[..., None] ** 3], -1)

    def screened(self, now, only=None):
        return [replace(item, refine=bool(item.candidate.others)) for item in super().screened(now, only)]


def test_a_rival_is_tried_in_the_form_that_scores_see_however_little_its_plain_one_gains() -> None:
    plain, named = toy(0.15), Form("bend", column=1)
    offered = (named, Form("round", column=4, others=(Form("round", column=3),)))
    problem = Elsewhere(plain.x, plain.y, offered=offered)
    selection = replace(
        ScreenedSearch(problem, 0, lambda text: None).run(),
        fit=problem.fit((0, 1)),
        chosen={0: (named,)},
        alternatives={"bend": frozenset({"round"})},
    )
    (rival,) = screened_rivals(selection, 0)
    assert rival.candidate.column == 3


def test_rivals_are_fitted_to_all_frames_where_they_tie_on_those_that_were_searched() -> None:
    @dataclass(frozen=True)
    class Asked(Toy):
        asked: list[str] = field(default_factory=list, compare=False)

        def extended(self, now, candidate, channels, plainer=None):
            self.asked.append(candidate.cause)
            return super().extended(now, candidate, channels, plainer)

    named = Form("bend", column=1)
    some = toy(0.15, offered=(named, Form("square", column=2), Form("round", column=3)))
    searched = replace(
        ScreenedSearch(some, 0, lambda text: None).run(),
        fit=some.fit((0, 1)),
        chosen={0: (named,)},
        alternatives={"bend": frozenset({"square", "round"})},
    )
    whole = Asked(some.x, some.y, offered=some.offered)
    (rival,) = rivals_seen_twice(replace(searched, problem=whole), searched, 0)
    assert rival.name == "round"
    assert whole.asked == ["round"]


@pytest.mark.parametrize(("lead", "told"), [(0.1, False), (1.0, True)])
def test_laws_that_trials_tell_apart_at_small_odds_tie(lead: float, told: bool) -> None:
    errors, scores = np.ones((TRIALS, 1)), np.zeros((TRIALS, 1))
    likelier = scores + lead + 0.01 * np.arange(TRIALS)[:, None] / TRIALS
    assert tied(OutOfFold(errors, lambda: likelier), OutOfFold(errors + 1e-4, lambda: scores), 0) is not told


@pytest.mark.parametrize(
    ("worse", "lead", "stands"), [(0.0, 0.1, True), (0.05, 0.1, False), (0.05, 3.0, True)]
)
def test_a_form_that_is_no_richer_stands_where_it_is_surely_likelier(
    worse: float, lead: float, stands: bool
) -> None:
    # Plain errors hang on where each trial happened to touch; log scores allow for that.
    rng = np.random.default_rng(4)
    errors, scores = np.ones((TRIALS, 1)), rng.normal(lead, 1.0, (TRIALS, 1))
    scores += lead - scores.mean()
    held, than = OutOfFold(errors + worse, lambda: scores), OutOfFold(errors, lambda: np.zeros((TRIALS, 1)))
    assert preferable(Form("late", peer=True), held, than, 0) is stands


def test_a_plain_form_does_until_another_is_clearly_better() -> None:
    other = Form("curve", column=1)
    offered = (Form("curve", column=2, others=(other,)),)
    assert infer(toy(0.5, offered=offered)).selection.chosen[0] == (other,)
    plain = (Form("curve", column=1, others=(Form("curve", column=3),)),)
    assert infer(toy(0.5, offered=plain)).selection.chosen[0] == plain


def test_names_stay_where_locked_trials_leave_it_open_and_the_model_goes() -> None:
    problem = toy(0.1)
    selection = ScreenedSearch(problem, 0, lambda text: None).run()
    assert names_of(selection) == ["bend"]
    # Fresh trials of the baseline with little of the effect: worse in some, and in others not.
    rng = np.random.default_rng(5)
    x = rng.uniform(-1, 1, (6, FRAMES))
    size = np.array([0.1, 0.1, 0.1, -0.1, -0.1, -0.1])[:, None]
    mixed = replace(
        problem, x=x, y=x + size * np.abs(x) + NOISE * rng.normal(size=x.shape), conditions=CONDITIONS[:6]
    )
    kept, refused = guarded(selection, mixed, 0)
    assert names_of(kept) == ["bend"]
    assert not refused
    assert not kept.fit.told
    # Where the opposite is sure, the name goes as well.
    against = replace(mixed, y=x - 0.3 * np.abs(x) + NOISE * rng.normal(size=x.shape))
    gone, refused = guarded(selection, against, 0)
    assert names_of(gone) == []
    assert [item.surely for item in refused] == [True]


def test_what_was_seen_stays_and_what_was_inferred_must_predict_better_than_it_does_alone() -> None:
    trials = toy(0.3, seen="bend")
    problem = replace(trials, y=trials.y + 0.3 * trials.x**2)
    selection = ScreenedSearch(problem, 0, lambda text: None).run()
    assert sorted(names_of(selection)) == ["bend", "square"]
    # The baseline alone is worse by far than both, and what was seen is right without the other.
    x = np.random.default_rng(5).uniform(-1, 1, (6, FRAMES))
    y = x + 0.4 * np.abs(x) - 0.05 * x**2 + 0.01 * np.random.default_rng(6).normal(size=x.shape)
    locked = replace(problem, x=x, y=y, conditions=CONDITIONS[:6])
    plain, both = (locked.errors(fit).mean() for fit in (selection.baseline, selection.fit))
    assert both < 0.7 * plain
    kept, refused = guarded(selection, locked, 0)
    assert names_of(kept) == ["bend"]
    assert [(item.cause, item.surely) for item in refused] == [("square", True)]
    # It stays whatever locked trials say of what was fitted to it.
    alone = replace(kept, fit=problem.fit((0, 1)))
    steep = replace(locked, y=1.2 * x + 0.3 * np.abs(x))
    for trials, told in ((locked, True), (steep, False)):
        kept, refused = guarded(alone, trials, 0)
        assert names_of(kept) == ["bend"]
        assert not refused
        assert kept.fit.told is told


def locked_gains(problem: Toy, low: float) -> Toy:
    """Half of the locked trials have a gain that is too low, which the effect would make up for."""
    rng = np.random.default_rng(5)
    x = rng.uniform(-0.3, 1, (6, FRAMES))
    gain = np.array([low, low, low, 1.02, 1.02, 1.02])[:, None]
    y = gain * x + 0.1 * np.abs(x) + 0.01 * rng.normal(size=x.shape)
    return replace(problem, x=x, y=y, conditions=CONDITIONS[:6], scatter=0.1)


def test_the_model_stays_where_the_gains_of_locked_trials_make_it_hardly_worse() -> None:
    problem = toy(0.1)
    selection = ScreenedSearch(problem, 0, lambda text: None).run()
    locked = locked_gains(problem, 0.8828)
    before, after = (locked.errors(fit).mean() for fit in (selection.baseline, selection.fit))
    assert before < after < 1.01 * before
    assert guarded(selection, locked, 0)[0].fit.told
    assert not guarded(selection, locked, 0)[0].withheld
    refused = guarded(selection, replace(locked, scatter=0.0), 0)[0]
    assert not refused.fit.told
    assert refused.withheld


def test_a_model_that_is_surely_worse_is_not_handed_out_whatever_log_scores_say() -> None:
    problem = toy(0.1)
    selection = ScreenedSearch(problem, 0, lambda text: None).run()
    locked = locked_gains(problem, 0.87)
    scores = [locked.log_scores(fit).sum() for fit in (selection.baseline, selection.fit)]
    assert scores[1] > scores[0]
    assert guarded(selection, locked, 0)[0].fit.told
    worse = replace(locked, x=locked.x[:3], y=locked.y[:3], conditions=locked.conditions[:3])
    scores = [worse.log_scores(fit).sum() for fit in (selection.baseline, selection.fit)]
    assert scores[1] > scores[0]
    gone, refused = guarded(selection, worse, 0)
    assert names_of(gone) == []
    assert [item.surely for item in refused] == [True]


@dataclass(frozen=True)
class Refitting(Toy):
    """Users get fits to all trials."""

    def completed(self, selection):
        return self.baseline(), self.fit(selection.fit.free)


def test_users_may_get_a_refit_to_all_trials_and_what_is_measured_stays_with_the_fit_from_before() -> None:
    measured = infer(toy(0.3))
    assert not measured.refitted
    assert measured.models[1] is measured.selection.fit
    problem = Refitting(**vars(toy(0.3)))
    found = infer(problem)
    assert found.refitted
    np.testing.assert_array_equal(found.models[1].theta, problem.solved((0, 1), np.ones(TRIALS)))
    np.testing.assert_array_equal(found.selection.fit.theta, measured.selection.fit.theta)
    assert abs(found.models[1].theta - measured.selection.fit.theta).max() > 0


def test_where_few_pairs_of_trials_have_a_say_the_size_of_their_products_counts() -> None:
    # Of five pairs, whatever their products, no flip of signs is rarer than one in 32.
    def passes(size, pairs):
        products = np.zeros((TRIALS, TRIALS))
        for k in range(pairs):
            products[2 * k, 2 * k + 1] = products[2 * k + 1, 2 * k] = size
        total, one = np.array([products.sum()]), np.ones(TRIALS)
        own = {"products": products, "products_scatter": np.sqrt(2.0 * pairs)}
        probe = Probe("map", None, np.zeros(0), total, total, True, **own)
        nothing = Probe("bend", None, np.zeros(0), one * (-1.0) ** np.arange(TRIALS), one, False)
        return screen([probe, nothing], TRIALS, 0)["map"].passed

    assert passes(20.0, 5)
    assert not passes(2.0, 5)
    assert passes(2.0, 12)


def guesses() -> list[Probe]:
    """Twenty that are nothing."""
    rng = np.random.default_rng(3)
    return [
        Probe(str(k), None, np.zeros(0), rng.standard_normal(TRIALS), np.ones(TRIALS), False)
        for k in range(20)
    ]


def test_where_few_of_many_trials_have_a_say_the_size_of_their_scores_counts() -> None:
    # Whatever the others say, seven large scores agree in one flip of 64: too often among twenty guesses.
    def passes(size, telling, agreeing=TRIALS, beside=(), sized=True):
        scores = np.where(np.arange(TRIALS) < telling, size, 0.01 * (-1.0) ** np.arange(TRIALS))
        scores[agreeing:telling] *= -1.0
        bend = Probe("bend", None, np.zeros(0), scores, np.abs(scores), False)
        return screen([bend, *guesses(), *beside], TRIALS, 0, sized=sized)["bend"].passed

    assert passes(50.0, 7)
    assert not passes(50.0, 7, sized=False)
    assert not passes(50.0, 7, agreeing=6)
    assert not passes(50.0, 4)
    assert not passes(2.0, 7)
    # Signs come first.
    assert not passes(
        50.0, 7, beside=[Probe("tilt", None, np.zeros(0), np.ones(TRIALS), np.ones(TRIALS), False)]
    )
    assert passes(2.0, 12)


def test_once_something_passes_by_size_what_else_few_trials_carry_may_be_it() -> None:
    # A skew of the scan beside late readings: signs of the trials that show both cannot tell them apart.
    def bend(name, agreeing):
        scores = np.where(np.arange(TRIALS) < 7, 50.0, 0.01 * (-1.0) ** np.arange(TRIALS))
        scores[agreeing:7] *= -1.0
        return Probe(name, None, np.zeros(0), scores, np.abs(scores), False)

    def passed(*probes):
        return {name for name, item in screen([*probes, *guesses()], TRIALS, 0).items() if item.passed}

    assert passed(bend("skew", 6)) == set()
    assert passed(bend("late", 7), bend("skew", 6)) == {"late", "skew"}
    assert passed(bend("late", 7), bend("skew", 6), bend("none", 4)) == {"late", "skew"}


@dataclass(frozen=True)
class Forgiving(Toy):
    """Weights forgive what is there where all readings count alike."""

    calm: np.ndarray | None = None
    loud: np.ndarray | None = None

    def weighed(self, now):
        other = replace(self, y=self.calm)
        return other, other.fit(now.free if now else (0,))

    def unweighed(self, now):
        other = replace(self, y=self.loud)
        return other, other.fit(now.free)

    def far_off(self, now):
        return True


def test_what_weights_forgive_is_no_cause() -> None:
    # Where nothing is left, a needless term still predicts trials left out better by chance, now and then.
    kept = 0
    for seed in range(10):
        calm, loud = toy(seed=seed), toy(0.3, seed=seed)
        assert ScreenedSearch(loud, 0, lambda text: None).run().chosen
        forgiving = Forgiving(calm.x, calm.y, calm=calm.y, loud=loud.y)
        found = ScreenedSearch(forgiving, 0, lambda text: None).run()
        assert bool(found.chosen) == bool(found.p_values) == (found.fit.free != (0,))
        kept += bool(found.chosen)
    assert kept <= 5


def test_the_next_best_step_is_tried_where_the_best_does_not_stand() -> None:
    plain = toy(0.6, offered=(Form("bend", column=1), Form("late", column=4)))
    problem = replace(plain, y=plain.y + 0.5 * plain.x**4)
    accepted = []

    class Doubting(ScreenedSearch):
        def _stands(self, problem, fitted, candidate):
            stands = candidate.cause != "bend" or 4 in fitted.free
            accepted.append((candidate.cause, stands))
            return stands

    found = Doubting(problem, 0, lambda text: None).run()
    assert accepted == [("bend", False), ("late", True), ("bend", True)]
    assert names_of(found) == ["late", "bend"]
    assert {name for name, _ in found.p_values} == {"late", "bend"}


@dataclass(frozen=True)
class Late(Toy):
    """The right form of a cause, |x| in place of x^2, is only tried once names are settled."""

    def reviewed(self, selection, seed):
        right = {"curve": Form("curve", column=1)}
        chosen = tuple(right.get(item.cause, item) for item in selection.chosen[0])
        fitted = self.fit((0, *(item.column for item in chosen)))
        return replace(selection, fit=fitted, chosen={0: chosen})


def test_a_name_that_only_patched_the_form_of_another_is_dropped_once_that_form_is_right() -> None:
    problem = Late(**vars(toy(0.6, offered=(Form("curve", column=2), Form("patch", column=4)))))
    searched = ScreenedSearch(problem, 0, lambda text: None).run()
    assert names_of(searched) == ["curve", "patch"]
    assert searched.p_value("patch") < 0.02
    assert names_of(problem.reviewed(searched, 0)) == ["curve", "patch"]
    found = infer(problem)
    assert names(found) == ["curve"]
    assert found.selection.p_value("patch") is None
    np.testing.assert_array_equal(found.selection.fit.theta[[2, 3, 4]], 0.0)


@dataclass(frozen=True)
class Patched(Late):
    """Beside the patch, the right form is no better than the wrong one."""

    def reviewed(self, selection, seed):
        return selection

    def reformed(self, selection, seed):
        return selection if "patch" in names_of(selection) else super().reviewed(selection, seed)


def test_a_name_that_patches_a_form_is_dropped_where_another_form_does_without_it() -> None:
    plain = toy(0.6, offered=(Form("curve", column=2), Form("patch", column=4)))
    assert names(infer(plain)) == ["curve", "patch"]
    found = infer(Patched(**vars(plain)))
    assert found.selection.chosen == {0: (Form("curve", column=1),)}
    np.testing.assert_array_equal(found.selection.fit.theta[[2, 3, 4]], 0.0)
    both = Patched(**vars(replace(plain, y=plain.y - 0.5 * plain.x**4)))
    assert names(infer(both)) == ["curve", "patch"]


def test_names_that_both_act_are_found_again_beside_each_other() -> None:
    problem = Late(**vars(toy(0.6, offered=(Form("curve", column=2), Form("patch", column=4)))))
    both = replace(problem, y=problem.y - 0.5 * problem.x**4)
    found = infer(both)
    assert names(found) == ["curve", "patch"]
    assert found.selection.p_value("patch") is not None


@dataclass(frozen=True)
class Hiding(Toy):
    """Weights around a fit without the patch forgive it."""

    far: bool = True

    def weighed(self, now):
        if now is None or 4 in now.free:
            return self, now or self.baseline()
        calm = replace(self, y=self.y + 0.5 * self.x**4)
        return calm, calm.fit(now.free)

    def unweighed(self, now):
        loud = replace(self, y=self.y - 0.5 * self.x**4)
        return loud, loud.fit(now.free)

    def far_off(self, now):
        return self.far


def test_names_are_tested_again_as_the_search_tests_them_where_weights_may_hide_what_is_missing() -> None:
    plain = toy(0.6, offered=(Form("bend", column=1), Form("patch", column=4)))
    both = replace(plain, y=plain.y - 0.5 * plain.x**4)
    selection = ScreenedSearch(both, 0, lambda text: None).run()
    assert sorted(names_of(selection)) == ["bend", "patch"]
    hiding = replace(selection, problem=Hiding(**vars(both)))
    assert sorted(names_of(still_found(hiding, 0))) == ["bend", "patch"]
    sure = replace(selection, problem=Hiding(**vars(both), far=False))
    assert names_of(still_found(sure, 0)) == ["bend"]


@dataclass(frozen=True)
class Glimpsing(Toy):
    """The square seems to be seen in the readings until the bend is there."""

    def screened(self, now, only=None):
        seen = "" if 1 in now.free else "square"
        return [
            item
            for item in Toy.screened(replace(self, seen=seen), now, only)
            if item.candidate.cause != "square" or seen
        ]


def test_what_was_seen_must_still_be_seen_beside_the_others() -> None:
    problem = Glimpsing(**vars(toy(0.6)))
    selection = ScreenedSearch(problem, 0, lambda text: None).run()
    both = replace(
        selection,
        fit=problem.fit((0, 2, 1)),
        chosen={0: tuple(problem.offered)},
        p_values={("bend", 0): 0.001, ("square", 0): None},
    )
    assert both.observed("square")
    assert names_of(still_found(both, 0)) == ["bend"]
    seen = replace(both, problem=toy(0.6, seen="square"))
    assert sorted(names_of(still_found(seen, 0))) == ["bend", "square"]


def test_a_rival_that_trials_prefer_takes_the_place_of_the_name() -> None:
    right, wrong = Form("bend", column=1), Form("square", column=2)
    problem = toy(0.3, offered=(right, wrong))
    named = replace(
        ScreenedSearch(problem, 0, lambda text: None).run(),
        fit=problem.fit((0, 2)),
        chosen={0: (wrong,)},
        p_values={("square", 0): 0.001},
        alternatives={"square": frozenset({"bend"})},
    )
    (rival,) = screened_rivals(named, 0)
    assert rival.preferred
    found, left = settled(named, [rival], 0)
    assert names_of(found) == ["bend"]
    assert not left
    assert found.p_value("bend") == 0.001
    # With more coordinates it would often be preferred, whatever acts.
    rich = replace(right, terms=2)
    richer = replace(named, problem=replace(problem, offered=(rich, wrong)))
    (rival,) = screened_rivals(richer, 0)
    assert not rival.preferred
    assert settled(richer, [rival], 0)[1] == (rival,)


def test_log_scores_are_not_found_where_errors_settle_a_comparison() -> None:
    def asked() -> np.ndarray:
        raise AssertionError("errors were enough")

    few, many = (OutOfFold(np.full((len(CONDITIONS), 1), size), asked) for size in (1.0, 2.0))
    assert not better(many, few)
    assert not clearly_better(many, few, 0)
    assert not tied(few, many, 0)


@pytest.mark.parametrize("missing", [OSError, TypeError])
def test_without_glibc_memory_is_left_as_it_is(missing: type, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: None) -> None:
        raise missing

    monkeypatch.setattr(memory.ctypes, "CDLL", absent)
    with memory.memory_kept():
        pass


@dataclass(frozen=True)
class Passing(Toy):
    """Bends pass the test, however few trials they show in."""

    def screened(self, now, only=None):
        found = super().screened(now, only)
        passing = {item.candidate.cause == "bend": item for item in found}.get(True)
        if passing is None:
            return found
        tested = replace(passing.tested, p_value=0.01, p_adjusted=0.03)
        return [replace(item, tested=tested) if item is passing else item for item in found]


def test_what_shows_in_few_trials_alone_is_found_where_those_are_far_likelier() -> None:
    """As a knee that cuts off readings, which only the hardest presses reach."""

    def found(effect, **changes):
        rng = np.random.default_rng(0)
        reach = np.where(np.arange(TRIALS) % 8 == 0, 1.0, 0.02)[:, None]
        x = reach * rng.uniform(-1, 1, (TRIALS, FRAMES))
        y = x + effect * np.abs(x) + NOISE * rng.normal(size=x.shape)
        return names_of(ScreenedSearch(Passing(x, y, **changes), 0, lambda text: None).run())

    assert found(0.6) == ["bend"]
    assert found(0.02) == []
    # Plain errors have no size by which few could tell.
    assert found(0.6, in_nats=False) == []


def test_few_trials_suffice_that_agree_and_do_not_hang_on_one() -> None:
    others = 0.1 * (-1.0) ** np.arange(9)
    assert few_suffice(np.array([900.0, 30.0, 20.0, *others]))
    assert not few_suffice(np.array([900.0, 5.0, 2.0, *others]))
    assert not few_suffice(np.array([900.0, 300.0, -200.0, *others]))
    assert not few_suffice(np.zeros(12))
