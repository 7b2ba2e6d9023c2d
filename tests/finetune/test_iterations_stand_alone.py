"""An iteration in worlds that have played before is the one in fresh worlds: so a resumed run, whose worlds
are new, is the run that was never interrupted.
"""

from pathlib import Path

import torch

from lerobot_vtrefine.finetune.config import TrustRegionDppo
from lerobot_vtrefine.finetune.dppo import collect
from lerobot_vtrefine.finetune.pipeline import load_practice

ROOT = Path(__file__).parents[2]
POLICY = ROOT / "lerobot_vtrefine" / "assets" / "policies" / "square_grasped_1mm"
TASK = ROOT / "configs" / "env" / "cross_gentle.yaml"
"""Worlds differ in friction."""


def test_what_worlds_did_before_changes_nothing() -> None:
    cfg = TrustRegionDppo(num_envs=3, encoder="frozen", decisions=2)
    found = []
    for earlier in ([], [range(11, 14), range(20, 23)]):  # seeds 11 and 12 in other worlds, settled already
        _, agent, env, _ = load_practice(POLICY, TASK, cfg, "cpu")
        for seeds in earlier:
            collect(env, agent, cfg, torch.Generator().manual_seed(1), seeds)
        torch.manual_seed(0)  # of noise in what is seen: a checkpoint holds its state
        found.append(vars(collect(env, agent, cfg, torch.Generator().manual_seed(0), range(10, 13))))
    fresh, used = found
    torch.testing.assert_close(fresh, used, rtol=0, atol=0, equal_nan=True)
    assert not torch.equal(fresh["privileged"][0, 0], fresh["privileged"][0, 1])
