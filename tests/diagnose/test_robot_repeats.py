"""Trials of one command that differ: what is noise, and what is a robot that does something of its own."""

from dataclasses import replace

import numpy as np
import pytest
import robot_rigs
from robot_rigs import Rig, make_set

from lerobot_vtrefine.diagnose.joints.batch import make_batch
from lerobot_vtrefine.diagnose.joints.engine import diagnose_robot
from lerobot_vtrefine.diagnose.joints.repeatability import common_part, scatter
from lerobot_vtrefine.diagnose.recordings import read_recording_set

SMALL = Rig(joints=("shoulder", "elbow"), rate_hz=20.0, seconds=5.0, conditions=8, jitter=0.1)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    return read_recording_set(make_set(SMALL, tmp_path_factory.mktemp("robot"), 0))


def test_scatter_tells_noise_from_shape_and_zero(recordings) -> None:
    batch = make_batch(recordings.trials)
    noise = 1e-3 * np.random.default_rng(0).normal(size=batch.position.shape)
    plain = scatter(batch, noise)
    assert plain is not None
    np.testing.assert_allclose(plain.white, 1e-3, rtol=0.2)
    np.testing.assert_allclose(plain.shape, 1e-3, rtol=0.2)
    second = np.array([place % 2 for place in range(batch.trials)])
    waves = np.sin(2 * np.pi * 0.7 * batch.time_s)[..., None] * second[:, None]
    shaped, shifted = scatter(batch, noise + 0.02 * waves), scatter(batch, noise + 0.02 * second[:, None])
    assert shaped is not None
    assert shifted is not None
    assert (shaped.shape > 5e-3).all()
    assert (shifted.zero > 0.01).all()
    np.testing.assert_allclose(shifted.shape, plain.shape, rtol=1e-6)
    np.testing.assert_allclose(shaped.white, plain.white, rtol=0.2)


def test_what_repeats_is_a_part_of_the_repeated_trials_alone(recordings) -> None:
    batch = make_batch(recordings.trials)
    first = [batch.conditions.index(name) for name in batch.conditions]
    keep = [place for place, trial in enumerate(recordings.trials) if place in first or trial.order % 2]
    fewer = batch.subset(keep)
    # All trials repeat exactly; those whose command came once err most.
    once = np.array([fewer.conditions.count(name) == 1 for name in fewer.conditions])
    assert once.any()
    wave = np.sin(fewer.time_s)[..., None] * np.where(once, 3.0, 1.0)[:, None] * np.ones(2)
    products, squares = common_part(fewer, wave)
    assert len(products) == (~once).sum() / 2
    np.testing.assert_allclose(products, squares)


def test_readings_in_coarse_steps_scatter_by_their_step(recordings) -> None:
    batch = make_batch(recordings.trials)
    rng = np.random.default_rng(0)
    # Less than a step of noise: most readings stay, some jump by a whole step.
    coarse = 2e-3 * (rng.random(batch.position.shape) < 0.1)
    seen = scatter(batch, coarse)
    assert seen is not None
    assert (seen.white > 0.3 * seen.shape).all()


def test_scatter_tells_what_comes_with_motion_and_what_is_the_servos(recordings) -> None:
    batch = make_batch(recordings.trials)
    rng = np.random.default_rng(0)
    noise = 1e-4 * rng.normal(size=batch.position.shape)
    speed = np.abs(np.gradient(batch.command, axis=0))
    moving = noise + 0.5 * speed * rng.normal(size=batch.position.shape)
    wandering = noise + 0.005 * np.sin(3 * batch.time_s + 6 * rng.random(batch.trials))[..., None]
    own = {k: np.stack([speed[..., k], speed[..., k] ** 2], -1) for k in range(2)}
    changed = noise + 0.02 * own[1][..., :1] * rng.normal(size=batch.trials)[:, None]
    seen = [scatter(batch, values, own) for values in (moving, wandering, changed)]
    ratios = [item.shape / item.resting for item in seen]
    assert (ratios[0] > 1.6).all()
    assert (ratios[1] < 1.6).all()
    assert seen[2].servo[1] > 0.01
    np.testing.assert_allclose(seen[2].shape[1], 1e-4, rtol=0.3)


def test_no_scatter_without_repeated_commands(recordings) -> None:
    once = {trial.condition: trial for trial in recordings.trials}
    batch = make_batch(tuple(once.values()))
    assert scatter(batch, np.zeros_like(batch.position)) is None


def test_trials_that_do_not_repeat_raise_an_alarm(recordings) -> None:
    rng = np.random.default_rng(1)
    trials = []
    for trial in recordings.trials:
        drop = rng.uniform(0.5, 1.0) * np.sin(
            2 * np.pi * rng.uniform(0.3, 0.6) * trial.time_s + rng.uniform(0, 6)
        )
        trials.append(replace(trial, position=trial.position + 0.03 * drop[:, None] * [1, 0]))
    found = diagnose_robot(replace(recordings, trials=tuple(trials)), seed=0)
    assert found.verdict.status == "unexplained"
    assert found.verdict.unknown.alarm
    assert "shoulder" in (found.verdict.unknown.clue or "")


UNREPEATED = Rig(joints=("shoulder", "elbow"), seconds=5.0, replicates=1)
FAR = "far more is left than the encoder scatters, and no command came twice"


def slew_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that move on by 30 mrad a frame at most: no cause that has a name."""

    def limited(rig, rng, command):
        for k in range(1, command.shape[1]):
            before = command[:, k - 1]
            command[:, k] = before + np.clip(command[:, k] - before, -0.03, 0.03)
        return command

    monkeypatch.setattr(robot_rigs, "lossy", lambda rig, rng, command: limited(rig, rng, command.copy()))


def test_what_is_far_beyond_noise_is_told_where_no_command_came_twice(tmp_path, monkeypatch) -> None:
    slew_limited(monkeypatch)
    found = diagnose_robot(read_recording_set(make_set(UNREPEATED, tmp_path, 3)), seed=0)
    assert found.verdict.status == "unexplained"
    assert FAR in (found.verdict.unknown.clue or "")


@pytest.mark.parametrize("nasty", [0.0, 1.0], ids=["sound", "nasty"])
def test_no_sound_robot_is_far_beyond_its_noise(tmp_path, nasty) -> None:
    rig = replace(UNREPEATED, nasty=nasty, servo_scatter=0.02, jitter=0.1)
    found = diagnose_robot(read_recording_set(make_set(rig, tmp_path, 4)), seed=0)
    assert found.verdict.status == "adequate"
