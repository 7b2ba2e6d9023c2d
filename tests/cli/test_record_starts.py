"""``vtrefine-record-starts``, and DPPO that starts from what it wrote."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_commands import TINY_DPPO, TINY_ENV

from lerobot_vtrefine.files.arrays import read_arrays
from lerobot_vtrefine.finetune import policy_player
from lerobot_vtrefine.finetune.logger import read_progress
from lerobot_vtrefine.sim.simulation import InsertionSim

STEPS = 60
TABLE = [
    *(flag for flag in TINY_ENV if ".start=" not in flag),
    "--env.start=table",
    f"--env.episode_steps={STEPS}",
]


def record(path: Path, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    from lerobot_vtrefine.cli import record_starts

    monkeypatch.setattr(sys, "argv", ["vtrefine-record-starts", f"--path={path}", *TABLE, *arguments])
    return record_starts.main()


def steps_of(path: Path) -> list[int]:
    return read_arrays(path, "iufbU")["state/episode/steps"].tolist()


def test_the_expert_grasps_whatever_the_number_of_worlds(tmp_path: Path, monkeypatch, capsys) -> None:
    one, other = tmp_path / "one.npz", tmp_path / "other.npz"
    errors = ("--degradation.grasp_std_m=0.002", "--degradation.pace_std=0.1", "--num_starts=4", "--seed=20")
    for path, worlds in ((one, 2), (other, 5)):
        assert record(path, monkeypatch, *errors, f"--num_envs={worlds}") == 0
        assert "4 states in" in capsys.readouterr().out
    first, second = read_arrays(one, "iufbU"), read_arrays(other, "iufbU")
    assert first["source"].tolist() == [20, 21, 22, 23]
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name], err_msg=name)
    assert len(set(steps_of(one))) > 1  # each at its own moment


def test_a_policys_grasps_come_first_and_the_experts_where_there_are_none(
    checkpoint: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    # A policy that has learnt nothing knocks parts off the table, by some noise before it decides again.
    monkeypatch.setattr(
        policy_player,
        "deployed_chunks",
        lambda agent, cond, *_: torch.zeros(len(cond), 8, agent.action_shape[1]),
    )
    few = ("--num_starts=2", "--num_envs=2", "--attempts=1", f"--policy.path={checkpoint}")
    path = tmp_path / "starts.npz"
    assert record(path, monkeypatch, *few) == 0
    assert "0 by the policy and 2 by the expert" in capsys.readouterr().out
    assert read_arrays(path, "iufbU")["source"].tolist() == [2, 3]  # episodes that the policy has not played
    monkeypatch.setattr(InsertionSim, "in_hand", property(lambda sim: sim.steps >= 3))
    assert record(path, monkeypatch, *few) == 2
    assert f"{path} exists; choose another --path or add --overwrite=true" in capsys.readouterr().err
    assert record(path, monkeypatch, *few, "--overwrite=true") == 0
    assert "2 by the policy" in capsys.readouterr().out
    assert steps_of(path) == [8, 8]  # when the policy decides again


def test_dppo_practises_from_the_bank_and_stays_within_the_time_from_the_table(
    checkpoint: Path, tmp_path: Path, monkeypatch
) -> None:
    from lerobot_vtrefine.cli import finetune

    path, out = tmp_path / "starts.npz", tmp_path / "tuned"
    assert record(path, monkeypatch, "--num_starts=3", "--num_envs=3") == 0
    named = (
        f"--policy.path={checkpoint}",
        f"--output_dir={out}",
        f"--env.start_bank={path}",
        "--eval_freq=0",
    )
    flags = [*named, "--policy.device=cpu", *TABLE, *TINY_DPPO]
    monkeypatch.setattr(sys, "argv", ["vtrefine-finetune", *flags])
    assert finetune.main() == 0
    (row,) = read_progress(out)
    _, *training = steps_of(path)
    assert 0 < row["env_steps"] <= sum(STEPS - begun for begun in training)


def test_hopeless_grasps_and_other_starts_are_refused(tmp_path: Path, monkeypatch, capsys) -> None:
    path = tmp_path / "starts.npz"
    assert record(path, monkeypatch, "--env.start=grasped") != 0
    assert "--env.start=table" in capsys.readouterr().err
    far = ("--degradation.grasp_std_m=0.1", "--num_starts=2", "--num_envs=2", "--attempts=1")
    assert record(path, monkeypatch, *far) != 0
    assert "both parts were in hand in 0 of 2 episodes" in capsys.readouterr().err
    assert not path.exists()
    assert record(tmp_path, monkeypatch) != 0
    assert f"--path={tmp_path} is a folder; name a file in it" in capsys.readouterr().err
