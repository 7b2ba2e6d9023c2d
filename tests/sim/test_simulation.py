import guide
import mujoco
import numpy as np
import pytest

from lerobot_vtrefine.information.quantities import observe
from lerobot_vtrefine.sim.config import (
    GraspedStart,
    LimitsConfig,
    RandomizationConfig,
    SceneConfig,
    SuccessConfig,
    TaskConfig,
    WarpConfig,
)
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.simulation import FAILURES, InsertionSim

IN_HAND = SceneConfig(start="grasped")


def insertion_sim(num_envs=4, scene=IN_HAND, **kwargs):
    return InsertionSim(scene, kwargs.pop("rules", TaskConfig()), "paper", num_envs, **kwargs)


def wiggle(sim, steps, seed=0):
    """Joint targets (steps, N, 16) around the present ones."""
    noise = np.random.default_rng(seed).normal(0, 0.01, (steps, sim.num_envs, 16))
    return sim.command_targets() + noise


def qpos(sim, ids=None):
    return np.concatenate([sim.joint_state(ids), *sim.part_poses(ids)], 1)


@pytest.mark.parametrize("start", ["grasped", "table"])
def test_reset_depends_on_the_seed_alone(start):
    scene = SceneConfig(start=start)
    many, one = insertion_sim(4, scene), insertion_sim(1, scene)
    many.reset(np.arange(4), np.array([7, 3, 5, 11]))
    many.step(many.command_targets())
    many.reset(np.array([1, 2]), np.array([5, 42]))
    one.reset(np.array([0]), np.array([42]))
    np.testing.assert_array_equal(qpos(many, [2]), qpos(one))
    one.reset(np.array([0]), np.array([5]))
    np.testing.assert_array_equal(qpos(many, [1]), qpos(one))
    assert np.abs(qpos(many, [1]) - qpos(many, [2])).max() > 1e-4
    seen_before = one.observe()
    one.reset(np.array([0]), np.array([5]))
    for name, values in one.observe().items():
        np.testing.assert_array_equal(values, seen_before[name], err_msg=name)


def test_start_in_hand_holds_both_parts_above_each_other():
    sim = insertion_sim(16)
    sim.reset(np.arange(16), np.arange(16))
    state = sim.insertion()
    assert (state.depth_m < -0.010).all()
    assert (state.lateral_m < 0.02).all()
    assert np.ptp(state.position_m[:, :2], axis=0).min() > 0.003  # starts differ
    before = sim.part_poses()
    for _ in range(5):
        sim.step(sim.command_targets())
    moved = np.concatenate(sim.part_poses()) - np.concatenate(before)
    assert np.abs(moved[:, :3]).max() < 2e-3  # the arms give way a little under the parts' weight
    turned = np.abs(moved[:, 3:]).max(1)
    assert np.median(turned) < 2e-3
    assert (
        turned.max() < 0.01
    )  # a few turn between their pads by half a degree; which ones, the processor decides
    assert (sim.metrics()["in_hand_shift_m"] < 3e-4).all()
    assert (sim.observe()["tactile"].astype(int) > sim.observe()["tactile_baseline"]).any(-1).all()


@pytest.mark.parametrize(("slip_z_m", "spread_m"), [(None, 0.004), (0.001, 0.001)])
def test_slip_across_the_fingers_is_its_own(slip_z_m: float | None, spread_m: float):
    rules = GraspedStart(slip_m=0.004, slip_z_m=slip_z_m, slip_rad=0.0)
    sim = insertion_sim(24, rules=TaskConfig(grasped=rules))
    ids = np.arange(24)
    sim.reset(ids, ids)
    held = observe(sim, ids).position[:, :2]  # socket and plug in their hands
    for axis, spread in ((0, 0.004), (2, spread_m)):
        lowest, highest = held[..., axis].min(0), held[..., axis].max(0)
        assert (highest - lowest > 1.4 * spread).all()
        assert (highest - lowest < 2.2 * spread).all()


