"""Cells of the results' tables: rows chosen and grouped, rates with intervals, words.

Brackets hold 95 % intervals, Wilson's over pooled episodes or Student's t over seeds; parentheses hold each
seed.
"""

from collections.abc import Iterator, Sequence
from statistics import mean

from lerobot_vtrefine.cli.report.statistics import mean_interval, rate_interval, wilson_interval
from lerobot_vtrefine.cli.results.rows import Run

LABELS = {
    "demo": "demo: round pair, 2 mm clearance",
    "round_grasped": "round pair, 2 mm, slip 2 mm / 0.05 rad",
    "round_grasped_fine": "the same pair, 12 iterations of fine",
    "demo_schedule": "the demo, 128 environments on two cores",
    "kinova_blind_cloud": "two Kinova Gen3, round pair, the paper's cloud, camera blocked, two cores",
    "kinova_blind": "two Kinova Gen3, round pair, pads as images, camera blocked, two cores",
    "kinova_pads": "two Kinova Gen3, round pair, pads as images, two cores",
    "kinova_1024": "two Kinova Gen3, round pair, 1024 worlds",
    "cross_gentle": "cross, 2 mm, 5 N at most (cross_gentle)",
    "cross_gentle_twin": "its twin: parts lie as expected (cross_gentle_twin)",
    "cross_gentle_tuned": "cross_gentle, DPPO in the simulator named, all before it in the plain one",
    "d_occluded": "D shape, hidden by the hands, 5 N at most (d_occluded)",
    "d_occluded_2048": "d_occluded, 2048 worlds, 60 iterations in smaller steps, falls undone",
    "d_occluded_twin": "its twin: parts lie as expected (d_occluded_twin)",
    "cross_limited": "cross, 2 mm, a limit of 1.5 to 10 N that is told (cross_limited)",
    "cross_limited_1000": "cross_limited, 1000 demonstrations, 30 iterations in smaller steps",
    "cross_limited_twin": "its twin: parts lie as expected, one friction (cross_limited_twin)",
    "key_1mm": "key pair, 1 mm, slip 2 mm / 0.05 rad",
    "tight": "tight: 1 mm clearance",
    "occluded": "occluded: camera above, the hole hidden",
    "slip": "slip: twice the pose error in the hand",
    "square_1mm_slip": "square pair, 1 mm, slip 4 mm / 0.1 rad",
    "short_chunk": "short_chunk: decisions twice as often",
    "row_sharing+hysteresis": "row sharing, hysteresis",
    "row_sharing+hysteresis+drift": "row sharing 1/255 per count, loop of 17 %, 5 counts of drift",
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


def share(successes: int, episodes: int, unit: str = "") -> str:
    """A share of episodes in per cent with Wilson's interval, for example ``68 [62, 75]``."""
    return f"{percent(successes / episodes)}{unit} {interval(*wilson_interval(successes, episodes))}"


def pooled(rows: Sequence[Run], seeds: bool = True, bounds: bool = True, unit: str = "") -> str:
    """Success over all episodes with Wilson's interval, and each seed's; a dash without rows."""
    if not rows:
        return "-"
    whole = [row for row in rows if row.seed is None] or rows
    successes, episodes = sum(row.successes for row in whole), sum(row.episodes for row in whole)
    text = share(successes, episodes, unit) if bounds else percent(successes / episodes) + unit
    single = [percent(row.success) for row in rows if row.seed is not None]
    return f"{text} ({', '.join(single)})" if seeds and len(single) > 1 else text


def over_seeds(rows: Sequence[Run], unit: str = "") -> str:
    """Mean success over seeds with its t-interval, as far as a success can lie in it, and each seed's.

    Of one seed, or of all without a row each, as `pooled` tells it.
    """
    rates = [row.success for row in rows if row.seed is not None]
    if len(rates) < 2:
        return pooled(rows, unit=unit)
    middle, *bounds = rate_interval(rates)
    return f"{percent(middle)}{unit} {interval(*bounds)} ({', '.join(map(percent, rates))})"


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


def average(counts: Sequence[int | None]) -> str:
    """Mean of counts with thin groups of thousands; a dash where one was not recorded."""
    known = [count for count in counts if count is not None]
    return f"{mean(known):,.0f}".replace(",", " ") if known and len(known) == len(counts) else "-"
