"""Contact laws on prescribed depths, against their formulas written out in plain numbers."""

from collections.abc import Callable

import pytest
import torch

from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.contact import (
    Consistent,
    ContactStage,
    Depth,
    FlexitacIsaacSim,
    KelvinVoigt,
    TacSL,
)

LAYOUT = PadLayout(rows=1, cols=7)
DEPTH_M = (1e-3, 1e-3, 1e-3, 5e-3, 0.0, -1e-3, -1e-3)
RATE_M_S = (0.0, 0.1, -1.0, -0.1, 1.0, 0.0, 1.0)


def kelvin_voigt(depth: float, rate: float) -> float:
    return max(0.0, 400.0 * depth + 1.2 * rate) if depth > 0 else 0.0


def consistent(depth: float, rate: float) -> float:
    """Stiffness per area times the area of a taxel of 2 x 2 mm; 3 ms between rate and depth."""
    return 2e8 * 4e-6 * max(0.0, depth + 3e-3 * rate) if depth > 0 else 0.0


LAWS: tuple[tuple[ContactStage, Callable[[float, float], float]], ...] = (
    (KelvinVoigt(400.0, 1.2), kelvin_voigt),
    (TacSL(400.0), lambda depth, rate: 400.0 * max(depth, 0.0)),
    (Depth(), lambda depth, rate: max(depth, 0.0)),
    (FlexitacIsaacSim(), lambda depth, rate: min(max(5000.0 * depth, 0.0), 10.0) / 10.0),
    (Consistent(2e8, 3e-3), consistent),
)


@pytest.mark.parametrize(("law", "formula"), LAWS, ids=[law.name for law, _ in LAWS])
def test_force_is_the_laws(law: ContactStage, formula: Callable[[float, float], float]) -> None:
    depth, rate = torch.tensor([DEPTH_M]), torch.tensor([RATE_M_S])
    kept = depth.clone(), rate.clone()
    force = law.force(depth, rate, LAYOUT)
    expected = [formula(d, v) for d, v in zip(DEPTH_M, RATE_M_S, strict=True)]
    assert force.flatten().tolist() == pytest.approx(expected, rel=1e-5, abs=1e-12)
    assert torch.equal(depth, kept[0])
    assert torch.equal(rate, kept[1])


@pytest.mark.parametrize("law", [KelvinVoigt(400.0, 1.2), TacSL(400.0), Consistent(2e8, 3e-3)])
def test_a_stiffer_pad_pushes_as_much_more_as_it_is_stiffer(law: ContactStage) -> None:
    """Damping grows along, so that both keep their ratio."""
    depth, rate = torch.tensor([DEPTH_M]), torch.tensor([RATE_M_S])
    factor = torch.tensor([[1.0, 2.0, 0.5, 3.0, 1.0, 1.0, 2.0]])
    scaled = law.scaled(factor).force(depth, rate, LAYOUT)
    torch.testing.assert_close(scaled, factor * law.force(depth, rate, LAYOUT))
