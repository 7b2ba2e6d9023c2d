"""Pictures of what was learnt, from results/."""

import csv
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from figures.common import BLUE, GREY, IMAGES, ORANGE, ROOT
from lerobot_vtrefine.cli.results.paper_tables import practised
from lerobot_vtrefine.cli.results.published import PAIRS
from lerobot_vtrefine.cli.results.rows import IMITATION, TUNED, Run, read_all

CURVES = {
    "round pair": {"R.c8.k12": "12 to 3 nats per decision", "R.g4.k24": "24 to 3"},
    "square pair, 1 mm, more slip": {"B.g8.k12": "12 to 3", "B.g8.k40": "40 to 2"},
}
"""Learning curves that show what the size of a step does, by their names in results/step_size_curves.csv."""
LIMITED = "rate limited to 2e-4"
LIMITS = {
    "limited to 2e-4": (
        (f"{LIMITED}, seeds it was chosen on", LIMITED),
        BLUE,
    ),
    "without a limit": (("rate without a limit, 108 iterations",), ORANGE),
}
"""Runs of VISION, by the variants of their rows."""
VISION = ("square_1mm_slip", "visual")
POLICIES = {"visuo_tactile": BLUE, "visual": ORANGE}
LEARNED = {
    "cross_gentle": "needs touch: cross, 5 N",
    "cross_gentle_twin": "its twin needs none",
    "d_occluded_2048": "needs touch: hidden D",
    "cross_limited_1000": "needs touch: told limit",
    "square_1mm_slip": "square, 1 mm",
}
"""Tasks of the table ``converges`` whose stages are drawn."""
STAGES = {
    "imitation": (IMITATION, f"{LIMITED}, {IMITATION}"),
    "after DPPO": (TUNED, LIMITED),
}
"""Variants of rows: of a task with more than one, the last is by today's preset."""
TASKS = {
    "demo": "round,\n2 mm",
    "tight": "round,\n1 mm",
    "occluded": "hole\nhidden",
    "slip": "twice\nthe slip",
    "short_chunk": "decisions\ntwice as often",
}


