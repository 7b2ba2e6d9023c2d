"""Tables that set our figures beside the paper's own, from rows and from ``published``."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from statistics import mean
from typing import Any

from lerobot_vtrefine.cli.results.cells import (
    difference,
    label,
    markdown,
    over_seeds,
    percent,
    pick,
    values,
)
from lerobot_vtrefine.cli.results.published import (
    BY_DEMONSTRATIONS,
    DEMONSTRATIONS,
    KINDS,
    PAIRS,
    with_demonstrations,
)
from lerobot_vtrefine.cli.results.rows import IMITATION, TUNED, Row, Run

BESIDE = ("vision only", "the paper's", "touch", "the paper's", "touch minus vision", "the paper's")
"""Columns of the tables that stand beside the paper's."""
FURTHER = tuple(
    f"the paper's own network, {words}"
    for words in (
        *(f"{count} iterations more" for count in (14, 21, 28)),
        "last practice",
        "last practice gone on",
    )
)
"""Variants among what was tried: policies of the paper's table that practised on."""
JUDGED_ANEW = "the paper's own network, judged anew, both edges tried"
"""The variant of those that were judged as they were, once the simulator had changed."""


def paper_table(rows: Sequence[Run]) -> str:
    """Pair by pair beside the paper's own numbers, and the mean of the pairs that have both senses, over the
    seeds that all of them have."""
    body = []
    for kind, words in KINDS.items():
        whole: dict[str, list[list[Run]]] = {"visual": [], "visuo_tactile": []}
        printed: dict[str, list[float]] = {"visual": [], "visuo_tactile": []}
        for task in (name for name in PAIRS if pick(rows, task=name, variant=kind)):
            found = {name: pick(rows, task=task, policy=name, variant=kind) for name in whole}
            theirs = {name: PAIRS[task][name][kind] for name in whole}
            body.append([words, label(task), *beside_the_paper(found, theirs)])
            if all(found.values()):
                for name in whole:
                    whole[name].append(found[name])
                    printed[name].append(theirs[name])
        means = {name: mean_by_seed(runs) for name, runs in whole.items()}
        if len(whole["visual"]) > 1 and all(means.values()):
            theirs = {name: mean(values) for name, values in printed.items()}
            body.append([words, f"mean of {len(whole['visual'])}", *beside_the_paper(means, theirs)])
    return markdown(["", "pair", *BESIDE], body)


def practised(rows: Sequence[Row], variants: Collection[str] = FURTHER) -> list[Run]:
    """The paper's table after DPPO, and those of ``variants`` that went on from there, as rows of the table;
    their iterations are counted from imitation on."""
    runs = [row for row in rows if isinstance(row, Run)]
    return [run for run in runs if run.table == "paper" and run.variant == TUNED] + [
        replace(run, table="paper", variant=TUNED) for run in runs if run.variant in variants
    ]


def after_all_practice(rows: Sequence[Row]) -> list[Run]:
    """Of every policy of the paper's table the one that practised longest, as it was judged last."""
    latest: dict[tuple[Any, ...], Run] = {}
    for run in practised(rows, (*FURTHER, JUDGED_ANEW)):
        if run.key not in latest or (run.iterations or 0) >= (latest[run.key].iterations or 0):
            latest[run.key] = run
    return list(latest.values())


def by_demonstrations(rows: Sequence[Row], suffix: str = "") -> list[Run]:
    """Those of its own, and of the paper's table those of the same pairs: they learnt from its number.

    ``suffix``, as of ``_pads``, tells the tables of another recipe.
    """
    runs = [row for row in rows if isinstance(row, Run)]
    own = [row for row in runs if row.table == f"demonstrations{suffix}"]
    tasks = values(own, "task")
    return own + [
        replace(row, variant=with_demonstrations(DEMONSTRATIONS, row.variant))
        for row in runs
        if row.table == f"paper{suffix}" and row.task in tasks and row.variant in (IMITATION, TUNED)
    ]


def demonstrations_table(rows: Sequence[Run]) -> str:
    """The same by number of demonstrations, on one pair."""
    body = []
    for count, printed in BY_DEMONSTRATIONS.items():
        for kind in (IMITATION, TUNED):
            variant = with_demonstrations(count, kind)
            found = {name: pick(rows, policy=name, variant=variant) for name in printed}
            if any(found.values()):
                theirs = {name: values[kind] for name, values in printed.items()}
                body.append([KINDS[kind], str(count), *beside_the_paper(found, theirs)])
    return markdown([", ".join(map(label, values(rows, "task"))), "demonstrations", *BESIDE], body)


def beside_the_paper(found: Mapping[str, Sequence[Run]], theirs: Mapping[str, float]) -> list[str]:
    """The cells of ``BESIDE``."""
    cells = []
    for name in ("visual", "visuo_tactile"):
        cells += [over_seeds(found[name]), percent(theirs[name])]
    gain = theirs["visuo_tactile"] - theirs["visual"]
    return [*cells, difference(found["visual"], found["visuo_tactile"]), f"{100 * gain:+.0f}"]


def mean_by_seed(pairs: Sequence[Sequence[Run]]) -> list[Run]:
    """Every seed's mean over the pairs, of the seeds that all of them have."""
    first = pairs[0] if pairs else []
    seeds = [run.seed for run in first if all(run.seed in [row.seed for row in runs] for runs in pairs)]
    means = []
    for seed in seeds:
        rows = [row for runs in pairs for row in runs if row.seed == seed]
        episodes = sum(row.episodes for row in rows)
        means.append(replace(rows[0], success=mean(row.success for row in rows), episodes=episodes))
    return means