def test_start_on_the_table_rests_within_its_squares():
    sim = insertion_sim(16, SceneConfig(start="table"))
    sim.reset(np.arange(16), np.arange(16))
    plug, socket = sim.part_poses()
    for pose, centre, height in ((plug, (0.0, 0.065), 0.0), (socket, (0.0, -0.06), 0.075)):
        assert (np.abs(pose[:, :2] - centre) <= 0.0151).all()
        np.testing.assert_allclose(pose[:, 2], height, atol=3e-4)
    assert sim.episode_steps == 240
    assert not sim.metrics()["in_hand_shift_m"].any()


def test_observation_has_the_shapes_and_types_of_the_hardware():
    sim = insertion_sim(2)
    sim.reset(np.arange(2), np.arange(2))
    seen = sim.observe(np.array([1]))
    shapes = {name: (values.shape, values.dtype.name) for name, values in seen.items()}
    assert shapes == {
        "state": ((1, 16), "float32"),
        "tactile": ((1, 4, 384), "uint8"),
        "tactile_baseline": ((1, 4, 384), "uint8"),
        "depth_mm": ((1, 60, 80), "uint16"),
    }
    np.testing.assert_array_equal(seen["state"], sim.joint_state([1]))
    assert sim.camera_intrinsics.shape == (4,)
    assert sim.camera_pose.shape == (2, 7)
    assert sim.privileged().shape == (2, len(sim.privileged_names))
    assert len(set(sim.privileged_names)) == len(sim.privileged_names)


def test_backends_agree_bit_for_bit():
    ranges = RandomizationConfig(
        clearance_m=(0.001, 0.003),
        part_mass_scale=(0.8, 1.5),
        pad_friction=(0.7, 1.2),
        pad_stiffness_scale=(0.5, 2.0),
        camera_position_m=0.01,
        camera_rotation_rad=0.02,
    )
    for randomization in (None, ranges):
        runs = []
        for backend in ("single", "batch"):
            sim = insertion_sim(3, backend=backend, randomization=randomization)
            sim.reset(np.arange(3), np.array([5, 6, 7]))
            rewards = [sim.step(action).reward for action in wiggle(sim, 4)]
            runs.append({**sim.observe(), "qpos": qpos(sim), "critic": sim.privileged(), "reward": rewards})
        for name in runs[0]:
            np.testing.assert_array_equal(runs[0][name], runs[1][name], err_msg=name)


def test_stepping_some_worlds_leaves_the_others_alone():
    sim = insertion_sim(4)
    sim.reset(np.arange(4), np.arange(4))
    before = qpos(sim)
    ids = np.array([0, 3])
    sim.step(wiggle(sim, 1)[0][ids], ids)
    np.testing.assert_array_equal(qpos(sim)[1:3], before[1:3])
    assert np.abs(qpos(sim)[ids] - before[ids]).max() > 1e-4
    np.testing.assert_array_equal(sim.steps, [1, 0, 0, 1])


def test_a_snapshot_continues_exactly_even_in_another_world():
    ranges = RandomizationConfig(part_mass_scale=(0.8, 1.5), clearance_m=(0.001, 0.003))
    sim = insertion_sim(2, randomization=ranges)
    sim.reset(np.arange(2), np.array([3, 4]))
    actions = wiggle(sim, 8)
    for action in actions[:3]:
        sim.step(action)
    snapshot = sim.get_state(0)
    for action in actions[3:]:
        sim.step(action)
    wanted = {**sim.observe([0]), "critic": sim.privileged([0]), "qpos": qpos(sim, [0])}
    for env in (0, 1):
        sim.set_state(env, snapshot)
        for action in actions[3:]:
            sim.step(action[:1], [env])
        got = {**sim.observe([env]), "critic": sim.privileged([env]), "qpos": qpos(sim, [env])}
        for name, values in wanted.items():
            np.testing.assert_array_equal(got[name], values, err_msg=f"{name} in world {env}")


