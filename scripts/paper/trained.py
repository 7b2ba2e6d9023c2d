"""Which policies the paper's tables ask for, and what their rows are called."""

import argparse
from dataclasses import dataclass
from typing import Any

from compare_touch import MODALITIES

from lerobot_vtrefine.cli.pipeline.demo_config import EVAL_SEED_OFFSET, SEED_STRIDE
from lerobot_vtrefine.cli.results.published import DEMONSTRATIONS, with_demonstrations
from lerobot_vtrefine.cli.results.rows import IMITATION, SCRATCH, TUNED

PAPERS_OWN = "cloud"
"""Recipe of the paper: one cloud of points and taxels, all of whose network learns with the task."""


@dataclass(frozen=True)
class Trained:
    """One policy: pair, senses, seed, how many demonstrations it learnt from (0: random weights), and the
    recipe of ``vtrefine-demo``."""

    pair: str
    senses: str
    seed: int
    demonstrations: int
    recipe: str

    @property
    def learnt_from(self) -> int:
        """Demonstrations in its dataset, from which random weights take the scale of actions alone."""
        return self.demonstrations or DEMONSTRATIONS

    @property
    def suffix(self) -> str:
        """Tells the recipe in names of files and tables; the paper's own network goes without."""
        return "" if self.recipe == PAPERS_OWN else f"_{self.recipe}"

    @property
    def name(self) -> str:
        """For folders and stages."""
        return f"{self.pair}_{self.senses}_{self.seed}_{self.demonstrations}{self.suffix}"


def chosen(options: argparse.Namespace) -> list[Trained]:
    """Every policy; seeds side by side share the GPUs by turns."""
    counts = [*options.demonstrations, *([] if options.no_scratch else [0])]
    return [
        Trained(pair, senses, seed, count, options.recipe)
        for pair in options.pairs
        for count in counts
        for seed in options.seeds
        for senses in MODALITIES
    ]


def iterations_of(options: argparse.Namespace, policy: Trained) -> int:
    """DPPO iterations: what never succeeds learns nothing, and may be stopped earlier."""
    return options.iterations if policy.demonstrations else options.scratch_iterations


def first_seed(policy: Trained) -> int:
    """Of the evaluation; the same for all policies of a seed."""
    return policy.seed * SEED_STRIDE + EVAL_SEED_OFFSET


def variants(policy: Trained) -> dict[str, str]:
    """What its rows are called, by the stage that is judged."""
    if not policy.demonstrations:
        return {"finetune": SCRATCH}
    return {"imitation": IMITATION, "finetune": TUNED}


def table_of(policy: Trained) -> str:
    """The table that has its rows. That by number of demonstrations shows the paper's own number, too."""
    kind = "paper" if policy.demonstrations in (0, DEMONSTRATIONS) else "demonstrations"
    return f"{kind}{policy.suffix}"


def key(policy: Trained, kind: str) -> dict[str, Any]:
    """Table, task, policy, variant and seed of a row."""
    table = table_of(policy)
    named = kind if table.startswith("paper") else with_demonstrations(policy.demonstrations, kind)
    identity = {"table": table, "task": f"automate/{policy.pair}", "policy": policy.senses}
    return identity | {"variant": named, "seed": policy.seed}
