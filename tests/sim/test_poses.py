"""Rigid poses: composition, inversion, the way between two."""

import numpy as np
import pytest

from lerobot_vtrefine.sim.poses import Poses, rotation_vector


def _random(count: int) -> Poses:
    rng = np.random.default_rng(1)
    return Poses.from_vectors(rng.standard_normal((count, 3)), rng.uniform(-1, 1, (count, 3)))


def test_inverse_undoes_a_pose() -> None:
    poses = _random(8)
    unit = poses @ poses.inverse()
    np.testing.assert_allclose(unit.position, 0, atol=1e-12)
    np.testing.assert_allclose(unit.rotation, np.tile(np.eye(3), (8, 1, 1)), atol=1e-12)


def test_quaternions_are_w_first() -> None:
    half = np.sqrt(0.5)
    pose = Poses.from_quaternions(np.array([[1.0, 2.0, 3.0, half, 0.0, 0.0, half]]))  # a quarter turn about z
    np.testing.assert_allclose(pose.rotation[0] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(pose.position, [[1.0, 2.0, 3.0]])


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_towards_moves_and_turns_by_its_share(share: float) -> None:
    start = Poses.from_vectors(np.zeros((1, 3)), np.array([[0.0, 0.0, 0.2]]))
    goal = Poses.from_vectors(np.array([[4.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]))
    between = start.towards(goal, np.array([share]))
    np.testing.assert_allclose(between.position, [[4 * share, 0, 0]])
    np.testing.assert_allclose(rotation_vector(between.rotation), [[0, 0, 0.2 + 0.8 * share]], atol=1e-12)


def test_assign_overwrites_only_its_rows() -> None:
    poses = Poses.identity(3)
    poses.assign(np.array([1]), _random(1))
    np.testing.assert_array_equal(poses.position[[0, 2]], 0)
    assert np.abs(poses.position[1]).max() > 0


def test_quaternions_are_the_rows_that_poses_are_made_of() -> None:
    rng = np.random.default_rng(0)
    poses = Poses.from_vectors(rng.normal(size=(4, 2, 3)), rng.uniform(-1, 1, (4, 2, 3)))
    rows = poses.quaternions()
    assert rows.shape == (4, 2, 7)
    again = Poses.from_quaternions(rows)
    np.testing.assert_allclose(again.position, poses.position)
    np.testing.assert_allclose(again.rotation, poses.rotation, atol=1e-12)
