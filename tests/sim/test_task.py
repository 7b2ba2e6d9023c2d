import numpy as np
import pytest
import torch

from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.sim import substeps, task
from lerobot_vtrefine.sim.backends.base import ramp
from lerobot_vtrefine.sim.config import SuccessConfig, TaskConfig
from lerobot_vtrefine.sim.pairs import procedural_pair
from lerobot_vtrefine.sim.parts import Grip
from lerobot_vtrefine.sim.rotations import about_axis, matrix_to_quat, quat_to_matrix

ALOHA = get_embodiment("aloha")
PAIR = procedural_pair("round", 0.002)


def upright(*position):
    return np.array([position], float), np.eye(3)[None]


def test_servo_commands_round_trip_and_clamp():
    rng = np.random.default_rng(0)
    targets = rng.uniform(ALOHA.lower, ALOHA.upper, (5, 16))
    targets[:, 7], targets[:, 15] = -targets[:, 6], -targets[:, 14]
    commands = task.servo_commands(ALOHA, targets)
    assert commands.shape == (5, 14)
    np.testing.assert_allclose(task.joint_targets(ALOHA, commands), targets)
    wild = task.servo_commands(ALOHA, np.full((1, 16), 9.0))
    np.testing.assert_allclose(wild[0, :6], ALOHA.upper[:6])


def test_unequal_fingers_are_driven_by_their_mean_opening():
    targets = ALOHA.home[None].copy()
    targets[0, 6], targets[0, 7] = 0.02, -0.01
    assert task.servo_commands(ALOHA, targets)[0, 6] == pytest.approx(0.015)


def test_ramp_ends_at_its_target_in_equal_steps():
    path = ramp(np.zeros((1, 2)), np.array([[1.0, -2.0]]), 4)
    np.testing.assert_allclose(path[0], [[0.25, -0.5], [0.5, -1.0], [0.75, -1.5], [1.0, -2.0]])


def test_rate_limits_scale_with_the_control_step():
    slow, fast = (task.rate_limits(ALOHA, TaskConfig(control_hz=hz)) for hz in (10, 20))
    assert slow.shape == (14,)
    np.testing.assert_allclose(slow, 2 * fast)
    assert slow[6] == pytest.approx(0.015)


def test_insertion_is_measured_in_the_sockets_frame():
    tilted = about_axis(0, 0.3)[None]
    socket = np.array([[0.1, -0.2, 0.15]]), tilted
    local = np.array([0.001, 0.002, -0.020])
    plug = socket[0] + (tilted[0] @ local)[None], tilted @ about_axis(1, 0.1)
    state = task.insertion(PAIR, plug, socket, 0.0)
    np.testing.assert_allclose(state.position_m[0], local)
    assert state.depth_m[0] == pytest.approx(0.020)
    assert state.remaining_m[0] == pytest.approx(0.005)
    assert state.lateral_m[0] == pytest.approx(np.hypot(0.001, 0.002))
    assert state.tilt_rad[0] == pytest.approx(0.1)
    assert state.mouth_height_m[0] == pytest.approx(0.15)


@pytest.mark.parametrize(
    ("offset", "tilt", "height", "expected"),
    [
        ((0, 0, -0.0235), 0.0, 0.1, True),
        ((0, 0, -0.0225), 0.0, 0.1, False),
        ((0.0045, 0, -0.024), 0.0, 0.1, False),
        ((0, 0, -0.024), 0.21, 0.1, False),
        ((0, 0, -0.024), 0.0, 0.065, False),
    ],
)
def test_seated_needs_depth_alignment_and_air(offset, tilt, height, expected):
    socket = upright(0, 0, height)
    plug = socket[0] + np.array([offset]), about_axis(1, tilt)[None]
    assert bool(task.is_seated(task.insertion(PAIR, plug, socket, 0.0), SuccessConfig())[0]) is expected


