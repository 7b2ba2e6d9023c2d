"""The verdict in plain words."""

from collections.abc import Sequence
from importlib import import_module

from lerobot_vtrefine.diagnose.report.numbers import digits, percent, quantity, scale_of
from lerobot_vtrefine.diagnose.verdict import Verdict
from lerobot_vtrefine.wording import plural

MAIN_PARAMETERS = {
    "nonlinear_stiffness": ("exponent − 1", "1"),
    "saturation": ("knee", "counts"),
    "viscoelastic_relaxation": ("fraction", "1"),
    "hysteresis": ("fraction", "1"),
    "first_load_softening": ("softening", "1"),
    "taxel_gain_spread": ("spread", "1"),
    "dead_taxels": ("taxels", "1"),
    "row_sharing": ("conductance", "1/counts"),
    "supply_droop": ("droop", "1/counts"),
    "crosstalk": ("fraction", "1"),
    "mechanical_spreading": ("sigma", "m"),
    "baseline_drift": ("rate", "counts/s"),
    "latency": ("delay", "s"),
    "scan_skew": ("first to last row", "s"),
    "sample_and_hold": ("period", "s"),
    "contact_offset": ("offset", "m"),
    "pad_tilt": ("tilt", "rad"),
    "encoder_offset": ("offset", "rad"),
    "backlash": ("width", "rad"),
    "control_latency": ("delay", "s"),
    "joint_friction": ("friction", "N*m"),
    "gravity_sag": ("sag", "rad"),
    "gripper_compliance": ("compliance", "m/N"),
    "load_friction": ("part of the load", "1"),
    "directional_friction": ("part of the motor's torque", "1"),
    "stribeck_friction": ("stiction", "N*m"),
    "load_stiction": ("part of the motor's torque", "1"),
    "quadratic_friction": ("coefficient", "1/(N*m)"),
    "supply_sag": ("resistance over the winding's", "1"),
    "motor_heating": ("change per kelvin", "1/K"),
    "voltage_limit": ("missing part", "1"),
    "camera_extrinsics": ("displacement", "m"),
    "depth_scale": ("factor − 1", "1"),
    "object_mass": ("mass", "kg"),
    "object_friction": ("coefficient", "1"),
    "clearance": ("clearance", "m"),
}
"""Every cause's for people, with its unit (docs/verdict.md)."""
MEANINGS = {
    "taxel_gain_spread": "Taxels differ in sensitivity.",
    "dead_taxels": "Some taxels never respond.",
    "camera_extrinsics": "The camera is not where the simulation places it.",
    "depth_scale": "The depth camera's distances are off by a factor.",
    "object_mass": "The object weighs more, or less, than simulated.",
    "object_friction": "The object has more, or less, friction than simulated.",
    "clearance": "The socket is tighter, or wider, than simulated.",
}
"""What a cause is that no file of a catalogue stands for; the others' docstrings say so."""
SPELLED = {
    "nonlinear_stiffness": "non-linear stiffness",
    "first_load_softening": "first-load softening",
    "stribeck_friction": "Stribeck friction",
}
"""Titles of causes that are not their names with spaces."""


AXES = {
    "load": "Against load: the reading above idle that the simulation expects",
    "history": "Against history: how far the load is below the largest so far",
    "rate": "Against the rate of indentation; positive is into the pad",
    "depth": "Against depth; below zero there is no contact",
    "column": "Against the position along the columns",
    "row": "Against the position along the rows",
    "position": "Against the commanded position",
    "time": "Against time in the recording",
    "session": "Against time in the session",
}
"""What a residual is drawn against."""
ROBOT_AXES = AXES | {
    "load": "Against the joint's measured load",
    "rate": "Against the commanded speed",
}
LONGEST_CLUE = 130
"""Longer clues appear below the headline only; of several, the headline has the first."""


def title(name: str) -> str:
    """A cause's name for people; evidence may be about something that is in no list of causes."""
    return SPELLED.get(name, name.replace("_", " "))


def meaning(name: str) -> str:
    """What a cause is, in one sentence."""
    if name in MEANINGS:
        return MEANINGS[name]
    for instrument in ("joints", "servo", "pad"):  # those that import quickly first
        told = import_module(f"lerobot_vtrefine.diagnose.{instrument}.candidates").MEANING.get(name, "")
        if told:
            return told[:1].upper() + told[1:]
    return ""


def listing(items: Sequence[str], last: str = "and") -> str:
    """ "a", "a and b", "a, b and c"."""
    items = list(items)
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} {last} {items[-1]}"


def ties(verdict: Verdict) -> list[str]:
    """Names that cannot be distinguished, "a or b"; the same names in another order add nothing."""
    groups = {frozenset(group): group for group in reversed(verdict.ambiguous_with)}
    return [listing([title(name) for name in group], "or") for group in reversed(groups.values())]


def headline(verdict: Verdict, unit: str) -> str:
    """The first sentence of the report."""
    names = listing([title(cause.name) for cause in verdict.causes])
    pairs = listing(ties(verdict))
    clue = (verdict.unknown.clue or "").split(";")[0]
    clue = f" Clue: {clue}." if 0 < len(clue) <= LONGEST_CLUE else ""
    if verdict.status == "invalid_data":
        return "No verdict is possible: too few of these recordings are usable."
    if verdict.status == "adequate":
        fitted = "stiffness, damping and gain" if unit == "counts" else "servo constants"
        scope = " for what was tested" if verdict.not_tested else ""
        return (
            f"The simulation is adequate{scope}: once its {fitted} are refitted, nothing significant is left."
        )
    if verdict.status == "explained":
        said = withheld(verdict) if verdict.withheld else f"{repaired(verdict, unit)}{_unconfirmed(verdict)}"
        return f"The simulation lacks {names}. {said}{clue and ' It may be something else.'}{clue}"
    if verdict.status == "ambiguous":
        sure = [title(c.name) for c in verdict.causes if not any(c.name in g for g in verdict.ambiguous_with)]
        beside = f" It certainly lacks {listing(sure)}." if sure else ""
        return f"The simulation is wrong, but these recordings cannot tell whether it lacks {pairs}.{beside}"
    symptoms = f" What looks like {names} may be a symptom of it.{_still_helps(verdict)}" if names else ""
    return f"The simulation is wrong in a way that no known cause explains.{clue}{symptoms}"


