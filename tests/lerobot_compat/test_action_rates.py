"""Evaluations and rollouts at another rate than the dataset's are refused before they begin."""

import sys
from types import SimpleNamespace
from typing import Any

import pytest

from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.lerobot_compat import action_rates
from lerobot_vtrefine.policies.vt_dp3 import VtDp3Config


def training(monkeypatch: pytest.MonkeyPatch, fps: int) -> Any:
    """``lerobot-train``, once this package is installed, with a dataset of that rate."""
    dataset = SimpleNamespace(meta=SimpleNamespace(fps=fps))
    module = SimpleNamespace(make_train_eval_datasets=lambda cfg: (dataset, None))
    monkeypatch.setitem(sys.modules, action_rates.TRAINING, module)
    action_rates.install()
    action_rates.install()
    return module


def settings(env: Any, every: int = 20_000) -> Any:
    return SimpleNamespace(env=env, env_eval_freq=every)


def test_another_rate_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = training(monkeypatch, 20).make_train_eval_datasets
    message = "^error: --env.fps=10, but the dataset holds 20 actions a second: give --env.fps=20$"
    with pytest.raises(SystemExit, match=message):
        opened(settings(VtRefineEnvConfig(fps=10)))


@pytest.mark.parametrize(
    "cfg",
    [
        settings(None),
        settings(SimpleNamespace(type="pusht", fps=10)),
        settings(SimpleNamespace(type="vtrefine", fps=20)),
        settings(SimpleNamespace(type="vtrefine", fps=10), every=0),
    ],
    ids=["no environment", "another package's", "the same rate", "never evaluated"],
)
def test_what_is_right_or_not_ours_goes_on(cfg: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset, _ = training(monkeypatch, 20).make_train_eval_datasets(cfg)
    assert dataset.meta.fps == 20


def rollout(monkeypatch: pytest.MonkeyPatch) -> Any:
    """What ``lerobot-rollout`` begins with, once this package is installed; here it moves no arm."""
    module = SimpleNamespace(build_rollout_context=lambda cfg, event: (cfg, event))
    monkeypatch.setitem(sys.modules, action_rates.ROLLOUT, module)
    action_rates.install()
    return module.build_rollout_context


def test_a_policy_moves_no_arm_at_another_rate_than_it_learned(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = SimpleNamespace(policy=VtDp3Config(fps=10, device="cpu"), fps=30.0)
    message = "^error: --fps=30, but the policy learned 10 actions a second: give --fps=10$"
    with pytest.raises(SystemExit, match=message):
        rollout(monkeypatch)(cfg, None)


@pytest.mark.parametrize(
    "policy",
    [VtDp3Config(fps=30, device="cpu"), VtDp3Config(device="cpu"), SimpleNamespace(type="act")],
    ids=["the same rate", "a rate that nobody noted", "another package's"],
)
def test_what_is_right_or_not_ours_is_rolled_out(policy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = SimpleNamespace(policy=policy, fps=30.0)
    assert rollout(monkeypatch)(cfg, "event") == (cfg, "event")
