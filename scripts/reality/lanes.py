"""Which policies a comparison needs, where each is judged, and what runs side by side."""

from lerobot_vtrefine.cli.pipeline.stages import Stage
from reality.budget import Budget, folder_name
from reality.stages import diagnosis_stages, finetune_stage, imitation_stages, judging_stage

Lanes = dict[str, list[Stage]]
"""Stages that run one after the other, by name."""


def cells(name: str) -> dict[str, tuple[str, str]]:
    """The comparison's cells for a reality: pairs (trained in, evaluated in) by what they are called."""
    real, model = f"real:{name}", f"diagnosed:{name}"
    return {
        "plain in reality": ("plain", real),
        "plain in its own simulator": ("plain", "plain"),
        "diagnosed in reality": (model, real),
        "diagnosed in its own simulator": (model, model),
    }


def evaluations(budget: Budget) -> list[tuple[str, str]]:
    """Pairs (trained in, evaluated in) of all realities."""
    return list(dict.fromkeys(pair for name in budget.realities for pair in cells(name).values()))


def lanes(budget: Budget) -> tuple[Lanes, Lanes]:
    """What runs side by side: every simulator's preparation first, then its policies, by seed."""
    before, policies = {"plain": imitation_stages(budget, "plain")}, {}
    for name in budget.realities:
        world = f"diagnosed:{name}"
        before[folder_name(world)] = [*diagnosis_stages(budget, name), *imitation_stages(budget, world)]
    for world in ("plain", *(f"diagnosed:{name}" for name in budget.realities)):
        pairs = [pair for pair in evaluations(budget) if pair[0] == world]
        for seed in budget.seeds:
            judged = [judging_stage(budget, *pair, seed) for pair in pairs]
            lane = folder_name("policy", world, str(seed))
            policies[lane] = [*before[folder_name(world)], finetune_stage(budget, world, seed), *judged]
    return before, policies


def needed(before: Lanes, policies: Lanes) -> dict[str, list[str]]:
    """The preparations that every policy goes on from."""
    return {
        name: [world for world, stages in before.items() if stages[-1] in lane]
        for name, lane in policies.items()
    }