def test_shift_counts_slip_and_rotation_in_the_hand_but_not_motion_with_it():
    grips = (Grip((0, 0, -0.04), (0.02, 0.02, 0.015)), Grip((0, 0, 0.05), (0.017, 0.017, 0.02)))
    parts = upright(0, 0, 0.1), upright(0, 0, 0.12)
    hands = np.zeros((1, 2, 3)), np.tile(np.eye(3), (1, 2, 1, 1))
    reference = task.grip_points(grips, parts, hands)
    move, spin = np.array([0.3, 0.1, 0.2]), about_axis(2, 0.7)
    carried = tuple((position @ spin.T + move, spin @ rotation) for position, rotation in parts)
    moved = task.grip_points(grips, carried, (hands[0] @ spin.T + move, spin @ hands[1]))
    np.testing.assert_allclose(task.in_hand_shift(moved, reference), 0.0, atol=1e-12)
    slipped = (parts[0], (parts[1][0] + [[0, 0.003, 0]], parts[1][1]))
    shift = task.in_hand_shift(task.grip_points(grips, slipped, hands), reference)
    np.testing.assert_allclose(shift, [[0.0, 0.003]], atol=1e-12)
    # Turning by a small angle about the grip's middle moves its ends by angle times half height.
    pivot = np.array([[0, 0, 0.12 + 0.05]])
    turned = (pivot + (about_axis(0, 0.1) @ [0, 0, -0.05])[None], about_axis(0, 0.1)[None])
    shift = task.in_hand_shift(task.grip_points(grips, (parts[0], turned), hands), reference)
    assert shift[0, 1] == pytest.approx(2 * 0.02 * np.sin(0.05))


def test_windowed_peak_equals_a_plain_moving_average_over_step_borders():
    rng = np.random.default_rng(3)
    forces = rng.normal(size=(2, 12, 3))
    tail = torch.zeros(2, 3, 3, dtype=torch.float64)
    first, tail = substeps.windowed_peak(torch.from_numpy(forces[:, :6]), tail)
    second, tail = substeps.windowed_peak(torch.from_numpy(forces[:, 6:]), tail)
    padded = np.concatenate([np.zeros((2, 3, 3)), forces], 1)
    means = np.stack([padded[:, k : k + 4].mean(1) for k in range(12)], 1)
    norms = np.linalg.norm(means, axis=-1)
    np.testing.assert_allclose(first, norms[:, :6].max(1))
    np.testing.assert_allclose(second, norms[:, 6:].max(1))
    np.testing.assert_allclose(tail, forces[:, -3:])


def test_rim_slide_counts_lateral_way_on_the_rim_only():
    tips = torch.tensor([[[0, 0, 0.001], [0.002, 0, 0.0], [0.002, 0.001, -0.001], [0.0, 0.001, -0.010]]])
    touching = torch.tensor([[True, True, True]])
    assert substeps.rim_slide(tips, touching, 0.0)[0] == pytest.approx(0.003)
    assert substeps.rim_slide(tips, ~touching, 0.0)[0] == 0.0


def test_turning_back_by_quaternions_is_the_inverse_rotation():
    rng = np.random.default_rng(5)
    quat, vector = rng.normal(size=(6, 4)), rng.normal(size=(6, 3))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    back = substeps.turn_back(torch.from_numpy(quat), torch.from_numpy(vector)).numpy()
    np.testing.assert_allclose(np.einsum("nij,nj->ni", quat_to_matrix(quat), back), vector, atol=1e-12)


def test_rotations_agree_with_each_other():
    rng = np.random.default_rng(4)
    quat = rng.normal(size=(200, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    matrix = quat_to_matrix(quat)
    identity = np.tile(np.eye(3), (200, 1, 1))
    np.testing.assert_allclose(matrix @ np.swapaxes(matrix, 1, 2), identity, atol=1e-12)
    back = matrix_to_quat(matrix)
    np.testing.assert_allclose(np.abs((back * quat).sum(1)), 1.0, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_survive_the_way_through_quaternions(axis):
    turned = about_axis(axis, np.pi)  # w = 0, the delicate case
    np.testing.assert_allclose(quat_to_matrix(matrix_to_quat(turned)), turned, atol=1e-9)
