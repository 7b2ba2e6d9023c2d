"""``report.html``: one self-contained page about a diagnosis."""

import json
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.evidence import Evidence, Trace
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.diagnose.report import words
from lerobot_vtrefine.diagnose.report.effects import effect_drawing
from lerobot_vtrefine.diagnose.report.figures import (
    SHOWN_TRIALS,
    error_figure,
    residual_figure,
    trace_figure,
    trial_figure,
)
from lerobot_vtrefine.diagnose.report.numbers import interval, nested, p_text, percent, quantity
from lerobot_vtrefine.diagnose.servo.bench import on_bench
from lerobot_vtrefine.diagnose.verdict import Parameter, Verdict
from lerobot_vtrefine.pages.pads import colour_scale, pad_image
from lerobot_vtrefine.pages.render import render
from lerobot_vtrefine.wording import plural

SHOWN_TRACES = 4
"""Trials that are shown; the others are in a section that is closed at first."""
NOT_FOUND = "rejected"
DECISIONS = {
    "accepted": "found",
    "symptom": "symptom",
    "tie": "tied",
    "rejected": "not found",
    "not identifiable": "not identifiable here",
}


def render_report(
    diagnosis: Diagnosis,
    recordings: RecordingSet,
    seed: int,
    film: dict[str, str] | None = None,
    survived: str = "",
    model: str = "sensor_model.json",
) -> str:
    """The page as HTML text.

    Args:
        recordings: as they were read, before quality control.
        film: a press in motion: its source, caption and colour scale.
        survived: how often other locked draws and halves of the recordings give each name, in one line.
        model: where the extended model is, as the reader would type it.
    """
    verdict, unit, sound = diagnosis.verdict, diagnosis.unit, diagnosis.checked
    of_pad = recordings.kind == "pad"
    return render(
        "lerobot_vtrefine.diagnose.report",
        "report.html",
        headline=words.headline(verdict, unit),
        verdict=verdict,
        verdict_of_pad=of_pad,
        meaning=words.meaning,
        percent=percent,
        p_text=p_text,
        title=words.title,
        ties=words.ties(verdict),
        doubts=words.doubts(verdict, len(recordings.trials), sound),
        facts=_facts(verdict, recordings, sound, seed) + ([("stability", survived)] if survived else []),
        next_experiment=_experiment(verdict.next_experiment),
        detectable=[
            {"title": words.title(name), "size": words.size_text(name, size)}
            for name, size in verdict.minimum_detectable.items()
        ],
        drawings={cause.name: effect_drawing(cause.name) for cause in verdict.causes},
        use=_use(verdict, recordings, model),
        film=film,
        not_tested=[{"title": words.title(name), "needs": what} for name, what in verdict.not_tested.items()],
        **_findings(diagnosis, of_pad),
    )


def _use(verdict: Verdict, recordings: RecordingSet, model: str) -> dict[str, str] | None:
    """What to do with the extended model, and the commands; None where it adds nothing."""
    if not verdict.causes or verdict.heldout is None or verdict.withheld:
        return None
    flag = "--env.sensor_model" if recordings.kind == "pad" else "--env.reality"
    task = "--config_path=vtrefine:round_grasped"
    again = ", refitted to all recordings after the errors above had been measured"
    said = f"sensor_model.json beside this page holds the repaired model{again * verdict.models_saw_locked}."
    if verdict.status in ("unexplained", "ambiguous"):
        said += " Its causes are not settled, so check first that it predicts other recordings better."
    else:
        said += " Record, fine-tune and evaluate with it, and predict other recordings to verify it."
    in_simulation = [
        f"vtrefine-record-demos {task} \\\n    --root=outputs/repaired_demos {flag}={model}",
        f"vtrefine-finetune {task} --policy.path=CHECKPOINT \\\n"
        f"    --output_dir=outputs/repaired {flag}={model}",
    ]
    lines = [
        *(() if on_bench(recordings) else in_simulation),
        f"vtrefine-predict --recording=OTHERS \\\n    --sensor_model={model} --output_dir=predicted",
    ]
    return {"words": said, "commands": "\n\n".join(lines)}


def _findings(diagnosis: Diagnosis, of_pad: bool) -> dict[str, Any]:
    verdict, unit = diagnosis.verdict, diagnosis.unit
    traces = [{"caption": text, "figure": trace_figure(t, unit)} for t, text in _ordered(diagnosis.traces)]
    groups = [(words.title(cause.name), cause.params) for cause in verdict.causes]
    axes = words.AXES if of_pad else words.ROBOT_AXES
    found = [item for item in diagnosis.evidence if item.decision != NOT_FOUND]
    not_found = [item for item in diagnosis.evidence if item.decision == NOT_FOUND]
    return {
        "error_chart": error_figure(verdict.heldout, unit) if verdict.heldout else "",
        "trial_chart": trial_figure(diagnosis.trial_errors, unit) if diagnosis.trial_errors else "",
        "trial_note": _trial_note(len(diagnosis.trial_errors)),
        "traces": traces[:SHOWN_TRACES],
        "more_traces": traces[SHOWN_TRACES:],
        "residuals": [
            {"caption": axes.get(view.axis, view.axis), "figure": residual_figure(view, unit)}
            for view in diagnosis.residuals
        ],
        "worst_joint": "" if of_pad or not diagnosis.traces else diagnosis.traces[0].channels[0],
        "evidence": [_evidence_row(item) for item in _by_decision(found)],
        "not_found": [_evidence_row(item) for item in _by_decision(not_found)],
        "parameters": [_parameter_row(of, name, p) for of, params in groups for name, p in params.items()],
        "baseline": [_parameter_row("baseline", name, p) for name, p in diagnosis.baseline_params.items()],
        "maps": _maps(diagnosis.maps, unit),
    }


