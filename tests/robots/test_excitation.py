"""Hands that move without a person: every joint reverses, none is hurried, and it is the same every time."""

from collections.abc import Generator

import numpy as np
import pytest
import torch

from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.lerobot_compat import phases
from lerobot_vtrefine.sim.config import TaskConfig
from lerobot_vtrefine.teleoperators import VtRefineEeConfig
from lerobot_vtrefine.teleoperators.vtrefine_ee import VtRefineEe

FPS, STEPS = 10, 140


@pytest.fixture(autouse=True)
def restored() -> Generator[None]:
    yield
    phases.uninstall()


def episodes(body: str, count: int, scale: float = 1.0) -> np.ndarray:
    """(count, STEPS, J) targets from the robot's home."""
    config = VtRefineEeConfig(input="excitation", embodiment=body, scale=scale)
    teleoperator = VtRefineEe(config)
    teleoperator.connect()
    home = dict(zip(teleoperator.action_features, map(float, get_embodiment(body).home), strict=True))
    found = []
    for _ in range(count):
        teleoperator.follow(home, FPS)
        found.append([list(teleoperator.get_action().values()) for _ in range(STEPS)])
    teleoperator.disconnect()
    return np.array(found)


@pytest.mark.parametrize("body", ["aloha", "kinova"])
def test_every_joint_reverses_often_within_its_rate(body: str) -> None:
    targets = episodes(body, 2)
    speed = np.diff(targets, axis=1)
    arms = get_embodiment(body).arm_columns
    assert np.abs(speed[..., arms]).max() <= TaskConfig().joint_rate / FPS + 1e-9
    for joint in np.moveaxis(speed, -1, 0):
        reversals = [(np.diff(np.sign(steps[np.abs(steps) > 2e-4])) != 0).sum() for steps in joint]
        assert sum(reversals) >= 6
    assert (np.ptp(targets[..., arms], axis=1) > 0.05).all()  # wide beside any play
    assert (np.abs(speed).max(-1) < 1e-3).any(1).all()  # rests


def test_courses_are_the_same_in_every_recording_and_differ_between_episodes() -> None:
    first, again = episodes("aloha", 2), episodes("aloha", 2)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first[0] - first[1]).max() > 0.05


def test_a_smaller_scale_moves_hands_less() -> None:
    body = get_embodiment("aloha")
    wide, small = (
        np.ptp(body.tcp_poses(torch.as_tensor(episodes("aloha", 1, scale)[0]))[0].numpy(), axis=0)
        for scale in (1.0, 0.3)
    )
    assert np.linalg.norm(small) < 0.5 * np.linalg.norm(wide)
