"""Markdown tables from rows, and the documents' blocks that hold them.

A block is what lies between ``<!-- table: NAME -->`` and ``<!-- end -->``. Brackets hold 95 % intervals,
Wilson's over pooled episodes or Student's t over seeds; parentheses hold each seed.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from statistics import mean, median

from lerobot_vtrefine.cli.report.statistics import mean_interval, wilson_interval
from lerobot_vtrefine.cli.results.rows import Line, Row, Run

IMITATION = "imitation"
BLOCK = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
LEADING_POINT = re.compile(r"(?<![\d.])\.(?=\d)")
LABELS = {
    "demo": "demo: round pair, 2 mm clearance",
    "round_grasped": "round pair, 2 mm, slip 2 mm / 0.05 rad",
    "demo_schedule": "the demo, 128 environments on two cores",
    "kinova_blind_cloud": "two Kinova Gen3, round pair, the paper's cloud, camera blocked, two cores",
    "kinova_blind": "two Kinova Gen3, round pair, pads as images, camera blocked, two cores",
    "kinova_pads": "two Kinova Gen3, round pair, pads as images, two cores",
    "cross_gentle": "cross, 2 mm, 5 N at most (cross_gentle)",
    "tight": "tight: 1 mm clearance",
    "occluded": "occluded: camera above, the hole hidden",
    "slip": "slip: twice the pose error in the hand",
    "square_1mm_slip": "square pair, 1 mm, slip 4 mm / 0.1 rad",
    "short_chunk": "short_chunk: decisions twice as often",
    "row_sharing+hysteresis": "row sharing, hysteresis",
    "latency+taxel_gain_spread": "latency 0.2 s, gain spread 0.5",
    "control_latency+backlash": "commands 0.1 s late, 20 mrad of play in all arm joints",
    "visuo_tactile": "touch",
    "visual": "vision only",
    "aloha": "ALOHA",
    "kinova": "two Kinova Gen3",
    "table": "from the table",
    "grasped": "in hand",
    "vt_dp3_pads": "vt_dp3: touch and depth",
    "vt_dp3_pads_visual": "vt_dp3: depth",
    "act_rgb": "LeRobot's ACT: colour",
    "diffusion_rgb": "LeRobot's diffusion policy: colour",
}
"""Tasks and policies in words; others stand as they are."""
MEASURED = (
    ("in_hand_shift_m", "in-hand shift of successes, median", 1e3, "mm"),
    ("rim_slide_m", "sliding on the rim, median", 1e3, "mm"),
    ("peak_force_n", "peak force, median", 1.0, "N"),
    ("time_to_success_s", "time to success, median (1 s of it is the hold)", 1.0, "s"),
)
WORLDS = (
    ("start", "the start"),
    ("plain", "then the plain simulator"),
    ("diagnosed", "then the diagnosed one"),
)


def label(name: str) -> str:
    """A task or policy in words."""
    return LABELS.get(name, name)


def pick(rows: Sequence[Run], **wanted: str) -> list[Run]:
    """The rows with these values, by seed."""
    found = [row for row in rows if all(getattr(row, name) == value for name, value in wanted.items())]
    return sorted(found, key=lambda row: -1 if row.seed is None else row.seed)


def values(rows: Sequence[Run], name: str) -> list[str]:
    """What a field takes on, in the rows' order."""
    return list(dict.fromkeys(getattr(row, name) for row in rows))


def groups(rows: Sequence[Run]) -> Iterator[list[Run]]:
    """The runs of every task, policy and variant, by seed; groups in the rows' order."""
    for task in values(rows, "task"):
        of_task = pick(rows, task=task)
        for policy in values(of_task, "policy"):
            of_policy = pick(of_task, policy=policy)
            for variant in values(of_policy, "variant"):
                yield pick(of_policy, variant=variant)