def _trial_note(count: int) -> str:
    return f"; the {SHOWN_TRIALS} worst predicted of {count}" if count > SHOWN_TRIALS else ""


def _facts(verdict: Verdict, recordings: RecordingSet, sound: int, seed: int) -> list[tuple[str, str]]:
    """Short facts about the data, title and text."""
    conditions = plural(len({trial.condition for trial in recordings.trials}), "condition")
    if recordings.kind == "pad":
        what = (
            f"pad of {recordings.rows} × {recordings.cols} taxels, {quantity(recordings.pitch_m, 'm')} apart"
        )
    elif on_bench(recordings):
        what = f"servo {recordings.joints[0]} with a pendulum"
    else:
        what = f"robot with {plural(len(recordings.joints), 'joint')}"
    seconds = sum(float(np.ptp(t.time_s[np.isfinite(t.time_s)])) for t in recordings.trials if len(t.time_s))
    facts = [
        (
            "recordings",
            f"{len(recordings.trials)} in {conditions}, {seconds:.0f} s in all; {sound} sound",
        ),
        ("what", f"{what}, from the folder {PurePath(recordings.path).name}"),
    ]
    if verdict.heldout is not None:
        held = plural(len(verdict.heldout.trials), "recording")
        facts.append(("held out", f"{held}, used neither for fitting nor for selection"))
    return [*facts, ("seed", str(seed))]


def _ordered(traces: Sequence[Trace]) -> list[tuple[Trace, str]]:
    """Traces with captions: the typical and the worst first, so that the best are not all that is seen."""

    def error(trace: Trace) -> float:
        return float(np.sqrt(np.nanmean((trace.measured - trace.extended) ** 2)))

    ranked = sorted(traces, key=error)
    if len(ranked) < 3:
        return [(trace, _caption(trace, "")) for trace in ranked]
    middle = ranked.pop(len(ranked) // 2)
    worst, best = ranked.pop(), ranked.pop(0)
    special = [(middle, "typical"), (worst, "the worst predicted"), (best, "the best predicted")]
    return [(trace, _caption(trace, text)) for trace, text in [*special, *((trace, "") for trace in ranked)]]


def _caption(trace: Trace, remark: str) -> str:
    condition = "" if trace.condition.startswith("episode") else f"condition {trace.condition}"
    parts = [PurePath(trace.file).stem, condition, remark]
    return ", ".join(part for part in parts if part)


def _by_decision(evidence: Sequence[Evidence]) -> list[Evidence]:
    """Found ones first, each group by its cross-validated gain."""
    order = list(DECISIONS)
    return sorted(evidence, key=lambda item: (order.index(item.decision), -(item.cv_gain or 0.0)))


def _evidence_row(item: Evidence) -> dict[str, Any]:
    gain = item.cv_gain
    return {
        "title": words.title(item.name),
        "name": item.name if item.name in words.MAIN_PARAMETERS else "",
        "p": p_text(item.p_value),
        "p_adjusted": "observed" if item.observed else p_text(item.p_adjusted),
        "gain": "–" if gain is None else percent(gain),
        "bar": 0.0 if gain is None else 100.0 * min(max(gain, 0.0), 1.0),
        "decision": DECISIONS[item.decision],
        "style": item.decision.replace(" ", "-"),
        "reason": item.reason,
    }


def _parameter_row(group: str, name: str, parameter: Parameter) -> dict[str, Any]:
    row = {"group": group, "name": name, "image": "", "interval": "", "value": ""}
    value = parameter.value
    if isinstance(value, (int, float)):
        ci95 = parameter.ci95 if parameter.ci95 is None else [float(end) for end in parameter.ci95]
        row["value"], row["interval"] = interval(float(value), ci95, parameter.unit)
        return row
    array = _number_map(value)
    if array is None or min(array.shape) < 2 or name == "taxels":
        return row | {"value": nested(value)}
    low, high = float(array.min()), float(array.max())
    span = max(high - 1.0, 1.0 - low, 1e-9)
    return row | {
        "value": f"{low:.3g} to {high:.3g}, median {np.median(array):.3g}",
        "image": pad_image(array - 1.0, span, diverging=True),
    }


def _number_map(value: Any) -> np.ndarray | None:
    """Nested lists as an (R, C) array, or None if they are none."""
    try:
        array = np.asarray(value, dtype=float)
    except (ValueError, TypeError):
        return None
    return array if array.ndim == 2 else None


def _maps(maps: Mapping[str, np.ndarray], unit: str) -> list[dict[str, str]]:
    """Heat maps; those whose titles start alike ("rms residual before", "... after") share a scale."""
    shown = []
    for name, values in maps.items():
        family = name.rsplit(" ", 1)[0]
        alike = [other for key, other in maps.items() if key.rsplit(" ", 1)[0] == family]
        top = max(float(np.nanmax(np.abs(other))) for other in alike)
        caption = f"{name}: up to {quantity(float(np.nanmax(values)), unit)}"
        scale = colour_scale(top, unit)
        shown.append({"caption": caption, "image": pad_image(np.abs(values), top), "scale": scale})
    return shown


def _experiment(protocol: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """What to record next: a text for people, and the protocol for the rig."""
    if protocol is None:
        return None
    rest = {key: value for key, value in protocol.items() if key not in ("text", "decides")}
    return {
        "text": protocol.get("text", ""),
        "decides": [words.title(str(name)) for name in protocol.get("decides", ())],
        "protocol": json.dumps(rest, indent=2, default=str) if rest else "",
    }
