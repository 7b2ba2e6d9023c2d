"""p-values are computed or absent: none is typed in, and what is observed rather than tested says so."""

import ast
from pathlib import Path

import numpy as np
import pytest

import lerobot_vtrefine.diagnose as package
from lerobot_vtrefine.diagnose.core.rules import SCREEN_ALPHA
from lerobot_vtrefine.diagnose.core.score_test import Probe, screen
from lerobot_vtrefine.diagnose.verdict import Cause

FOLDER = Path(package.__file__).parent
FILES = sorted(FOLDER.rglob("*.py"))
KNOWN = {"Alarm": 3, "Tested": 1, "Examined": 0, "Evidence": 1, "Cause": 3}
"""Class -> place of its p-value among the arguments."""


def typed_in(tree: ast.AST) -> list[str]:
    """Calls and entries of `p_values` that hold a constant (or one of two constants) for a p-value."""

    def constant(node: ast.expr) -> bool:
        if isinstance(node, ast.IfExp):
            return constant(node.body) or constant(node.orelse)
        return isinstance(node, ast.Constant) and isinstance(node.value, float | int)

    def given(node: ast.AST) -> list[ast.expr]:
        """What a node hands over as p-values."""
        if isinstance(node, ast.Assign):
            return [node.value for target in node.targets if ast.unparse(target).startswith("p_values[")]
        if not isinstance(node, ast.Call):
            return []
        place = KNOWN.get(ast.unparse(node.func), len(node.args))
        named = [item.value for item in node.keywords if item.arg in ("p_value", "p_alone", "p_adjusted")]
        return [*node.args[place : place + 1], *named]

    return [ast.unparse(node) for node in ast.walk(tree) if any(constant(item) for item in given(node))]


def test_the_rule_sees_a_typed_in_p_value() -> None:
    assert typed_in(ast.parse('Alarm("level", fired, ratio, 1e-4 if fired else 1.0, text)'))
    assert typed_in(ast.parse("p_values[name, channel] = 1.0 if p_value is None else p_value"))
    assert typed_in(ast.parse("Examined(p_alone=0.0, p_adjusted=adjusted)"))
    assert not typed_in(ast.parse('Alarm("level", fired, ratio, None, text)'))


def test_no_file_types_in_a_p_value() -> None:
    assert len(FILES) > 40
    assert {path.name: bad for path in FILES if (bad := typed_in(ast.parse(path.read_text())))} == {}


def probe(name: str, scores: np.ndarray, **more: object) -> Probe:
    return Probe(name, None, np.ones(1), scores, np.ones(len(scores)), False, **more)  # type: ignore[arg-type]


def test_what_is_observed_passes_without_a_p_value_and_costs_the_others_nothing() -> None:
    scores = np.random.default_rng(0).standard_normal(12) + 0.6
    alone = screen([probe("tested", scores)], 12, 0)["tested"]
    both = screen([probe("tested", scores), probe("seen", np.array([1e9]), observed=True)], 12, 0)
    assert both["seen"].passed
    assert (both["seen"].p_value, both["seen"].p_adjusted) == (None, None)
    assert both["tested"].p_adjusted == alone.p_adjusted


def test_products_of_signs_share_one_error_rate_with_scores() -> None:
    # Maps that recordings do not share, beside scores without an effect: the family-wise rate holds.
    rng = np.random.default_rng(3)
    wrong = 0
    for round_ in range(60):
        maps = rng.standard_normal((14, 9)) * rng.uniform(0.3, 3.0, (14, 1))
        products = maps @ maps.T
        np.fill_diagonal(products, 0.0)
        probes = [probe(str(k), rng.standard_t(3, 14)) for k in range(5)]
        probes.append(probe("map", np.ones(1), products=products))
        wrong += min(item.p_adjusted or 1.0 for item in screen(probes, 14, round_).values()) <= 0.1
    assert wrong <= 12  # 6 expected; 12 has a chance of one percent


def test_a_map_that_recordings_share_passes() -> None:
    rng = np.random.default_rng(4)
    maps = rng.standard_normal((12, 9)) + 1.2 * rng.standard_normal(9)
    products = maps @ maps.T
    np.fill_diagonal(products, 0.0)
    found = screen([probe("map", np.ones(1), products=products)], 12, 0)["map"]
    assert found.p_adjusted is not None
    assert found.p_adjusted < SCREEN_ALPHA


def test_kinds_of_tests_share_the_error_rate() -> None:
    even = np.ones((12, 12)) - np.eye(12)
    found = screen([probe("scores", np.ones(12)), probe("products", np.ones(1), products=even)], 12, 0)
    for kind, share in (("scores", 0.8), ("products", 0.2)):
        assert found[kind].p_adjusted == pytest.approx((found[kind].p_value or 0.0) / share)


def test_an_observed_cause_has_no_p_value() -> None:
    assert Cause("dead_taxels", "cause", {}, None, 0.3, "observed").p_value is None
    with pytest.raises(ValueError, match="observed, not tested"):
        Cause("dead_taxels", "cause", {}, 5e-4, 0.3, "observed")
