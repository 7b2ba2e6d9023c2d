"""The trained policy that comes with the package, and the script that makes it."""

import json
import re
import sys
from pathlib import Path

import pytest
import ship_policy as script
import torch
from safetensors.torch import load_file, save_file

from lerobot_vtrefine import shipped
from lerobot_vtrefine.cli.play import SHOWN, with_something_to_play


def test_a_policy_is_named_as_the_environment_it_was_trained_in() -> None:
    assert shipped.policies().keys() <= shipped.names().keys()
    for folder in shipped.policies().values():
        assert sum(path.stat().st_size for path in folder.iterdir()) < 5_000_000
        assert "/" not in json.loads((folder / "config.json").read_text())["pretrained_encoder"]


def test_what_is_played_by_default_can_be_found() -> None:
    flags = with_something_to_play(["--viewer=none"])
    assert [flag.partition("=")[0] for flag in flags] == ["--config_path", "--policy.path", "--viewer"]
    assert all(Path(flag.partition("=")[2]).exists() for flag in flags[:2])
    for choice in ("--config_path=my.yaml", "--env.pair=key", "--agent=zero", "--dataset.root=demos"):
        assert with_something_to_play([choice]) == [choice]


def test_the_policy_inserts(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Its success rate is above .9 (docs/play.md); an untrained network succeeds in none of these episodes.
    On another processor one may end differently.
    """
    from lerobot_vtrefine.cli.play import main

    flags = ["--viewer=none", "--episodes=3", "--env.num_threads=1", "--policy.device=cpu"]
    monkeypatch.setattr(sys, "argv", ["vtrefine-play", *shipped.expand(SHOWN), *flags])
    assert main() == 0
    assert re.search(r"\n[23] of 3 succeeded \(", capsys.readouterr().out)


def test_weights_are_shortened_and_nothing_else(tmp_path: Path) -> None:
    checkpoint = tmp_path / "pretrained_model"
    checkpoint.mkdir()
    weights = {"model.a": torch.randn(40), "base.denoiser.b": torch.randn(30), "count": torch.arange(3)}
    save_file(weights, checkpoint / "model.safetensors")
    (checkpoint / "config.json").write_text('{"device": "cuda", "pretrained_encoder": "/x", "horizon": 8}')
    (checkpoint / "policy_preprocessor.json").write_text('{"steps": [{"config": {"device": "cuda"}}, {}]}')
    size = script.ship(checkpoint, tmp_path / "small")
    kept = load_file(tmp_path / "small" / "model.safetensors")
    assert size == 40 * 2 + 30 + 3 * 8
    torch.testing.assert_close(kept["model.a"].float(), weights["model.a"], rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(
        kept["base.denoiser.b"].float(), weights["base.denoiser.b"], rtol=0.07, atol=2e-3
    )
    assert kept["count"].tolist() == [0, 1, 2]
    config = json.loads((tmp_path / "small" / "config.json").read_text())
    assert (config["device"], config["pretrained_encoder"], config["horizon"]) == ("cpu", "", 8)
    processor = json.loads((tmp_path / "small" / "policy_preprocessor.json").read_text())
    assert processor["steps"][0]["config"]["device"] == "cpu"


def test_what_cannot_be_shipped_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"holds no model\.safetensors"):
        script.ship(tmp_path, tmp_path / "small")
    save_file({"model.a": torch.zeros(2_600_000)}, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"5\.20 MB, at most 5"):
        script.ship(tmp_path, tmp_path / "small")
    assert not (tmp_path / "small").exists()
    (tmp_path / "full").mkdir()
    with pytest.raises(FileExistsError, match="delete it first"):
        script.ship(tmp_path, tmp_path / "full")
