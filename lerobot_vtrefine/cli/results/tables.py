"""Markdown tables from rows, and the documents' blocks that hold them.

A block is what lies between ``<!-- table: NAME -->`` and ``<!-- end -->``.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import median

from lerobot_vtrefine.cli.report.statistics import mean_interval, wilson_interval
from lerobot_vtrefine.cli.results.cells import (
    LABELS,
    average,
    difference,
    groups,
    interval,
    label,
    markdown,
    over_seeds,
    percent,
    pick,
    plural,
    pooled,
    values,
)
from lerobot_vtrefine.cli.results.paper_tables import (
    after_all_practice,
    by_demonstrations,
    demonstrations_table,
    paper_table,
)
from lerobot_vtrefine.cli.results.rows import IMITATION, TUNED, Line, Row, Run

BLOCK = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
LEADING_POINT = re.compile(r"(?<![\d.])\.(?=\d)")
MEASURED = (
    ("in_hand_shift_m", "in-hand shift of successes, median", 1e3, "mm"),
    ("rim_slide_m", "sliding on the rim, median", 1e3, "mm"),
    ("peak_force_n", "peak force, median", 1.0, "N"),
    ("time_to_success_s", "time to success, median (1 s of it is the hold)", 1.0, "s"),
)
HANDLING = (
    ("in_hand_shift_m", "in-hand shift, mm", 1e3, 2),
    ("rim_slide_m", "sliding on the rim, mm", 1e3, 1),
    ("peak_force_n", "peak force, N", 1.0, 1),
    ("failed_contact_force", "ended by force, %", 100.0, 0),
    ("time_to_success_s", "time to success, s", 1.0, 1),
)
"""What fine-tuning's own evaluations measure beside success, over all episodes (the time: over successes)."""
REACHED = (0.5, 0.75, 0.9)
"""Successes whose price in environment steps is told."""


def demo_table(rows: Sequence[Run]) -> str:
    """Imitation beside fine-tuning, with what is missed when a sense is taken away."""
    head = [
        plural("seed", values(pick(rows, variant=TUNED), "seed")),
        IMITATION,
        "after DPPO",
    ]
    body = []
    for name, words in (("", ""), (" without touch", "touch"), (" without vision", "vision")):
        both = [pick(rows, variant=(stage + name).strip()) for stage in (IMITATION, TUNED)]
        if not any(both):
            continue
        count = "/".join(dict.fromkeys(str(row.episodes) for row in both[1] or both[0]))
        plain, taken = (
            f", {count} unseen episodes [95 % interval]",
            f" with {words} replaced by its mean ({count} episodes)",
        )
        body.append(["success" + (taken if words else plain), *(over_seeds(runs, " %") for runs in both)])
    for key, words, scale, unit in MEASURED:
        cells = []
        for stage in (IMITATION, TUNED):
            found = [float(row.extra[key]) for row in pick(rows, variant=stage) if key in row.extra]
            cells.append(f"{scale * median(found):.1f} {unit}" if found else "-")
        body.append([words, *cells])
    return markdown(head, body)


def touch_table(rows: Sequence[Run]) -> str:
    """Touch against vision alone, task by task."""
    body = []
    for task in values(rows, "task"):
        touch, sight = (pick(rows, task=task, policy=name) for name in ("visuo_tactile", "visual"))
        before = [pooled(pick(kind, variant=IMITATION), False, False) for kind in (touch, sight)]
        after = [pick(kind, variant=TUNED) for kind in (touch, sight)]
        cells = [pooled(runs, bounds=False) for runs in after]
        body.append([label(task), " / ".join(before), *cells, difference(after[1], after[0])])
    head = [
        "setting",
        "imitation, touch / vision only",
        "after DPPO, touch",
        "after DPPO, vision only",
        "difference",
    ]
    return markdown(head, body)


def reality_table(rows: Sequence[Run]) -> str:
    """Policies trained in the plain and in the diagnosed simulator, in the stand-in reality and at home."""
    body = []
    for task in values(rows, "task"):
        chosen = pick(rows, task=task)
        named = next((str(row.extra["diagnosis"]) for row in chosen if "diagnosis" in row.extra), "-")
        for world in ("plain", "diagnosed"):
            away, home = (
                over_seeds(pick(chosen, variant=f"{world} in {where}"))
                for where in ("reality", "its own simulator")
            )
            hidden = ": ".join(map(label, task.split(": ")))
            first = [hidden, named] if world == "plain" else ["", ""]
            body.append([*first, f"the {world} simulator", away, home])
    head = ["hidden in the stand-in reality", "diagnosis", "trained in"]
    return markdown([*head, "success in the stand-in reality", "in its own simulator"], body)