def markdown(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [f"|{'|'.join(f' {cell} ' if cell else ' ' for cell in cells)}|" for cells in (head, *body)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def percent(value: float) -> str:
    """A share in per cent, without the sign."""
    return f"{100 * value:.0f}"


def interval(low: float, high: float) -> str:
    """For example ``[62, 75]``."""
    return f"[{percent(low)}, {percent(high)}]"


def pooled(rows: Sequence[Run], seeds: bool = True, bounds: bool = True, unit: str = "") -> str:
    """Success over all episodes with Wilson's interval, and each seed's; a dash without rows."""
    if not rows:
        return "-"
    whole = [row for row in rows if row.seed is None] or rows
    successes, episodes = sum(row.successes for row in whole), sum(row.episodes for row in whole)
    text = percent(successes / episodes) + unit
    text += " " + interval(*wilson_interval(successes, episodes)) if bounds else ""
    single = [percent(row.success) for row in rows if row.seed is not None]
    return f"{text} ({', '.join(single)})" if seeds and len(single) > 1 else text


def over_seeds(rows: Sequence[Run], unit: str = "") -> str:
    """Mean success over seeds with the t-interval, and each seed's; of one seed, as `pooled` tells it."""
    if len(rows) < 2:
        return pooled(rows, unit=unit)
    middle, *bounds = mean_interval([row.success for row in rows])
    return f"{percent(middle)}{unit} {interval(*bounds)} ({', '.join(percent(row.success) for row in rows)})"


def difference(one: Sequence[Run], two: Sequence[Run]) -> str:
    """Two minus one over the seeds that both have, in points, with the t-interval."""
    before = {row.seed: row.success for row in one}
    changes = [row.success - before[row.seed] for row in two if row.seed in before and row.seed is not None]
    if not changes:
        return "-"
    middle, *bounds = mean_interval(changes)
    return f"{100 * middle:+.0f}" + (f" {interval(*bounds)}" if len(changes) > 1 else "")


def plural(noun: str, numbers: Sequence[object]) -> str:
    """For example ``seed 0`` or ``seeds 0, 1``."""
    return f"{noun}{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers))}"


def demo_table(rows: Sequence[Run]) -> str:
    """Imitation beside fine-tuning, with what is missed when a sense is taken away."""
    head = [
        plural("seed", values(pick(rows, variant=""), "seed")),
        IMITATION,
        "after DPPO",
    ]
    body = []
    for name, words in (("", ""), (" without touch", "touch"), (" without vision", "vision")):
        both = [pick(rows, variant=(stage + name).strip()) for stage in (IMITATION, "")]
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
        for stage in (IMITATION, ""):
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
        after = [pick(kind, variant="") for kind in (touch, sight)]
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
    """Policies tuned in the plain and in the diagnosed simulator, in the stand-in reality and at home."""
    body = []
    for task in values(rows, "task"):
        chosen = pick(rows, task=task)
        named = next((str(row.extra["diagnosis"]) for row in chosen if "diagnosis" in row.extra), "-")
        for world, words in WORLDS:
            home = "the plain simulator" if world == "start" else "its own simulator"
            away = pooled(pick(chosen, variant=f"{world} in reality"), seeds=world != "start")
            first = [label(task), named] if world == "start" else ["", ""]
            body.append(
                [*first, words, away, pooled(pick(chosen, variant=f"{world} in {home}"), seeds=False)]
            )
    head = ["hidden in the stand-in reality", "diagnosis", "fine-tuned in"]
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


def policies_table(rows: Sequence[Run]) -> str:
    """Policies trained on the same demonstrations, beside each other."""
    body = []
    for runs in groups(rows):
        named = [label(runs[0].task), label(runs[0].policy), runs[0].variant]
        episodes = " / ".join(dict.fromkeys(str(row.episodes) for row in runs))
        body.append([*named, over_seeds(runs, " %"), episodes])
    head = ["task", "policy and what it sees", "trained on", "success: mean over seeds [t-interval] (each)"]
    return markdown([*head, "episodes a seed"], body)


def average(counts: Sequence[int | None]) -> str:
    """Mean of counts with thin groups of thousands; a dash where one was not recorded."""
    known = [count for count in counts if count is not None]
    return f"{mean(known):,.0f}".replace(",", " ") if known and len(known) == len(counts) else "-"


def lines_table(rows: Sequence[Line]) -> str:
    """A benchmark's table as it was printed, with a zero before every decimal point."""
    head = list(rows[0].cells)
    rows_of_cells = [head, *([row.cells.get(name, "") for name in head] for row in rows)]
    head, *body = [[LEADING_POINT.sub("0.", cell) for cell in cells] for cells in rows_of_cells]
    return markdown(head, body)


RENDERERS: dict[str, Callable[[Sequence], str]] = (
    dict.fromkeys(Run.TABLES, runs_table)
    | dict.fromkeys(Line.TABLES, lines_table)
    | {"demo": demo_table, "touch": touch_table, "twin": touch_table, "reality": reality_table}
    | {"expert": expert_table, "policies": policies_table}
)


def table(name: str, rows: Sequence[Row]) -> str:
    """One table, and where its figures come from.

    Raises:
        ValueError: there is no such table, or no row of it.
    """
    chosen = [row for row in rows if row.table == name]
    if not chosen:
        raise ValueError(f"table {name}: results/ hold no rows of it; tables: {', '.join(RENDERERS)}")
    origin = {field: dict.fromkeys(getattr(row, field) for row in chosen) for field in ("commit", "machine")}
    known = [" / ".join(filter(None, found)) or "not recorded" for found in origin.values()]
    return f"{RENDERERS[name](chosen)}\n\n<sub>Commit: {known[0]}; machine: {known[1]}.</sub>"


def fill(text: str, rows: Sequence[Row]) -> str:
    """A document with every block's table made anew."""
    return BLOCK.sub(lambda block: f"{block[1]}{table(block[2], rows)}\n{block[3]}", text)