def draw_dppo(plt: Any) -> None:
    """Success over iterations, at three step sizes."""
    with (ROOT / "results" / "step_size_curves.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    figure, axes = plt.subplots(1, 2, figsize=(8.8, 3.2), sharey=True, layout="constrained")
    for ax, (title, runs) in zip(axes, CURVES.items(), strict=True):
        for (run, words), colour in zip(runs.items(), (BLUE, ORANGE), strict=True):
            points = [
                (int(r["iteration"]), 100 * float(r["success"]))
                for r in rows
                if r["run"] == run and r["success"]
            ]
            ax.plot(*zip(*sorted(points), strict=True), color=colour, lw=2, label=words)
        ax.set_title(title, loc="left")
        ax.set(xlabel="iteration of 1024 episodes", ylim=(0, 100))
        ax.legend(frameon=False, loc="upper left" if "square" in title else "lower right")
    axes[0].set_ylabel("success [%]")
    figure.savefig(IMAGES / "dppo.png")


def draw_rate(plt: Any) -> None:
    """Success and learning rate over iterations, with a limit of the rate and without."""
    rows = [row for row in read_all(ROOT / "results") if isinstance(row, Run) and row.curve]
    figure, (above, below) = plt.subplots(1, 2, figsize=(8.8, 3.2), layout="constrained")
    for words, (variants, colour) in LIMITS.items():
        label: str | None = words
        for row in (row for row in rows if (row.task, row.policy) == VISION and row.variant in variants):
            points = iterations(row)
            at = [int(point["iteration"]) for point in points]
            above.plot(at, [100 * float(p["success"]) for p in points], color=colour, lw=1, label=label)
            below.semilogy(at, [float(p["actor_lr"]) for p in points], color=colour, lw=1)
            label = None
    above.set(title="success while exploring [%]", xlabel="iteration of 1024 episodes", ylim=(0, 100))
    below.set(title="learning rate", xlabel="iteration of 1024 episodes")
    above.legend(frameon=False, loc="lower right")
    figure.savefig(IMAGES / "rate.png")


def draw_paper(plt: Any, table: str) -> None:
    """A table's pairs: success while exploring, as judged between and after, and as the paper has it."""
    found = [row for row in read_all(ROOT / "results") if isinstance(row, Run)]
    rows = practised(found) if table == "paper" else [row for row in found if row.table == table]
    rows = [row for row in rows if row.variant == TUNED]
    pairs = sorted({row.task for row in rows})
    figure, (axes,) = plt.subplots(
        1, len(pairs), figsize=(4.4 * len(pairs), 3.6), sharey=True, layout="constrained", squeeze=False
    )
    for ax, task in zip(axes, pairs, strict=True):
        for row in (row for row in rows if row.task == task):
            colour, curve = POLICIES[row.policy], [100 * float(point["success"]) for point in iterations(row)]
            end = row.iterations or len(curve)
            ax.plot(range(end - len(curve), end), curve, color=colour, lw=1.2)
            ax.plot(end, 100 * row.success, "o", ms=5, color=colour)
        for policy, colour in POLICIES.items():
            ax.axhline(100 * PAIRS[task][policy][TUNED], color=colour, ls="--", lw=0.8)
        ax.set_title(task, loc="left")
        ax.set(xlabel="iteration of 1024 episodes", ylim=(0, 102))
    axes[0].set_ylabel("success [%]")
    handles = [
        Patch(color=BLUE, label="vision and touch"),
        Patch(color=ORANGE, label="vision only"),
        Line2D([], [], color=GREY, label="while exploring"),
        Line2D([], [], color=GREY, marker="o", ls="", ms=5, label="held out"),
        Line2D([], [], color=GREY, ls="--", lw=0.8, label="the paper"),
    ]
    columns = len(handles) if len(pairs) > 1 else 2
    figure.legend(handles=handles, ncols=columns, frameon=False, loc="outside lower center")
    figure.savefig(IMAGES / f"{table}.png")


def iterations(row: Run) -> list[dict[str, str]]:
    """A run's learning curve, without the evaluation before it; of one that another's curve holds none."""
    if row.curve is None:
        return []
    with (ROOT / "results" / row.curve).open(encoding="utf-8") as file:
        return [point for point in csv.DictReader(file) if point["success"]]


def draw_results(plt: Any) -> None:
    """Success with touch and without: where it is needed and where not, with the paper's cloud."""
    rows = [row for row in read_all(ROOT / "results") if isinstance(row, Run)]
    figure, (*left, right) = plt.subplots(
        1,
        len(LEARNED) + 1,
        figsize=(16.5, 4.0),
        sharey=True,
        width_ratios=[*[2] * len(LEARNED), 5],
        layout="constrained",
    )
    for ax, (task, title) in zip(left, LEARNED.items(), strict=True):
        draw_stages(ax, [row for row in rows if row.table == "converges" and row.task == task])
        ax.set_title(title, loc="left")
    for place, task in enumerate(TASKS):
        for side, (policy, colour) in enumerate(POLICIES.items()):
            mine = [r for r in rows if (r.table, r.task, r.policy) == ("touch", task, policy)]
            x = place + (side - 0.5) * 0.36
            draw_seeds(right, x, [100 * r.success for r in mine if r.variant == TUNED], colour)
            before = np.mean([100 * r.success for r in mine if r.variant == IMITATION])
            right.plot([x - 0.15, x + 0.15], [before] * 2, color="black", lw=1.5, zorder=3)
    right.set_xticks(range(len(TASKS)), list(TASKS.values()), fontsize=11)
    right.set_title("the paper's cloud, easier tasks, after DPPO", loc="left")
    left[0].set(ylabel="success [%]", ylim=(0, 103))
    handles = [
        Patch(color=BLUE, alpha=0.45, label="vision and touch"),
        Patch(color=ORANGE, alpha=0.45, label="vision only"),
        Line2D([], [], marker="o", ls="", ms=4, color=GREY, label="one seed"),
        Line2D([], [], color="black", label="imitation before it"),
    ]
    figure.legend(handles=handles, ncols=4, frameon=False, loc="outside lower center")
    figure.savefig(IMAGES / "results.png")


def draw_stages(ax: Any, rows: list[Run]) -> None:
    """One task's success before and after DPPO."""
    for place, variants in enumerate(STAGES.values()):
        variant = [name for name in variants if any(row.variant == name for row in rows)][-1]
        for side, (policy, colour) in enumerate(POLICIES.items()):
            found = [100 * r.success for r in rows if (r.policy, r.variant) == (policy, variant)]
            draw_seeds(ax, place + (side - 0.5) * 0.36, found, colour)
    ax.set_xticks(range(len(STAGES)), list(STAGES))


def draw_seeds(ax: Any, x: float, found: list[float], colour: str) -> None:
    """A bar of the mean with a dot for every seed."""
    ax.bar(x, np.mean(found), 0.32, color=colour, alpha=0.45)
    ax.plot(x + np.linspace(-0.1, 0.1, len(found)), found, "o", ms=4, color=colour, zorder=4)
