"""What is observed depends neither on the threads nor on whether images were begun with the step."""

import numpy as np
import pytest
import torch

from lerobot_vtrefine.sim.config import RandomizationConfig, SceneConfig
from lerobot_vtrefine.sim.host import without_torch_threads
from lerobot_vtrefine.sim.simulation import InsertionSim

WORLDS = np.arange(6)
SOME = np.array([1, 4, 5])
RANGES = RandomizationConfig(clearance_m=(0.001, 0.004), camera_position_m=0.02, camera_rotation_rad=0.02)


def make(threads, backend="batch"):
    sim = InsertionSim(
        SceneConfig(start="grasped"),
        num_envs=len(WORLDS),
        backend=backend,
        num_threads=threads,
        randomization=RANGES,
    )
    sim.reset(WORLDS, WORLDS + 40)
    return sim


def play(sim, images):
    """Observations of a short episode, with `images` begun along with each step."""
    seen = []
    for number in range(3):
        sim.step(sim.command_targets() + 0.01 * number, images=images)
        seen += [sim.observe(SOME), sim.observe()]
    sim.step(sim.command_targets()[SOME], SOME, images=SOME)
    sim.step(sim.command_targets(), images=images)  # what was begun before is no longer asked for
    return [*seen, sim.observe(SOME), sim.observe()]


@pytest.fixture(scope="module")
def alone():
    return play(make(1), None)


@pytest.mark.parametrize(
    ("threads", "images"), [(1, WORLDS), (2, None), (2, WORLDS), (3, SOME), (5, WORLDS), (2, WORLDS[:0])]
)
def test_observations_are_the_same_by_any_number_of_threads(alone, threads, images):
    for ours, expected in zip(play(make(threads), images), alone, strict=True):
        for key, value in expected.items():
            np.testing.assert_array_equal(ours[key], value, err_msg=key)


def test_images_begun_before_a_change_are_not_shown_after_it():
    sim = make(2)
    before = [sim.get_state(int(world)) for world in WORLDS]
    first = sim.depth_mm()
    for change in (
        lambda: [sim.set_state(int(world), state) for world, state in zip(WORLDS, before, strict=True)],
        lambda: sim.reset(WORLDS, WORLDS + 40),
    ):
        sim.step(sim.command_targets() + 0.05, images=WORLDS)
        sim.observe()
        sim.step(sim.command_targets() + 0.05, images=WORLDS)
        change()
        np.testing.assert_array_equal(sim.depth_mm(), first)
        np.testing.assert_array_equal(sim.joint_state(), make(1).joint_state())


def test_what_is_known_of_a_state_is_forgotten_with_it():
    sim = make(2)
    sim.step(sim.command_targets() + 0.05)
    moved, touched = sim.privileged(), sim.tactile()
    sim.hold()
    held = sim.privileged()
    assert np.abs(held[:, :16] - moved[:, :16]).max() > 1e-6
    sim.reset(WORLDS, WORLDS + 40)
    fresh = make(2)
    np.testing.assert_array_equal(sim.privileged(), fresh.privileged())
    np.testing.assert_array_equal(sim.tactile(), fresh.tactile())
    assert (touched != fresh.tactile()).any()


def test_worlds_to_image_must_exist():
    sim = make(1)
    with pytest.raises(ValueError, match="ids must be sorted"):
        sim.step(sim.command_targets(), images=np.array([7]))


def test_torch_gets_its_threads_back():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        assert without_torch_threads(torch.get_num_threads)() == 1
        assert torch.get_num_threads() == 3
        with pytest.raises(ZeroDivisionError):
            without_torch_threads(lambda: 1 // 0)()
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_a_step_and_an_observation_leave_torchs_threads_alone(monkeypatch):
    sim, seen, before = make(2), [], torch.get_num_threads()
    counts = sim._pads.counts

    def watch(*given):
        seen.append(torch.get_num_threads())
        return counts(*given)

    monkeypatch.setattr(sim._pads, "counts", watch)
    try:
        torch.set_num_threads(2)
        sim.step(sim.command_targets(), images=WORLDS)
        sim.observe()
        sim.tactile()
        assert seen == [1, 1]
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
