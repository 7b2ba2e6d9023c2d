"""What adding single causes cannot find: two names behind one, better forms, trade-offs, and a delay that
differs from recording to recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import OutOfFold, out_of_fold
from lerobot_vtrefine.diagnose.core.preference import better, clearly_better, preferable
from lerobot_vtrefine.diagnose.core.resampling import agree
from lerobot_vtrefine.diagnose.core.rules import FORM_P
from lerobot_vtrefine.diagnose.core.screened_rivals import surely_likelier
from lerobot_vtrefine.diagnose.core.screened_search import CHANNEL, ScreenedSearch
from lerobot_vtrefine.diagnose.core.search import Selection
from lerobot_vtrefine.diagnose.pad.candidates import causes_like
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.candidates.nonlinear_stiffness import YIELDING
from lerobot_vtrefine.diagnose.pad.candidates.saturation import FREE
from lerobot_vtrefine.diagnose.pad.damping_profile import profile
from lerobot_vtrefine.diagnose.pad.face_map import in_common, on_told_face, uneven
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.form_fitting import starts_of, without
from lerobot_vtrefine.diagnose.pad.own_delay import timed
from lerobot_vtrefine.diagnose.pad.recording_scatter import own_deviations, starts_deviate
from lerobot_vtrefine.diagnose.pad.rules import MORE_COORDINATES
from lerobot_vtrefine.diagnose.pad.screening import GAIN_MAP, MAPS, forms_of, probe_form, scorer_of
from lerobot_vtrefine.tactile.stages.host import Latency
from lerobot_vtrefine.tactile.stages.surface import ContactOffset

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import Candidate, PadProblem

BENDS = causes_like("bend")
"""All bend readings against depth: hardening with saturation is an S, whose lower part an offset fits."""
_ALL = np.ones(1, dtype=bool)


@dataclass(frozen=True)
class State:
    """A fit under its weights."""

    problem: "PadProblem"
    fit: Fit
    seed: int

    def held(self, fit: Fit) -> OutOfFold:
        """A fit on trials left out."""
        return out_of_fold(self.problem, fit, self.problem.folds)

    def weighed(self, fit: Fit) -> "State":
        """A fit under weights of its own."""
        return State(*self.problem.weighed(fit), self.seed)

    def with_plain(self, fit: Fit, name: str) -> Fit:
        """A cause added in its plain form."""
        return self.with_form(fit, forms_of(name, fit)[0])

    def with_form(self, fit: Fit, form: Form, plain: Fit | None = None) -> Fit:
        """A cause added in a form, which may grow from the fit of its plain one."""
        probes = probe_form(form, scorer_of(self.problem, fit)) if form.screened else []
        candidate = _candidate(form.family, form, {form.label: starts_of(form, probes)})
        return self.problem.extended(fit, candidate, _ALL, plain)

    def in_likeliest_form(self, form: Form) -> Fit:
        """The fit, or another with that cause in a form of hardly more coordinates than the best so far."""
        possible = forms_of(form.family, self.fit, settled=True)
        best, held, terms = self.fit, self.held(self.fit), len(form.values)
        if form.range is not None or len(possible) == 1:
            return best
        slim = self.without(form.family)
        plain = self.fit if form is possible[0] else self.with_form(slim, possible[0])
        for other in possible:
            if other is form or len(other.values) > terms + MORE_COORDINATES:
                continue
            found = plain if other is possible[0] else self.with_form(slim, other, plain)
            judged = self.held(found)
            if agree(judged.better_by(held), self.seed, FORM_P):
                best, held, terms = found, judged, len(other.values)
        return best

    def without(self, *names: str) -> Fit:
        """The fit without some causes."""
        return without(self.fit, names, self.problem.presses, self.problem.weights)


def _candidate(name: str, form: Any, starts: dict[str, Any]) -> "Candidate":
    from lerobot_vtrefine.diagnose.pad.problem import Candidate

    return Candidate(name, form=form, starts=starts)


def reviewed(selection: Selection["PadProblem", Fit, Any], seed: int) -> Selection["PadProblem", Fit, Any]:
    """The selection after all looks."""
    found = _looked_over(selection, seed)
    if not starts_deviate(own_deviations(found.problem.presses, found.fit)):
        return found
    return with_own_delays(found, seed) or found


def with_own_delays(
    selection: Selection["PadProblem", Fit, Any], seed: int
) -> Selection["PadProblem", Fit, Any] | None:
    """What is selected beside delays of the recordings' own; None where that is no latency."""
    around, _ = timed(selection.problem, selection.fit)
    found = _looked_over(ScreenedSearch(around, seed, lambda text: None).run(), seed)
    if Latency.name not in found.fit.model.families:
        return None
    around, fitted = timed(found.problem, found.fit)
    return replace(found, problem=around, fit=fitted, errors=State(around, fitted, seed).held(fitted).errors)


def _looked_over(
    selection: Selection["PadProblem", Fit, Any], seed: int
) -> Selection["PadProblem", Fit, Any]:
    """After the first four looks, with settled weights."""
    if not selection.fit.model.families:
        return selection
    state = State(selection.problem, selection.fit, seed)
    named = selection.fit.model.families
    state = cover_or_readout(two_bends(state))
    p_values, alternatives = dict(selection.p_values), dict(selection.alternatives)
    for name in state.fit.model.families:
        if name not in named:
            bend = next(item for item in BENDS if item in named)
            alternatives[name] = frozenset(BENDS) - {name}
            p_values[name, CHANNEL] = p_values.get((bend, CHANNEL))
    state = plain_forms(state)
    state = on_uneven_face(likeliest_forms(state.weighed(state.fit)))
    best = resolved(state)
    state = state if best is state.fit else state.weighed(best)
    return _selected(replace(selection, p_values=p_values, alternatives=alternatives), state)


