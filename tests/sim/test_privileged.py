"""What only the critic sees, and that drawn sensors and cameras reach what the policy sees."""

import guide
import numpy as np

from lerobot_vtrefine.sim.config import LimitsConfig, RandomizationConfig, SceneConfig, TaskConfig
from lerobot_vtrefine.sim.simulation import InsertionSim
from lerobot_vtrefine.tactile.model import SensorModel

IN_HAND = SceneConfig(start="grasped")
EVERYONE = np.arange(3)


def column(sim: InsertionSim, name: str) -> np.ndarray:
    """Columns of the privileged vector (m, n) whose names begin with `name`."""
    chosen = [index for index, own in enumerate(sim.privileged_names) if own.rpartition("_")[0] == name]
    return sim.privileged()[:, chosen or [sim.privileged_names.index(name)]]


def test_the_critic_sees_how_much_of_the_limits_is_used_up() -> None:
    limits = LimitsConfig(in_hand_shift_m=0.04, contact_force_n=400.0)
    sim = InsertionSim(IN_HAND, TaskConfig(limits=limits, episode_steps=40), num_envs=3)
    sim.reset(EVERYONE, EVERYONE)
    pilot = guide.Guide(sim, bias_m=(0.003, 0.0))
    pilot.reset(EVERYONE)
    force, shift = np.zeros(3), np.zeros(3)
    for step in range(1, 31):
        sim.step(pilot.act())
        force = np.maximum(force, column(sim, "force")[:, 0])
        shift = np.maximum(shift, column(sim, "shift").max(1))
        np.testing.assert_allclose(column(sim, "time_left")[:, 0], 1 - step / 40, atol=1e-6)
    metrics = sim.metrics()
    assert (metrics["peak_force_n"] > 3).all()  # the plug stands on the rim
    np.testing.assert_allclose(400.0 * force, metrics["peak_force_n"], rtol=1e-5)
    np.testing.assert_allclose(0.04 * shift, metrics["in_hand_shift_m"], rtol=1e-5)


def test_drawn_gains_scale_the_counts_and_drawn_cameras_move_the_image() -> None:
    ranges = {
        "nominal": RandomizationConfig(),
        "gain": RandomizationConfig(sensor_gain_scale=(0.5, 0.5)),
        "camera": RandomizationConfig(camera_position_m=0.02),
    }
    model = SensorModel.default().without("row_sharing")  # which is not linear in the gain
    seen, critic = {}, {}
    for name, randomization in ranges.items():
        sim = InsertionSim(IN_HAND, num_envs=3, sensor=model, randomization=randomization)
        sim.reset(EVERYONE, EVERYONE)
        seen[name], critic[name] = sim.observe(), column(sim, "sensor_gain_scale")
    assert critic["gain"].tolist() == [[0.5]] * 3
    counts = {name: obs["tactile"].astype(int) - obs["tactile_baseline"] for name, obs in seen.items()}
    touched = counts["nominal"] > 10
    pressed = {name: (above * touched).sum((1, 2)) for name, above in counts.items()}
    np.testing.assert_allclose(pressed["gain"] / pressed["nominal"], 0.5, atol=0.02)
    np.testing.assert_array_equal(pressed["camera"], pressed["nominal"])
    np.testing.assert_array_equal(seen["gain"]["depth_mm"], seen["nominal"]["depth_mm"])
    changed = (seen["camera"]["depth_mm"] != seen["nominal"]["depth_mm"]).mean((1, 2))
    assert (changed > 0.5).all()
