"""Nats and millimetres of one update: known shifts; divergence grows with the square of the step."""

import argparse
from pathlib import Path

import pytest
import step_in_millimetres as script
import torch


def test_millimetres_of_known_shifts():
    before = torch.zeros(4, 3)
    after = torch.tensor([[3e-3, 4e-3, 0.0], [3e-3, -4e-3, 0.0], [3e-3, 4e-3, 0.0], [3e-3, -4e-3, 0.0]])
    assert script.millimetres(before, after) == pytest.approx(
        {"rms_mm": 5.0, "median_mm": 5.0, "coherent_mm": 3.0}
    )


@pytest.fixture
def arguments() -> argparse.Namespace:
    root = Path(script.__file__).parents[1]
    return argparse.Namespace(
        policy=root / "lerobot_vtrefine" / "assets" / "policies" / "square_grasped_1mm",
        task=root / "configs" / "env" / "square_grasped_1mm.yaml",
        worlds=2,
        rates=[1e-6, 4e-6],
        std=0.03,
        device="cpu",
        seed=0,
    )


@pytest.mark.slow
def test_small_steps_move_in_proportion_and_diverge_with_its_square(arguments):
    small, large = script.measure(arguments)
    assert large["rms_mm"] / small["rms_mm"] == pytest.approx(4, rel=0.3)
    assert large["nats"] / small["nats"] == pytest.approx(16, rel=0.5)
    assert "4e-06" in next(iter(script.line("square", large).cells.values()))
