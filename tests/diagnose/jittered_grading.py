"""Diagnoses of the third rig's recordings held against the truth, set by set and in tables."""

from collections.abc import Callable
from typing import Any

import numpy as np
from hidden.grading import grade
from hidden.session import Spec
from hidden.table import share, spread
from hidden.writer import Truth
from jittered_rig import FULL_SCALE, PITCH_M, Effect, Rig

Row = dict[str, Any]
LATER_SESSIONS = (1, 2)
"""Sixteen presses each: with six in all, an achievable gain of 0.2 was only known to a tenth or worse."""


def graded(rig: Rig, effects: list[tuple[Effect, float]], found) -> Row:
    """What became of a set: the grade, and gains on later presses of the same specimen."""
    causes = tuple(effect.cause for effect, _ in effects if effect.cause)
    params = {effect.cause: {effect.parameter: strength} for effect, strength in effects if effect.parameter}
    truth = Truth(Spec("jittered"), rig.seed, causes, any(not effect.cause for effect, _ in effects), params)
    verdict = found.verdict.to_dict()
    row = vars(grade(truth, verdict)) | {"truth": params, "status": verdict["status"], "causes": causes}
    row |= {"outside": truth.outside, "achievable": rig.achievable(effects) if effects else 0.0}
    row["unknown"], row["ambiguous"] = verdict["unknown"], verdict["ambiguous_with"]
    row["params"] = {
        f"{cause['name']}.{name}": value
        for cause in verdict["causes"]
        for name, value in cause["params"].items()
    }
    row["minimum_detectable"] = verdict["minimum_detectable"]
    return row | later_gains(rig, effects, found)


def later_gains(rig: Rig, effects: list[tuple[Effect, float]], found) -> Row:
    """Gains over the baseline on presses that the diagnosis has not seen, of the models that users get and of
    the true law: with the true gain and damping, and the face where presses touch on average.

    What is drawn anew for every press, the true law knows by its mean: no model can know which frames of a
    press will drop out. Any one draw of them is a worse prediction, or tells what only the press can tell.
    """
    from lerobot_vtrefine.diagnose.pad.prediction import predict_trial
    from lerobot_vtrefine.tactile.layout import PadLayout

    errors = dict.fromkeys(("baseline", "extended", "truth"), 0.0)
    layout = PadLayout(rig.rows, rig.cols, PITCH_M)
    for session in LATER_SESSIONS:
        later = Rig(rig.seed, rig.rows, rig.cols, session)
        for press, trial in zip(later.presses, later.record(effects).trials, strict=True):
            truth = np.tile(rig.idle, (len(trial.time_s), 1))
            truth[:, press.taxels] += later.expected(press, effects)
            keep = press.taxels[(press.heights > 0).any(axis=0)]
            predicted = {"truth": truth.clip(0, FULL_SCALE)}
            predicted["baseline"] = predict_trial(found.baseline_model, trial, layout)
            predicted["extended"] = predict_trial(found.extended_model, trial, layout)
            for name, values in predicted.items():
                errors[name] += float(((trial.raw - values)[:, keep] ** 2).mean())
    return {
        name: 1 - errors[key] / errors["baseline"]
        for name, key in (("gain", "extended"), ("oracle_gain", "truth"))
    }


def document(rows: list[Row]) -> str:
    """The documents' table in Markdown."""
    of_law = [row for row in rows if row.get("causes")]
    own = [row for row in of_law if row["truth"]]
    other = [row for row in of_law if not row["truth"]]
    strange = [row for row in rows if row.get("outside")]
    clean = [row for row in rows if row["law"] == "clean"]
    ratio = [row["gain"] / row["oracle_gain"] for row in of_law if row["oracle_gain"] > 0.1]
    hits = [{"hit": hit} for row in rows for hit in row.get("covered", {}).values()]

    def says(key: str) -> Callable[[Row], bool]:
        return lambda row: bool(row.get(key))

    def line(words: str, bar: str, *cells: tuple[int, str]) -> list[str]:
        counts = "; ".join(dict.fromkeys(str(n) for n, _ in cells))
        return [words, counts, "; ".join(text for _, text in cells), bar]

    body = [
        ["", "sets", "engine", "bar"],
        line("law in the catalogue's form: exact verdict", ".95", share(own, says("exact"))),
        line("law of another form: exact verdict", "", share(other, says("exact"))),
        line("law of another form: right name first", ".97", share(other, says("first_right"))),
        line("wrong name first", ".02", share(of_law, says("wrong_first"))),
        line("an effect that no catalogue lists: said to be unknown", ".95", share(strange, says("exact"))),
        line("nothing wrong: false alarm", ".03", share(clean, lambda row: not row.get("exact"))),
        line("gain on new presses / the true law's: median", ".97", spread(ratio, 0.5)),
        line("gain on new presses / the true law's: worst tenth", ".90", spread(ratio, 0.1)),
        line("95 % intervals that hold the truth", ".90-.98", share(hits, says("hit"))),
        line("more than 60 s of one core", ".01", share(rows, lambda row: row.get("cpu_s", np.inf) > 60)),
    ]
    text = ["| " + " | ".join(cells) + " |" for cells in body]
    return "\n".join([text[0], "|---" * 4 + "|", *text[1:]])


def by_law(rows: list[Row]) -> str:
    """Sets, exact verdicts, right first names and gain over the truth's, law by law and gain by gain."""
    head = ("law", "gain", "sets", "exact", "first", "gain/true", "inside", "cpu s")
    lines = ["{:18} {:>5} {:>5} {:>6} {:>6} {:>9} {:>7} {:>6}".format(*head)]
    for law, gain in sorted({(row["law"], row["gain_wanted"]) for row in rows}):
        mine = [row for row in rows if (row["law"], row["gain_wanted"]) == (law, gain) and "cpu_s" in row]
        hits = [hit for row in mine for hit in row["covered"].values()]
        ratio = [row["gain"] / row["oracle_gain"] for row in mine if row["oracle_gain"] > 0.05] or [np.nan]
        exact, first = (sum(row[name] for row in mine) for name in ("exact", "first_right"))
        seconds = np.median([row["cpu_s"] for row in mine] or [np.nan])
        lines.append(
            f"{law:18} {gain:5.2f} {len(mine):5} {exact:6} {first:6} {np.median(ratio):9.2f}"
            f" {sum(hits):3}/{len(hits):<3} {seconds:6.1f}"
        )
    return "\n".join(lines)


def failures(rows: list[Row]) -> list[str]:
    """One line for every set that was not answered exactly."""
    lines = []
    for row in rows:
        if row.get("exact"):
            continue
        if "error" in row:
            lines.append(f"{row['set']}: {row['error']}")
            continue
        said = ", ".join(row["named"]) or "-"
        said += "".join(f" or {' or '.join(group)}" for group in row["ambiguous"])
        clue = f" ({row['unknown']['clue']})" if row["unknown"]["clue"] else ""
        gain = f"gain {row['gain']:.2f} of {row['oracle_gain']:.2f}"
        lines.append(f"{row['set']}: {row['kind']} -> {said}{clue}; {gain}")
    return lines