def test_commands_are_limited_in_rate_and_range():
    sim = insertion_sim(1)
    sim.reset(np.arange(1), np.arange(1))
    before = sim.command_targets()
    sim.step(before + 5.0)
    change = sim.command_targets() - before
    np.testing.assert_allclose(change[0, :6], 0.1)
    for _ in range(60):
        sim.step(before + 5.0)
    assert (sim.command_targets() <= sim.embodiment.upper + 1e-12).all()


def test_guided_insertion_succeeds_once_and_gets_one_reward():
    sim = insertion_sim(4, rules=TaskConfig(episode_steps=60))
    sim.reset(np.arange(4), np.arange(4))
    pilot = guide.Guide(sim)
    pilot.reset(np.arange(4))
    rewards = []
    for _ in range(50):
        result = sim.step(pilot.act())
        rewards.append(result.reward)
    np.testing.assert_array_equal(np.sum(rewards, 0), 1.0)
    assert result.terminated.all()
    assert not result.truncated.any()
    metrics = sim.metrics()
    assert metrics["success"].all()
    assert (metrics["time_to_success_s"] > 1.0).all()
    assert (metrics["failure"] == 0).all()


@pytest.mark.parametrize("name", ["round", "square"])
def test_undersized_hole_never_succeeds_under_a_guided_push(name):
    scene = SceneConfig(pair=name, start="grasped", negative_control_m=0.0006)
    rules = TaskConfig(episode_steps=60, limits=LimitsConfig(in_hand_shift_m=1.0, contact_force_n=1e4))
    sim = insertion_sim(6, scene, rules=rules)
    metrics = guide.run(sim, guide.Guide(sim), np.arange(6), 60)
    assert not metrics["success"].any()
    assert (metrics["depth_m"] < 0.003).all()


def test_ramming_the_rim_ends_by_force_and_the_limit_decides():
    rules = TaskConfig(limits=LimitsConfig(in_hand_shift_m=1.0), episode_steps=60)
    sim = insertion_sim(4, rules=rules)
    metrics = guide.run(sim, guide.Guide(sim, bias_m=(0.003, 0.0)), np.arange(4), 60)
    assert [FAILURES[code] for code in metrics["failure"]] == ["contact_force"] * 4
    assert (metrics["peak_force_n"] > 20.0).all()
    assert not metrics["success"].any()


def test_pushing_a_part_through_the_hand_ends_by_shift():
    rules = TaskConfig(limits=LimitsConfig(in_hand_shift_m=0.002, contact_force_n=1e4), episode_steps=60)
    sim = insertion_sim(4, rules=rules)
    metrics = guide.run(sim, guide.Guide(sim, bias_m=(0.003, 0.0)), np.arange(4), 60)
    assert [FAILURES[code] for code in metrics["failure"]] == ["in_hand_shift"] * 4
    assert (metrics["in_hand_shift_m"] > 0.002).all()


def test_opening_the_hand_drops_the_part():
    sim = insertion_sim(2, rules=TaskConfig(limits=LimitsConfig(in_hand_shift_m=1.0)))
    sim.reset(np.arange(2), np.arange(2))
    action = sim.command_targets()
    action[:, 14], action[:, 15] = 0.04, -0.04
    for _ in range(15):
        result = sim.step(action)
    assert result.terminated.all()
    assert [FAILURES[code] for code in sim.metrics()["failure"]] == ["dropped"] * 2


def test_time_out_truncates_without_terminating():
    sim = insertion_sim(1, rules=TaskConfig(episode_steps=3))
    sim.reset([0], [0])
    results = [sim.step(sim.command_targets()) for _ in range(3)]
    assert [bool(result.truncated[0]) for result in results] == [False, False, True]
    assert not results[-1].terminated.any()


