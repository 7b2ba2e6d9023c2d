"""The comparison pools episodes, pairs seeds, and says only what its interval shows."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "compare_touch.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("compare_touch", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run_of(pretrain: int, finetune: int) -> dict:
    return {
        name: {"success": count, "episodes": 100, "rate": count / 100}
        for name, count in (("pretrain", pretrain), ("finetune", finetune))
    }


def test_pools_and_pairs(script: ModuleType) -> None:
    touch = {seed: run_of(20, 80 + seed) for seed in range(3)}
    sight = {seed: run_of(20, 50 + seed) for seed in range(3)}
    comparison = script.compare({"visuo_tactile": touch, "visual": sight})
    assert comparison["finetune"]["visuo_tactile"]["success"] == 243
    assert comparison["finetune"]["visuo_tactile"]["episodes"] == 300
    assert comparison["finetune"]["touch_minus_visual"] == {"mean": 0.3, "ci95": [0.3, 0.3]}
    assert "touch pays" in script.as_text(comparison)


def test_noise_is_called_noise(script: ModuleType) -> None:
    touch = {0: run_of(20, 90), 1: run_of(20, 40), 2: run_of(20, 60)}
    sight = {0: run_of(20, 50), 1: run_of(20, 60), 2: run_of(20, 55)}
    text = script.as_text(script.compare({"visuo_tactile": touch, "visual": sight}))
    assert "makes no difference that these seeds can show" in text


def test_passes_flags_on_and_saves(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def fake(output: Path, modalities: str, seed: int, extra: list[str]) -> dict:
        calls.append((output.name, extra))
        output.mkdir(parents=True)
        return run_of(20, 80 if modalities == "visual" else 60)

    monkeypatch.setattr(script, "run_demo", fake)
    arguments = ["compare_touch.py", "--seeds", "3", "4", f"--output_dir={tmp_path}", "--num_demos=9"]
    monkeypatch.setattr(sys, "argv", arguments)
    script.main()
    assert calls[0] == ("visuo_tactile_3", ["--num_demos=9"])
    assert [name for name, _ in calls] == ["visuo_tactile_3", "visuo_tactile_4", "visual_3", "visual_4"]
    assert json.loads((tmp_path / "comparison.json").read_text())["finetune"]["visual"]["rate"] == 0.8
    assert "touch costs" in (tmp_path / "comparison.md").read_text()
