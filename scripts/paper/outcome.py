"""A row of the paper's tables from what was judged."""

import argparse
import json
import sys
from typing import Any

from lerobot_vtrefine.cli.report.results import load_evaluation
from lerobot_vtrefine.cli.results.collect import largest_fall, last_steps
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Progress, Row, Run, read_rows
from lerobot_vtrefine.cli.results.tables import MEASURED
from lerobot_vtrefine.finetune.logger import read_progress
from paper.trained import Trained, first_seed, iterations_of, key, table_of, variants

NO_ROOM = "failed_overflow"
LOST = 0.01
"""Share of episodes without room above which what is left is no result."""
MORE_ROOM = {"contacts_per_world": 1024, "convex_per_world": 64, "rows_per_world": 8192}
"""More than any pair's file has."""


def row_of(
    options: argparse.Namespace, policy: Trained, stage: str, commit: str | None
) -> tuple[Row, Progress]:
    """What was found of ``imitation`` or ``finetune``; the learning curve beside the tuned policy."""
    tuned = stage == "finetune"
    progress = read_progress(options.output_dir / f"finetune_{policy.name}") if tuned else []
    judged = load_evaluation(options.output_dir / f"eval_{stage}_{policy.name}", first_seed(policy))
    medians = judged["metrics"]["successes"]
    extra = {key: medians[key]["median"] for key, *_ in MEASURED if medians.get(key)}
    extra |= failures(judged)
    tell_of_room(f"{stage} of {policy.name}", extra.get(NO_ROOM, 0.0))
    if tuned:
        extra |= {"largest_fall": largest_fall(progress)}
        tell_of_room(f"an iteration of {policy.name}", most_without_room(progress))
    row = Run(
        **key(policy, variants(policy)[stage]),
        success=judged["success"] / judged["episodes"],
        episodes=judged["episodes"],
        iterations=iterations_of(options, policy) if tuned else 0,
        env_steps=last_steps(progress) if tuned else 0,
        extra=extra,
        **provenance() | {"commit": commit or options.commit},
    )
    return row, progress


def failures(judged: dict[str, Any]) -> dict[str, float]:
    """Shares of an evaluation's episodes: both parts picked up, and what ended those that failed."""
    shares = {
        f"failed_{name.replace(' ', '_').replace('-', '_')}": count / judged["episodes"]
        for name, count in judged["failures"].items()
    }
    if judged["picked_up"] is not None:
        shares["picked_up"] = judged["picked_up"]
    return {name: round(share, 4) for name, share in sorted(shares.items())}


def most_without_room(progress: Progress) -> float:
    """The largest share of an iteration's episodes that the simulation ended by itself."""
    return max((iteration.get(NO_ROOM, 0.0) for iteration in progress), default=0.0)


def tell_of_room(name: str, share: float) -> None:
    """Warn where the simulation ended episodes by itself: worlds share their room, and whole batches end."""
    if share > LOST:
        print(
            f"warning: {name}: {share:.0%} of the episodes ended because the simulation had no room for more"
            " contacts; start anew with more, "
            f"--env='{json.dumps({'warp': MORE_ROOM})}'",
            file=sys.stderr,
        )


def is_done(options: argparse.Namespace, policy: Trained) -> bool:
    """Whether all rows of a policy are there, with these numbers of episodes and iterations."""
    path = options.results / f"{table_of(policy)}.json"
    there = {row.key: row for row in (read_rows(path) if path.is_file() else []) if isinstance(row, Run)}
    for stage, kind in variants(policy).items():
        row = there.get(tuple(key(policy, kind).values()))
        wanted = iterations_of(options, policy) if stage == "finetune" else 0
        if row is None or (row.episodes, row.iterations) != (options.episodes, wanted):
            return False
    return True
