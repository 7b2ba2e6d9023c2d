"""Inverse kinematics of both hands: reaches, keeps fingers and limits, reports what is out of reach."""

import numpy as np
import pytest

from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.sim.ik import hand_poses, solve_hands

ALOHA = get_embodiment("aloha")


def _postures(count: int) -> np.ndarray:
    """Joint positions around home, with each gripper half open."""
    rng = np.random.default_rng(0)
    q = np.tile(ALOHA.home, (count, 1)) + 0.15 * rng.standard_normal((count, 16))
    q[:, [6, 14]], q[:, [7, 15]] = 0.02, -0.02
    return np.clip(q, ALOHA.lower, ALOHA.upper)


def test_reaches_poses_of_both_hands_and_keeps_fingers() -> None:
    goal = _postures(32)
    position, rotation = hand_poses(ALOHA, goal)
    start = np.tile(ALOHA.home, (32, 1))
    q, miss_m, miss_rad = solve_hands(ALOHA, position, rotation, start, iterations=15)
    assert miss_m.max() < 1e-5
    assert miss_rad.max() < 1e-3
    reached, turned = hand_poses(ALOHA, q)
    np.testing.assert_allclose(reached, position, atol=1e-5)
    np.testing.assert_allclose(turned, rotation, atol=1e-3)
    np.testing.assert_array_equal(q[:, [6, 7, 14, 15]], start[:, [6, 7, 14, 15]])


def test_default_steps_suffice_from_the_previous_control_step() -> None:
    q = _postures(16)
    position, rotation = hand_poses(ALOHA, q)
    position[:, :, 2] += 0.015
    _, miss_m, miss_rad = solve_hands(ALOHA, position, rotation, q)
    assert miss_m.max() < 1e-4
    assert miss_rad.max() < 1e-3


def test_out_of_reach_is_reported_and_stays_within_limits() -> None:
    q = _postures(2)
    position, rotation = hand_poses(ALOHA, q)
    position[0, 1] += (0.0, -2.0, 0.0)
    solved, miss_m, _ = solve_hands(ALOHA, position, rotation, q, iterations=40)
    assert miss_m[0, 1] > 0.5
    assert miss_m[1].max() < 1e-4
    assert (solved >= ALOHA.lower).all()
    assert (solved <= ALOHA.upper).all()


def test_an_environment_does_not_depend_on_its_neighbours() -> None:
    q = _postures(5)
    position, rotation = hand_poses(ALOHA, q)
    position[..., 0] += 0.01
    together = solve_hands(ALOHA, position, rotation, q)[0]
    alone = np.concatenate(
        [solve_hands(ALOHA, position[i : i + 1], rotation[i : i + 1], q[i : i + 1])[0] for i in range(5)]
    )
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_follows_a_turn_of_one_hand_only(axis: int) -> None:
    q = _postures(1)
    position, rotation = hand_poses(ALOHA, q)
    turn = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turn[first, first] = turn[second, second] = np.cos(0.1)
    turn[first, second], turn[second, first] = -np.sin(0.1), np.sin(0.1)
    rotation[0, 0] = turn @ rotation[0, 0]
    solved, _, miss_rad = solve_hands(ALOHA, position, rotation, q)
    assert miss_rad.max() < 1e-3
    np.testing.assert_allclose(solved[0, 8:], q[0, 8:], atol=1e-9)
    assert np.abs(solved[0, :6] - q[0, :6]).max() > 0.01