def test_success_must_be_held():
    rules = TaskConfig(episode_steps=60, success=SuccessConfig(hold_s=0.1))
    quick = insertion_sim(2, rules=rules)
    slow = insertion_sim(2, rules=TaskConfig(episode_steps=60))
    times = [guide.run(sim, guide.Guide(sim), np.arange(2), 60)["time_to_success_s"] for sim in (quick, slow)]
    np.testing.assert_allclose(times[1] - times[0], 0.9, atol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: insertion_sim(0), "num_envs must be at least 1"),
        (lambda: WarpConfig(device="gpu"), "warp.device must be auto, cpu, cuda or cuda:0, not 'gpu'"),
        (lambda: WarpConfig(rows_per_world=0), "warp.rows_per_world must be at least 1"),
        (lambda: WarpConfig(convex_per_world=0), "warp.convex_per_world must be at least 1"),
        (
            lambda: insertion_sim(1, backend="cuda"),
            "backend=cuda is unknown; choose from single, batch, warp",
        ),
        (lambda: SceneConfig(start="floor"), "start=floor is unknown; choose from table, grasped"),
        (lambda: insertion_sim(1, rules=TaskConfig(control_hz=30)), "whole number of physics steps"),
        (lambda: TaskConfig(episode_steps=0), "episode_steps must be a whole number from 1 on"),
        (lambda: RandomizationConfig(clearance_m=(0.0, 0.001)), "randomization.clearance_m needs 0 < lowest"),
        (
            lambda: insertion_sim(1, rules=TaskConfig(grasped=GraspedStart(mouth_m=(0.5, 0, 0.5)))).reset(
                [0], [0]
            ),
            "cannot reach",
        ),
    ],
)
def test_bad_settings_are_named_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_bad_calls_are_refused():
    sim = insertion_sim(2)
    sim.reset(np.arange(2), np.arange(2))
    action = sim.command_targets()
    with pytest.raises(ValueError, match="ids must be sorted"):
        sim.step(action, np.array([1, 0]))
    with pytest.raises(ValueError, match="action must be finite: joint 3 is to go to nan"):
        sim.step(np.where(np.arange(16) == 3, np.nan, action))
    with pytest.raises(ValueError, match=r"action must have shape \(2, 16\), got \(2, 14\)"):
        sim.step(action[:, :14])


def contact_centre(sim: InsertionSim, env: int) -> np.ndarray:
    """Centre of the forces between plug and socket in the socket's frame [m], contact by contact."""
    model, data = sim.mj_data(env)
    bodies = {model.body(name).id for name in ("plug", "socket")}
    weights, places = [], []
    for index, contact in enumerate(data.contact):
        if {int(model.geom_bodyid[geom]) for geom in contact.geom} == bodies:
            force = np.zeros(6)
            mujoco.mj_contactForce(model, data, index, force)
            weights.append(np.linalg.norm(force[:3]))
            places.append(contact.pos.copy())
    centre = np.average(places, axis=0, weights=weights)
    socket = data.body("socket")
    return socket.xmat.reshape(3, 3).T @ (centre - socket.xpos)


def test_a_touch_is_where_the_contacts_are() -> None:
    """A plug that is brought down beside the hole touches the rim on the side that it missed it."""
    for side in (0.005, -0.005):
        sim = insertion_sim(1, rules=TaskConfig(grasped=GraspedStart(plug_height_m=0.006)))
        sim.reset(np.arange(1), np.arange(1))
        assert (sim.part_touch() == 0).all()
        expert = ScriptedExpert(sim)
        expert.reset(np.arange(1))
        expert._errors.lateral_m[:] = (side, 0.0)
        for _ in range(25):
            sim.step(expert.act(np.arange(1)))
            if sim.part_touch()[0, 0]:
                break
        touching, x, y, z = sim.part_touch()[0]
        assert touching == 1
        np.testing.assert_allclose([x, y, z], contact_centre(sim, 0), atol=5e-4)
        assert x * side > 0
        assert abs(z - sim.scene.pair.mouth_z_m) < 2e-3