def reformed(selection: Selection["PadProblem", Fit, Any], seed: int) -> Selection["PadProblem", Fit, Any]:
    """The same names in the forms under which recordings left out are likeliest."""
    state = State(selection.problem, selection.fit, seed)
    best = likeliest_forms(state)
    return selection if best is state else _selected(selection, best)


def _selected(
    selection: Selection["PadProblem", Fit, Any], state: State
) -> Selection["PadProblem", Fit, Any]:
    """The selection with a fit, and what the fit holds."""
    model = state.fit.model
    chosen = tuple(_candidate(form.family, form, {}) for form in model.forms)
    chosen += tuple(_candidate(name, None, {}) for name in MAPS if name in model.families)
    return replace(
        selection,
        problem=state.problem,
        fit=state.fit,
        errors=state.held(state.fit).errors,
        chosen={CHANNEL: chosen} if chosen else {},
        p_values={key: p for key, p in selection.p_values.items() if key[0] in model.families},
    )


def two_bends(state: State) -> State:
    """Where bends were named, another two of them in their place, if these explain the recordings better.

    An offset that is felt softly fits an S so well that two names in its place take away little more of the
    squared error. Plain hardening with plain saturation has no more coordinates, and need not.
    """
    named = [form for form in state.fit.model.forms if form.family in BENDS]
    if not named:
        return state
    best, held = state.fit, state.held(state.fit)
    slim = state.without(*(form.family for form in named))
    for names in combinations(BENDS, 2):
        if {form.family for form in named} == set(names) or not all(forms_of(name, slim) for name in names):
            continue
        found = slim
        for name in names:
            found = state.with_plain(found, name)
        other, pair = state.held(found), [forms_of(name, slim)[0] for name in names]
        if _takes_place(pair, other, named, held, state):
            best, held, named = found, other, pair
    return state if best is state.fit else state.weighed(best)


def cover_or_readout(state: State) -> State:
    """A cover that gives way in the place of readings that level off, where trials are surely likelier so.

    A slow press reads the same of both. In a fast one damping bears a part, which a readout bends with all
    the rest, and a cover leaves alone. The two are compared under one law of free sharpness, or laws would
    differ by more than damping does. Where damping is too faint to tell, it stays the readout, for dividers
    are what boards are made of.
    """
    named = state.fit.model.families
    if FREE.family not in named or YIELDING.family in named or not YIELDING.possible(state.fit.model.setting):
        return state
    slim = state.without(FREE.family)
    cover, readout = (state.with_form(slim, form) for form in (YIELDING, FREE))
    held = state.held(cover)
    told = all(surely_likelier(held, state.held(fit), state.seed) for fit in (readout, state.fit))
    return state.weighed(cover) if told else state


def _takes_place(
    pair: Sequence[Form], other: OutOfFold, named: Sequence[Form], held: OutOfFold, state: State
) -> bool:
    """Whether two bends are to stand for what was named, compared by coordinates, as forms of a name are."""
    more = sum(len(form.values) for form in pair) - sum(len(form.values) for form in named)
    if more > 0:
        return clearly_better(other, held, state.seed, state.problem.further_gain)
    if more < 0 and len(named) >= len(pair):
        return not clearly_better(held, other, state.seed)
    return better(other, held) or agree(other.better_by(held), state.seed, FORM_P)


def plain_forms(state: State) -> State:
    """Plain forms again where they do: a rich form may have stood in for a cause that was found after it."""
    for form in state.fit.model.forms:
        plain = forms_of(form.family, state.fit)[0]
        if form is plain:
            continue
        found = state.with_plain(state.without(form.family), form.family)
        rich = _candidate(form.family, form, {})
        if not preferable(rich, state.held(state.fit), state.held(found), state.seed):
            state = state.weighed(found)
    return state


def likeliest_forms(state: State) -> State:
    """Every settled name in the form under which recordings left out are surely likeliest.

    While names compete, another form must take away squared error, for a rich one imitates other causes. Once
    they are settled, that would only hide the right one: squared errors hang on how hard and where each
    recording happened to touch, which log scores allow for.
    """
    for form in state.fit.model.forms:
        found = state.in_likeliest_form(form)
        state = state if found is state.fit else state.weighed(found)
    return state


def on_uneven_face(state: State) -> State:
    """Where an offset is named, another at every taxel, if recordings left out are surely likelier so.

    What a cover of uneven thickness does to taxels looks like gains of their own: where these are named as
    well, the face is to take their place.
    """
    model = state.fit.model
    if ContactOffset.name not in model.families or uneven(model):
        return state
    even = state.fit if model.gain_map is None else state.without(GAIN_MAP)
    found = on_told_face(even, state.problem.presses, state.problem.weights)
    if not in_common(found.model):
        return state
    surely = agree(state.held(found).better_by(state.held(state.fit)), state.seed, FORM_P)
    return state.weighed(found) if surely else state


def resolved(state: State) -> Fit:
    """The best fit along the trade-off of a delay against the damping, which descents cut short."""
    fitted, problem = state.fit, state.problem
    for index, form in enumerate(fitted.model.forms):
        if form.twin is not None and not fitted.model.setting.loaded:
            coordinate = fitted.model.place(index).start + form.twin
            best = profile(fitted, problem.presses, problem.weights, coordinate).best
            found = problem.settled(best.model)
            fitted = found if found.loss < fitted.loss else fitted
    return fitted