def power_line(verdict: Verdict) -> str:
    """What recordings with an adequate verdict would have shown, and what not; empty for other verdicts."""
    if verdict.status != "adequate":
        return ""
    shown = listing(
        [f"{title(name)} ({size_text(name, size)})" for name, size in verdict.minimum_detectable.items()]
    )
    parts = [f"would have shown: {shown}"] if shown else []
    if verdict.not_tested:
        missing = [f"{title(name)} ({what})" for name, what in sorted(verdict.not_tested.items())]
        parts.append(f"not tested: {listing(missing)}")
    return "; ".join(parts)


def size_text(name: str, size: float) -> str:
    """A cause's main parameter at some size, for example "delay: 4 ms"."""
    if name == "dead_taxels":
        return "any one that is pressed hard enough"
    parameter, unit = MAIN_PARAMETERS.get(name, ("size", "1"))
    return f"{parameter}: {quantity(size, unit)}"


def _still_helps(verdict: Verdict) -> str:
    """How much symptoms improve predictions, where they do."""
    held = verdict.heldout
    if held is None or held.gain <= 0 or (held.gain_ci95 is not None and held.gain_ci95[0] <= 0):
        return ""
    pronoun = "it" if len(verdict.causes) == 1 else "them"
    return f" Adding {pronoun} to the model still removes {percent(held.gain)} of the squared error."


def repaired(verdict: Verdict, unit: str) -> str:
    """How much the extension improves predictions of held-out recordings, in one sentence."""
    held = verdict.heldout
    if held is None:
        return ""
    factor, name = scale_of(held.baseline, unit)
    change = f"from {digits(held.baseline * factor)} to {digits(held.extended * factor)} {name}"
    interval = ""
    if held.gain_ci95 is not None:
        interval = f" (95 % interval {percent(held.gain_ci95[0])} to {percent(held.gain_ci95[1])})"
    added = "it" if len(verdict.causes) == 1 else "these"
    if held.gain < 0:
        return (
            f"With {added} added, its error on held-out recordings goes {change}{interval}: how each of them "
            f"was touched outweighs the effect. Where that is allowed for, they are likelier with {added}."
        )
    floor = ""
    if held.noise_floor is not None:
        floor = f" Noise alone is {quantity(held.noise_floor, unit)}."
    return (
        f"With {added} added, its error on held-out recordings falls {change}; "
        f"{percent(held.gain)} of the squared error is removed{interval}.{floor}"
    )


def withheld(verdict: Verdict) -> str:
    """Why the extended model is the baseline although something was found, in one sentence."""
    assert verdict.heldout is not None
    added = "it" if len(verdict.causes) == 1 else "these"
    count = len(verdict.heldout.trials)
    return (
        f"With {added} added, the {count} held-out recordings are predicted worse, so sensor_model.json is "
        "the refitted baseline: record more conditions, each twice, for a repair that can be trusted."
    )


def _unconfirmed(verdict: Verdict) -> str:
    """Names that were significant where the model was fitted, and do not help on held-out recordings."""
    names = [title(item.name) for item in verdict.causes if (item.heldout_gain or 0.0) < 0]
    if not names or (verdict.heldout is not None and verdict.heldout.gain < 0):
        return ""
    pronoun = "it" if len(names) == 1 else "either" if len(names) == 2 else "any of them"
    return (
        f" Held-out recordings do not confirm {listing(names)}: without {pronoun} they are predicted better."
    )


def doubts(verdict: Verdict, recorded: int, checked: int) -> list[str]:
    """Reasons for caution that follow from the verdict's own numbers."""
    found = []
    held = verdict.heldout
    if checked < recorded:
        found.append(f"Set aside: {recorded - checked} of {recorded} recordings, see Data below.")
    if verdict.unknown.clue and not verdict.unknown.alarm:
        found.append(f"It may be something else: {verdict.unknown.clue}.")
    if held is None:
        return found
    if len(held.trials) < 6:
        found.append(
            f"Only {plural(len(held.trials), 'held-out recording')}: the interval of the gain is imprecise."
        )
    if held.gain_ci95 is not None and held.gain_ci95[0] <= 0 and verdict.causes and not verdict.withheld:
        found.append("The interval of the gain includes zero: the repair may not help on other recordings.")
    if held.noise_floor is not None and held.noise_floor > 0:
        excess = (held.extended**2 - held.noise_floor**2) / max(held.baseline**2, 1e-30)
        if excess > 0.1:
            found.append(
                f"{percent(excess)} of the baseline's squared error is neither repaired nor noise: the form "
                "of the repair is wrong, or recordings differ in ways that the model does not describe."
            )
        elif excess < -0.02:
            found.append("The error is below the estimated noise floor, so that floor is estimated too high.")
    tested = [cause for cause in verdict.causes if cause.basis == "tested"]
    weak = [title(c.name) for c in tested if c.p_value is None or c.p_value > 0.01]
    if weak:
        found.append(f"The evidence for {listing(weak)} is weak (p above 0.01, or none).")
    if verdict.unknown.alarm and verdict.causes:
        found.append("The names given are symptoms: an unknown effect is often mistaken for a known one.")
    return found