def expert_table(rows: Sequence[Run]) -> str:
    """The scripted expert, pair by pair: every body and start beside each other."""
    places = [(body, start) for body in values(rows, "policy") for start in values(rows, "variant")]
    body = [
        [task, *(_counted(pick(rows, task=task, policy=name, variant=start)) for name, start in places)]
        for task in values(rows, "task")
    ]
    head = [
        "pair, diametral clearance",
        *(f"{label(name)}, {LABELS[start]}" for name, start in places),
    ]
    return markdown(head, body)


def _counted(rows: Sequence[Run]) -> str:
    """Successes of all episodes, with the interval."""
    if not rows:
        return "-"
    (row,) = rows
    return f"{row.successes} of {row.episodes} {interval(*wilson_interval(row.successes, row.episodes))}"


def runs_table(rows: Sequence[Run]) -> str:
    """Every task, policy and variant: mean over seeds, worst seed, what it took."""
    body = []
    for runs in groups(rows):
        effort = [average([getattr(row, name) for row in runs]) for name in ("iterations", "env_steps")]
        falls = [float(row.extra["largest_fall"]) for row in runs if "largest_fall" in row.extra]
        cells = [over_seeds(runs), percent(min(row.success for row in runs)), *effort]
        named = [label(runs[0].task), label(runs[0].policy), runs[0].variant or "after DPPO"]
        body.append([*named, *cells, percent(max(falls)) if falls else "-"])
    head = [
        "task",
        "policy",
        "",
        "mean over seeds [t-interval] (each)",
        "worst",
        "iterations",
        "environment steps",
    ]
    return markdown([*head, "largest fall, last half"], body)


def reference_table(rows: Sequence[Run]) -> str:
    """The reference DPPO beside ours: where each ends, and how many environment steps a success cost."""
    body = []
    for runs in groups(rows):
        costs = [[row.extra.get(f"steps_to_{rate}") for row in runs] for rate in REACHED]
        cells = [average([None if cost is None else round(float(cost)) for cost in found]) for found in costs]
        named = [label(runs[0].task), label(runs[0].policy), runs[0].variant]
        body.append([*named, over_seeds(runs), average([row.env_steps for row in runs]), *cells])
    head = ["task", "policy", "learnt by", "held out, at the end", "environment steps"]
    return markdown([*head, *(f"to the first {percent(rate)} %" for rate in REACHED)], body)


def converging(rows: Sequence[Row]) -> list[Run]:
    """The runs of ``converges``."""
    return [row for row in rows if isinstance(row, Run) and row.table == "converges"]


def measured(rows: Sequence[Row]) -> list[Run]:
    """Those of them whose own evaluation measured more than success."""
    return [row for row in converging(rows) if any(f"mean_{key}" in row.extra for key, *_ in HANDLING)]


def senses_table(rows: Sequence[Run]) -> str:
    """What touch gives, task by task: before and after DPPO, paired over the seeds that both have."""
    body = []
    for task in values(rows, "task"):
        both = [pick(rows, task=task, policy=name) for name in ("visuo_tactile", "visual")]
        stages = [[pick(runs, variant=variant) for runs in both] for variant in (IMITATION, TUNED)]
        if all(stages[0]):
            cells = [[*map(over_seeds, stage), difference(stage[1], stage[0])] for stage in stages]
            body.append([label(task), *cells[0], *cells[1]])
    head = ["touch", "vision only", "difference"]
    return markdown(["task", *(f"{stage}, {name}" for stage in ("imitation", "DPPO") for name in head)], body)


def handling_table(rows: Sequence[Run]) -> str:
    """How gently policies handle the parts: before and after DPPO, and what touch changes, over seeds."""
    body = []
    for task in values(rows, "task"):
        for variant, words in ((IMITATION, IMITATION), (TUNED, "after DPPO")):
            touch, sight = (
                pick(rows, task=task, policy=name, variant=variant) for name in ("visuo_tactile", "visual")
            )
            for runs in (touch, sight):
                if runs:
                    cells = [_spread(_extra(runs, key), scale, digits) for key, _, scale, digits in HANDLING]
                    body.append([label(task), words, label(runs[0].policy), *cells])
            if touch and sight:
                cells = [
                    _spread(_changes(_extra(sight, key), _extra(touch, key)), scale, digits, "+")
                    for key, _, scale, digits in HANDLING
                ]
                body.append([label(task), words, "touch minus vision", *cells])
    return markdown(["task", "", "policy", *(words for _, words, *_ in HANDLING)], body)


