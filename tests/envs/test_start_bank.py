"""Episodes from a bank continue the episodes that its states were taken from."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.envs.factory import make_episodes, make_simulation
from lerobot_vtrefine.envs.grasps import ExpertPlayer, grasp_states
from lerobot_vtrefine.envs.recording_note import simulation_settings
from lerobot_vtrefine.envs.single_env import VtRefineEnv
from lerobot_vtrefine.envs.start_bank import HELD_OUT_BELOW, HELD_OUT_EVERY, StartBank, bank_settings
from lerobot_vtrefine.envs.vector_env import VtRefineVectorEnv
from lerobot_vtrefine.finetune.seeds import EVALUATION_SEEDS, TRAINING_SEEDS
from lerobot_vtrefine.sim.config import CameraConfig, RandomizationConfig, SceneConfig, WarpConfig
from lerobot_vtrefine.sim.demonstrations import Degradation
from lerobot_vtrefine.sim.expert import Phase, ScriptedExpert
from lerobot_vtrefine.tactile import SensorModel
from lerobot_vtrefine.tactile.stages.mechanics import ViscoelasticRelaxation

EYE = CameraConfig(16, 12, 0.6, (-0.44, 0.0, 0.42), (0.0, 0.0, 0.1))
WORLDS = RandomizationConfig(
    clearance_m=(0.0015, 0.003),
    part_mass_scale=(0.8, 1.5),
    pad_stiffness_scale=(0.5, 2.0),
    sensor_gain_scale=(0.5, 2.0),
    contact_force_n=(5.0, 20.0),
    camera_position_m=0.01,
)
FIRST_SEED = 40


def a_task(folder: Path, **changes) -> VtRefineEnvConfig:
    """One in which no two worlds are alike, pads remember and readings have noise."""
    path = folder / "sensor_model.json"
    SensorModel.default().with_stage(ViscoelasticRelaxation()).save(path)
    scene = SceneConfig(camera=EYE, depth_sensor="d405")
    settings = {"start": "grasped", "scene": scene, "randomization": WORLDS, "sensor_model": str(path)}
    return VtRefineEnvConfig(**{"num_threads": 1, "warp": WarpConfig(device="cpu"), **settings, **changes})


def frames(episodes: Episodes) -> dict[str, np.ndarray]:
    sim = episodes.sim
    plug, socket = sim.part_poses()
    told = {"plug": plug, "socket": socket, "critic": sim.privileged(), "steps": sim.steps}
    return {key: np.copy(value) for key, value in (episodes.raw | told).items()}


@pytest.mark.parametrize("backend", ["single", "batch", "warp"])
def test_an_episode_goes_on_exactly_in_other_worlds_and_another_batch(tmp_path: Path, backend: str):
    config = a_task(tmp_path, backend=backend)
    taken_from = make_episodes(config, 3)
    taken_from.reset(taken_from.ids, FIRST_SEED + taken_from.ids)
    noise = np.random.default_rng(0).normal(0, 0.01, (7, 3, 16))
    actions = taken_from.sim.command_targets() + noise
    for action in actions[:3]:
        taken_from.step(action)
    states = {FIRST_SEED + world: taken_from.sim.get_state(world) for world in range(3)}
    seen = [frames(taken_from)]
    for action in actions[3:]:
        taken_from.step(action)
        seen.append(frames(taken_from))
    path = tmp_path / "bank.npz"
    StartBank.of_states(bank_settings(config), states).save(path)

    again = make_episodes(dataclasses.replace(config, start_bank=path), 4)
    again.reset(again.ids, np.arange(4))  # other episodes before, in worlds with other parameters
    worlds, source = np.array([1, 3, 0]), np.array([2, 1, 0])
    again.reset(worlds[:2], HELD_OUT_BELOW + np.array([1, 0]))
    again.reset(worlds[2:], np.array([5]))
    for step, before in enumerate(seen):
        for key, values in frames(again).items():
            np.testing.assert_array_equal(values[worlds], before[key][source], err_msg=f"{key}, step {step}")
        if step < 4:
            action = np.zeros((4, 16)) + again.sim.command_targets()
            action[worlds] = actions[3 + step][source]
            again.step(action)
    assert np.abs(seen[-1]["plug"] - seen[0]["plug"]).max() > 1e-3
    assert np.abs(seen[-1]["tactile"].astype(int) - seen[0]["tactile"]).max() > 3
    assert (again.steps[worlds] == 4).all()


@pytest.fixture(scope="module")
def picked(tmp_path_factory) -> VtRefineEnvConfig:
    """A task from the table whose episodes start from nine grasps of the expert."""
    path = tmp_path_factory.mktemp("picked") / "bank.npz"
    config = VtRefineEnvConfig(start="table", num_threads=1, scene=SceneConfig(camera=EYE))
    states = dict(grasp_states(ExpertPlayer(config, Degradation(), 9), FIRST_SEED, 1))
    assert list(states) == list(range(FIRST_SEED, FIRST_SEED + 9))
    StartBank.of_states(bank_settings(config), states).save(path)
    return dataclasses.replace(config, start_bank=path)


def test_both_parts_are_in_hand_and_the_expert_goes_on_from_there(picked: VtRefineEnvConfig):
    player = ExpertPlayer(picked, Degradation(), 3)
    player.start(HELD_OUT_BELOW + np.arange(3))
    sim = player.episodes.sim
    assert sim.in_hand.all()
    plug, socket = sim.part_poses()
    rest = sim.scene.pair.plug.rest_height_m, sim.scene.pair.socket.rest_height_m
    assert (np.stack([plug[:, 2], socket[:, 2]], 1) - rest > 0.01).all()
    assert (player._expert.phase == Phase.LIFT).all()
    begun = sim.steps.copy()
    while len(player.episodes.active):
        player.move()
    assert player.episodes.success.all()
    assert (player.episodes.steps + begun == sim.steps).all()
    taken = sim.metrics()["time_to_success_s"]
    np.testing.assert_allclose(taken, 0.1 * sim.steps)  # from the table on
    assert (taken > 4.0).all()


def test_the_time_that_is_left_is_that_of_the_episode_from_the_table(picked: VtRefineEnvConfig):
    env = VtRefineVectorEnv(picked, 2)
    env.reset(seed=[HELD_OUT_BELOW, HELD_OUT_BELOW + 1])
    sim = env.episodes.sim
    begun, hold = sim.steps.copy(), sim.command_targets()
    left = sim.privileged()[:, sim.privileged_names.index("time_left")]
    np.testing.assert_allclose(left, 1 - begun / 240, rtol=1e-6)
    assert (begun > 20).all()
    while len(env.episodes.active):
        env.episodes.step(hold, reads=False)
    assert env.episodes.truncated.all()
    np.testing.assert_array_equal(env.episodes.steps, 240 - begun)


def test_an_episode_is_a_function_of_its_seed_in_every_kind_of_environment(picked: VtRefineEnvConfig):
    seeds = [HELD_OUT_BELOW + 3, 7, HELD_OUT_BELOW]
    many, one = VtRefineVectorEnv(picked, 3), VtRefineEnv(picked)
    together, _ = many.reset(seed=seeds)
    held = [many.episodes.sim.get_state(world)["row"] for world in range(3)]
    for position, seed in enumerate(seeds):
        alone, _ = one.reset(seed=seed)
        np.testing.assert_array_equal(alone["agent_pos"], together["agent_pos"][position])
        np.testing.assert_array_equal(one._batch.episodes.sim.get_state(0)["row"], held[position])
    assert len({row.tobytes() for row in held}) == 3
    again, _ = many.reset(seed=seeds, options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(again["agent_pos"], together["agent_pos"])


@pytest.mark.parametrize("count", [2, 9, 256])
def test_held_out_seeds_have_states_of_their_own_and_many_seeds_use_all(count: int):
    bank = StartBank({}, np.arange(count), {})
    seeds = np.arange(4 * count)
    held_out, training = (set(bank.chosen(first + seeds).tolist()) for first in (0, HELD_OUT_BELOW))
    assert not held_out & training
    assert held_out | training == set(range(count))
    assert len(held_out) == -(-count // HELD_OUT_EVERY)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"pair": "square"}, "scene.pair is round there and square here"),
        ({"clearance_m": 0.001}, "scene.clearance_m is 0.002 there and 0.001 here"),
        ({"start": "grasped"}, "scene.start is table there and grasped here"),
        ({"scene": SceneConfig(embodiment="kinova")}, "scene.embodiment is aloha there and kinova here"),
        (
            {"randomization": RandomizationConfig(part_friction=(0.1, 0.2))},
            "randomization.part_friction.0 is None there and 0.1 here",
        ),
        ({"sensor_model": "paper"}, "sensor_model is default there and paper here"),
        ({"backend": "warp"}, "physics is mujoco there and warp here"),
    ],
)
def test_another_task_is_refused_in_one_line(picked: VtRefineEnvConfig, change: dict, named: str):
    config = dataclasses.replace(picked, **change)
    assert picked.start_bank is not None
    with pytest.raises(ValueError, match=f"bank.npz holds states of another task: .*{named}") as told:
        StartBank.load(picked.start_bank, config)
    assert "\n" not in str(told.value)


def test_what_is_no_bank_is_refused_and_what_does_not_matter_is_not(
    picked: VtRefineEnvConfig, tmp_path: Path
):
    wrong = tmp_path / "wrong.npz"
    np.savez(wrong, qpos=np.zeros(3))
    with pytest.raises(ValueError, match="no bank of states"):
        make_episodes(dataclasses.replace(picked, start_bank=wrong), 1)
    assert picked.start_bank is not None
    elsewhere = dataclasses.replace(
        picked, mesh_dir=tmp_path, backend="single", task="other words", ablate="touch_shuffled"
    )
    bank = StartBank.load(picked.start_bank, elsewhere)
    assert len(bank.source) == 9
    latest = int(bank.leaves["state/episode/steps"].max())
    StartBank.load(picked.start_bank, dataclasses.replace(picked, episode_steps=latest + 1))
    with pytest.raises(
        ValueError, match=f"a state of control step {latest}, and episodes end after {latest}:"
    ):
        StartBank.load(picked.start_bank, dataclasses.replace(picked, episode_steps=latest))


def test_a_bank_that_another_version_recorded_is_refused_in_one_line(
    picked: VtRefineEnvConfig, tmp_path: Path
):
    assert picked.start_bank is not None
    bank = StartBank.load(picked.start_bank, picked)
    bank.leaves.pop("state/episode/picked_up")
    older = dataclasses.replace(picked, start_bank=tmp_path / "older.npz")
    bank.save(older.start_bank)
    episodes = make_episodes(older, 1)
    with pytest.raises(ValueError, match=r"lack state/episode/picked_up.*make the bank anew"):
        episodes.reset(episodes.ids, FIRST_SEED + episodes.ids)


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda held: held.pop("state/episode/steps"), "is no bank of states"),
        (lambda held: held.update(settings=np.array("{")), "is damaged, its settings are no JSON"),
        (lambda held: held.update({"state/row": held["state/row"][:1]}), "not every state has a state/row"),
    ],
)
def test_a_damaged_bank_is_named_in_one_line(
    picked: VtRefineEnvConfig, tmp_path: Path, damage: Callable[[dict[str, np.ndarray]], object], told: str
):
    with np.load(picked.start_bank) as bank:
        held = dict(bank)
    damage(held)
    np.savez(tmp_path / "damaged.npz", **held)
    with pytest.raises(ValueError, match=rf"damaged\.npz .*{told}"):
        StartBank.load(tmp_path / "damaged.npz", picked)


def test_notes_of_recordings_tell_banks_apart(picked: VtRefineEnvConfig):
    noted = simulation_settings(picked)
    assert len(noted["start_bank"]) == 64
    assert noted == simulation_settings(dataclasses.replace(picked, start_bank=None)) | {
        "start_bank": noted["start_bank"]
    }


@pytest.mark.parametrize("socket", ["held", "stands"])
def test_parts_that_stand_on_the_table_are_not_in_hand(socket: str):
    sim = make_simulation(
        VtRefineEnvConfig(start="table", num_threads=1, scene=SceneConfig(socket=socket)), 1
    )
    everyone = np.arange(1)
    sim.reset(everyone, everyone)
    expert = ScriptedExpert(sim)
    expert.reset(everyone)
    held = []
    while expert.phase[0] < Phase.CARRY:
        sim.step(expert.act(everyone))
        held.append((int(expert.phase[0]), bool(sim.in_hand[0])))
        picked_up = bool(sim.metrics()["picked_up"][0])
        assert picked_up == any(held_now for _, held_now in held)
    assert not any(held_now for phase, held_now in held if phase <= Phase.CLOSE)
    assert held[-1][1]
    assert picked_up


def test_no_seed_that_training_uses_is_held_out():
    assert TRAINING_SEEDS == HELD_OUT_BELOW > EVALUATION_SEEDS
