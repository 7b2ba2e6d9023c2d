"""What the reference DPPO's agent is shown of our environments (scripts/reference/insertion/theirs.py)."""

import argparse

import numpy as np
import pytest
import torch
from reference.checkout import Reference
from reference.insertion.ours import TimeIsUpError
from reference.insertion.theirs import ReferenceEnvs
from toy import BlindPeg, ToyActor, make_agent

from lerobot_vtrefine.cli.pipeline.demo_config import SEED_STRIDE
from lerobot_vtrefine.finetune.config import PaperDppo
from lerobot_vtrefine.finetune.seeds import EVALUATION_SEEDS, TRAINING_SEEDS

CHUNK = (4, 2)


class Pegs(BlindPeg):
    """Remembers its seeds."""

    def reset(self, seeds):
        self.seeds = list(seeds)
        return super().reset(seeds)


@pytest.fixture
def envs():
    pegs = Pegs(3, feel=True, max_decisions=2)
    agent = make_agent(ToyActor(3, *CHUNK, width=8), PaperDppo(encoder="frozen"), CHUNK)
    args = argparse.Namespace(seed=7, val_freq=2, minutes=1.0)
    mean, std = torch.zeros(4), torch.full((4,), 1e-3)
    return ReferenceEnvs(pegs, agent, mean, std, args)


def test_only_steps_of_training_episodes_that_run_count(envs):
    down = np.zeros((3, *CHUNK), np.float32)
    down[:, :, 1] = -1
    for _ in range(3):
        envs.reset_arg(None)
        envs.env.slot[:] = torch.tensor([0.0, 5.0, 5.0])
        envs.env.x[:] = 0.0  # over the slot in the first world only
        envs.env.z[:] = 0.02
        found = [envs.step(down) for _ in range(3)]
        rewards, over = (np.stack([step[place] for step in found]) for place in (1, 2))
        np.testing.assert_array_equal(rewards, [[1, 0, 0], [0, 0, 0], [0, 0, 0]])
        np.testing.assert_array_equal(over, [[True, False, False], [True] * 3, [True] * 3])
    envs.note()
    of_one = CHUNK[0] * (3 + 2)
    assert [row["env_steps"] for row in envs.curve] == [0, of_one, of_one]
    successes = [{key: row[key] for key in row if "success" in key} for row in envs.curve]
    third = pytest.approx(1 / 3)
    assert successes == [{"eval_success": third}, {"success": third}, {"eval_success": third}]


def test_evaluations_have_seeds_of_their_own_and_so_have_runs(envs):
    """Runs of seeds 7 and 8 had shared all training episodes but one of each end."""
    seeds = []
    for _ in range(4):
        envs.reset_arg(None)
        seeds.append(envs.env.seeds)
    held_out = list(range(EVALUATION_SEEDS, EVALUATION_SEEDS + 3))
    first = TRAINING_SEEDS + 7 * SEED_STRIDE
    assert seeds == [held_out, [first + 3 + k for k in range(3)], held_out, [first + 9 + k for k in range(3)]]


def test_the_state_is_condition_and_standardised_privileged_state(envs):
    state = envs.reset_arg(None)["state"]
    assert state.shape == (3, 1, 32 + 4)
    obs, privileged = envs.env.observe()
    np.testing.assert_allclose(state[:, 0, :32], envs.agent.actor.encode(obs).detach(), rtol=1e-6)
    np.testing.assert_allclose(state[:, 0, 32:], (privileged / 1e-3).clamp(-5, 5), rtol=1e-6)


def test_a_run_ends_when_its_time_is_up(envs):
    envs.seconds = 0.0
    with pytest.raises(TimeIsUpError):
        envs.reset_arg(None)


def test_a_folder_without_the_reference_is_told(tmp_path):
    with pytest.raises(FileNotFoundError, match="not a checkout of irom-princeton/dppo"):
        Reference(tmp_path)