def _extra(rows: Sequence[Run], key: str) -> dict[int | None, float]:
    """A measured mean by seed."""
    return {row.seed: float(row.extra[f"mean_{key}"]) for row in rows if f"mean_{key}" in row.extra}


def _changes(
    before: Mapping[int | None, float], after: Mapping[int | None, float]
) -> dict[int | None, float]:
    """After minus before, of the seeds that both have."""
    return {seed: value - before[seed] for seed, value in after.items() if seed in before}


def _spread(found: Mapping[int | None, float], scale: float, digits: int, sign: str = "") -> str:
    """Mean over seeds with its t-interval; a dash without any."""
    if not found:
        return "-"
    numbers = [round(scale * value, digits) + 0.0 for value in mean_interval(list(found.values()))]
    middle, low, high = (
        f"{value:{sign if place == 0 else ''}.{digits}f}" for place, value in enumerate(numbers)
    )
    return f"{middle} [{low}, {high}]" if len(found) > 1 else middle


def policies_table(rows: Sequence[Run]) -> str:
    """Policies trained on the same demonstrations, beside each other."""
    body = []
    for runs in groups(rows):
        named = [label(runs[0].task), label(runs[0].policy), runs[0].variant]
        episodes = " / ".join(dict.fromkeys(str(row.episodes) for row in runs))
        body.append([*named, over_seeds(runs, " %"), episodes])
    head = ["task", "policy and what it sees", "trained on", "success: mean over seeds [t-interval] (each)"]
    return markdown([*head, "episodes a seed"], body)


def lines_table(rows: Sequence[Line]) -> str:
    """A benchmark's table as it was printed, with a zero before every decimal point."""
    head = list(max(rows, key=lambda row: len(row.cells)).cells)  # older rows may lack a column
    rows_of_cells = [head, *([row.cells.get(name, "") for name in head] for row in rows)]
    head, *body = [[LEADING_POINT.sub("0.", cell) for cell in cells] for cells in rows_of_cells]
    return markdown(head, body)


RENDERERS: dict[str, Callable[[Sequence], str]] = (
    dict.fromkeys(Run.TABLES, runs_table)
    | dict.fromkeys(Line.TABLES, lines_table)
    | {"demo": demo_table, "touch": touch_table, "reality": reality_table}
    | {"expert": expert_table, "policies": policies_table}
    | dict.fromkeys(("paper", "paper_pads", "paper_practised"), paper_table)
    | dict.fromkeys(("demonstrations", "demonstrations_pads"), demonstrations_table)
    | {"handling": handling_table, "senses": senses_table}
    | {"reference": reference_table}
)

DERIVED: dict[str, Callable[[Sequence[Row]], list[Run]]] = {
    "handling": measured,
    "senses": converging,
    "paper_practised": after_all_practice,
    "demonstrations": by_demonstrations,
    "demonstrations_pads": partial(by_demonstrations, suffix="_pads"),
}
"""Tables that show rows of another one."""


def table(name: str, rows: Sequence[Row]) -> str:
    """One table, and where its figures come from.

    Raises:
        ValueError: there is no such table, or no row of it.
    """
    chosen = DERIVED[name](rows) if name in DERIVED else [row for row in rows if row.table == name]
    if not chosen:
        raise ValueError(f"table {name}: results/ hold no rows of it; tables: {', '.join(RENDERERS)}")
    origin = {field: dict.fromkeys(getattr(row, field) for row in chosen) for field in ("commit", "machine")}
    known = [" / ".join(filter(None, found)) or "not recorded" for found in origin.values()]
    return f"{RENDERERS[name](chosen)}\n\n<sub>Commit: {known[0]}; machine: {known[1]}.</sub>"


def fill(text: str, rows: Sequence[Row]) -> str:
    """A document with every block's table made anew."""
    return BLOCK.sub(lambda block: f"{block[1]}{table(block[2], rows)}\n{block[3]}", text)
