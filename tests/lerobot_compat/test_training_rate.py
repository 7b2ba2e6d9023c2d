"""Evaluations during training at another rate than the dataset's are refused before it begins."""

import sys
from types import SimpleNamespace
from typing import Any

import pytest

from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.lerobot_compat import training_rate


def training(monkeypatch: pytest.MonkeyPatch, fps: int) -> Any:
    """``lerobot-train``, once this package is installed, with a dataset of that rate."""
    dataset = SimpleNamespace(meta=SimpleNamespace(fps=fps))
    module = SimpleNamespace(make_train_eval_datasets=lambda cfg: (dataset, None))
    monkeypatch.setitem(sys.modules, training_rate.TRAINING, module)
    training_rate.install()
    training_rate.install()
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
