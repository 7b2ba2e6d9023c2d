"""What the two-process test runs under torchrun; each rank writes what it found to the folder it is given."""

import gc
import json
import sys
from pathlib import Path
from typing import Any

import torch
from test_dppo import problem, small_config
from tiny_policy import ReachEnv

from lerobot_vtrefine.finetune import pipeline
from lerobot_vtrefine.finetune.config import SmallDppo
from lerobot_vtrefine.finetune.distributed import join_ranks, mean_over_ranks, rank_index
from lerobot_vtrefine.finetune.dppo import Rollout, collect, update


def part_of(rollout: Rollout, envs: range) -> Rollout:
    """The experience of some of the environments."""
    rows = (rollout.env >= envs.start) & (rollout.env < envs.stop)
    columns = slice(envs.start, envs.stop)
    return Rollout(
        obs={key: value[rows] for key, value in rollout.obs.items()},
        latents=rollout.latents[rows],
        log_probs=rollout.log_probs[rows],
        means=rollout.means[rows],
        step=rollout.step[rows],
        env=rollout.env[rows] - envs.start,
        privileged=rollout.privileged[:, columns],
        reward=rollout.reward[:, columns],
        terminated=rollout.terminated[:, columns],
        truncated=rollout.truncated[:, columns],
        active=rollout.active[:, columns],
        success=rollout.success[columns],
        info={key: value[columns] for key, value in rollout.info.items()},
    )


def updated_weights(envs: list[range], ranks: int) -> list[torch.Tensor]:
    """Actor and critic after one update on the same experience, split over ranks as ``envs`` says."""
    cfg = small_config(
        critic_warmup=0, epochs=2, minibatch_decisions=10_000, reward_scaling=True, num_envs=12
    )
    env, agent, state = problem(cfg)
    state.generator.manual_seed(0)  # the same experience everywhere; ranks differ only in the part they keep
    rollout = collect(env, agent, cfg, state.generator, range(env.num_envs))
    mine = part_of(rollout, envs[rank_index()]) if ranks > 1 else rollout
    state.critic.update_moments(mine.privileged[:-1][mine.active])
    metrics = update(mine, agent, state, cfg)
    weights = [
        p.detach().flatten() for module in (agent.actor, state.critic.net) for p in module.parameters()
    ]
    return [torch.cat(weights), torch.tensor([metrics["approx_kl"], metrics["value_loss"]])]


def main(folder: Path, checkpoint: Path) -> None:
    torch.set_num_threads(1)
    alone = updated_weights([], ranks=1)
    join_ranks(torch.device("cpu"))
    together = updated_weights([range(0, 3), range(3, 12)], ranks=2)  # unequal shares
    own = torch.tensor([1.0, torch.nan]) if rank_index() == 0 else torch.tensor([4.0, 4.0])
    noise = problem(small_config())[2].generator.initial_seed()
    found: dict[str, Any] = {
        "noise": noise,
        "difference": float((alone[0] - together[0]).abs().max()),
        "moved": float((alone[0] - updated_weights([range(0, 3), range(0, 3)], ranks=2)[0]).abs().max()),
        "metrics": [float(a) for a in (alone[1] - together[1]).abs()],
        "mean": mean_over_ranks({"x": own, f"only_{rank_index()}": own}),
    }
    seeds: list[int] = []

    class WatchedEnv(ReachEnv):
        def reset(self, wanted):
            seeds.extend(wanted)
            return super().reset(wanted)

    pipeline.make_decision_env = lambda env, num_envs, *rest: WatchedEnv(num_envs)
    dppo = SmallDppo(
        iterations=2, num_envs=4, epochs=2, minibatch_decisions=4, critic_width=16, critic_warmup=1
    )
    cfg = pipeline.FinetunePipelineConfig(
        env=pipeline.VtRefineEnvConfig(), dppo=dppo, output_dir=folder / "run"
    )
    cfg.eval_freq, cfg.save_freq = 1, 1
    sys.argv = ["vtrefine-finetune", f"--policy.path={checkpoint}"]
    rank = rank_index()
    pipeline.run(cfg)
    found["seeds"] = seeds
    (folder / f"rank{rank}.json").write_text(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
    gc.freeze()  # what was imported need not be looked through once more
