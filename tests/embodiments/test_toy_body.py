"""A body that this file alone defines goes all the way: scene, environment, dataset, policy, DPPO, replay,
diagnosis. It has one arm of three joints, whose names say nothing, and one pad of 4 x 8 taxels on its only
finger.
"""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from lerobot.configs import PolicyFeature
from lerobot.configs.policies import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_vtrefine.cli import diagnose as diagnose_command
from lerobot_vtrefine.cli.finetune import main as finetune
from lerobot_vtrefine.cli.record_demos import RecordDemosConfig
from lerobot_vtrefine.datasets.episodes import open_episodes
from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY, dataset_features, raw_keys
from lerobot_vtrefine.diagnose.episode_replay.compare import compare_episodes
from lerobot_vtrefine.diagnose.joints.engine import diagnose_robot
from lerobot_vtrefine.diagnose.parts.engine import diagnose_parts, weigh
from lerobot_vtrefine.diagnose.parts.episodes import assumed_scene, read_episodes
from lerobot_vtrefine.embodiments import (
    ALOHA,
    Arm,
    CameraConfig,
    Embodiment,
    Joint,
    Pad,
    SlidingFingers,
    register_embodiment,
)
from lerobot_vtrefine.embodiments.embodiment import PITCH, YAW
from lerobot_vtrefine.embodiments.shapes import box, capsule
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.demo_dataset import DemoDataset
from lerobot_vtrefine.envs.demonstrations import Demonstration
from lerobot_vtrefine.envs.vector_env import VtRefineVectorEnv
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy
from lerobot_vtrefine.policies.vt_dp3.processor_vt_dp3 import make_vt_dp3_pre_post_processors
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.simulation import InsertionSim
from lerobot_vtrefine.sim.starts import Start
from lerobot_vtrefine.tactile.layout import PadLayout


def link(name: str, axis: int, offset_m: tuple[float, float, float]) -> Joint:
    looks = (capsule(0.02, (0.0, 0.0, 0.0), (0.2, 0.0, 0.0)),)
    servo = {"stiffness": 60.0, "damping": 6.0, "armature": 0.05, "friction_loss": 0.0, "torque_limit": 60.0}
    body = {"mass_kg": 0.5, "com_m": (0.1, 0.0, 0.0), "inertia": (2e-4, 2e-3, 2e-3)}
    return Joint(name, offset_m, axis, -2.0, 2.0, **servo, **body, shapes=looks)


CAMERA = CameraConfig(16, 12, 0.6, (0.6, 0.0, 0.5), (0.0, 0.0, 0.1))
TOY = Embodiment(
    name="toy",
    robot_type="toy_follower",
    arms=(Arm("only", "plug", (-0.4, 0.0, 0.1), 0.0, (0.1, -0.4, 0.5)),),
    joints=(
        link("alpha", YAW, (0.0, 0.0, 0.1)),
        link("beta", PITCH, (0.0, 0.0, 0.0)),
        link("gamma", PITCH, (0.2, 0.0, 0.0)),
    ),
    fingers=SlidingFingers(
        pad=Pad("{arm}_skin", (0.018, 0.010, 0.003), PadLayout(4, 8)),
        stiffness=1000.0,
        damping=10.0,
        armature=0.1,
        force_limit_n=40.0,
        palm=(box((0.02, 0.02, 0.02), (0.18, 0.0, 0.0), name="palm"),),
        flattest_rad=0.1,
        sides=("left",),
        slide_offset_m=0.2,
        pad_offset_m=0.05,
        slide_m=0.03,
        face_m=0.0,
        finger_kg=0.05,
        finger_com_m=(0.03, 0.005),
        finger_inertia=(1e-5, 2e-5, 2e-5),
    ),
    base=(),
    cameras={"table": CAMERA, "grasped": CAMERA},
)
register_embodiment(TOY)

FRAMES = 40
PLAY_RAD = 0.04
TOUCHES = ("observation.tactile.only_skin", "observation.tactile_baseline.only_skin")


def environment(reality: Path | None = None) -> VtRefineEnvConfig:
    scene = SceneConfig(embodiment="toy", timestep_s=0.005)
    return VtRefineEnvConfig(scene=scene, episode_steps=FRAMES, backend="single", reality=reality)


def commands(episode: int) -> np.ndarray:
    """Joint targets (FRAMES, 4) that differ between episodes and stay in the air."""
    time = np.arange(FRAMES)[:, None] / 10
    phase = np.random.default_rng(episode).uniform(0, 2 * np.pi, 4)
    swing = np.array([0.4, 0.25, 0.3, 0.012]) * np.sin(np.array([1.5, 2.1, 2.7, 1.1]) * time + phase)
    return (TOY.home - [0, 0, 0, 0.015] + swing * np.minimum(time, 1.0)).astype(np.float32)


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reality file: the upright axis has play, and no servo carries the arm's weight."""
    path = tmp_path_factory.mktemp("toy") / "reality.json"
    hidden = {"robot": {"backlash_rad": {"only_alpha": PLAY_RAD}}, "scene": {"gravity_compensation": False}}
    path.write_text(json.dumps({"schema": "vtrefine/reality@1", **hidden}))
    return path


def record(root: Path, config: VtRefineEnvConfig, episodes: int) -> Path:
    env = VtRefineVectorEnv(config, 1)
    settings = RecordDemosConfig(root=root, env=config).settings()
    features = dataset_features(*config.camera_size, TOY)
    with DemoDataset(root, "local/toy", config.fps, features, TOY, "move", settings, first_seed=0) as demos:
        for episode in range(episodes):
            env.reset(seed=[episode])
            frames = []
            for action in commands(episode):
                frames.append({key: value[0].copy() for key, value in env.episodes.raw.items()})
                env.step(action[None])
            raw = {key: np.stack([frame[key] for frame in frames]) for key in frames[0]}
            demos.append(Demonstration(raw, commands(episode), {"seed": episode, "success": False}))
    return root


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("toy") / "demos", environment(), 2)


def test_its_kinematics_are_the_scenes() -> None:
    sim = InsertionSim(SceneConfig(embodiment="toy"), backend="single")
    data = mujoco.MjData(sim.scene.model)
    q = np.array([0.3, -0.5, 0.7, 0.02])
    data.qpos[sim.scene.addresses.qpos] = q
    mujoco.mj_kinematics(sim.scene.model, data)
    position, rotation = (item[0].numpy() for item in TOY.pad_poses(torch.from_numpy(q)))
    np.testing.assert_allclose(data.geom("only_skin").xpos, position - 0.0015 * rotation[:, 2], atol=1e-9)
    with pytest.raises(ValueError, match="needs two hands, and toy has one"):
        ScriptedExpert(sim)
    with pytest.raises(ValueError, match="start=grasped needs two hands, and toy has one"):
        InsertionSim(SceneConfig(embodiment="toy", start="grasped"), backend="single").reset(
            np.arange(1), np.arange(1)
        )


def test_its_pad_feels_what_it_presses() -> None:
    """The finger slides against the plug's handle, which is too heavy to be pushed away."""
    sim = InsertionSim(SceneConfig(embodiment="toy", part_density=2e5), backend="single")
    world, q = np.zeros(1, np.int64), np.array([[0.0, 0.2, 0.27, 0.03]])
    position, rotation = (item[0, 0].numpy() for item in TOY.pad_poses(torch.from_numpy(q)))
    assert position[2] == pytest.approx(0.047, abs=0.002)
    x, y, _ = position + 0.018 * rotation[:, 2]
    plug, socket = np.array([[x, y, 0, 1, 0, 0, 0]]), np.array([[0.2, 0.2, 0.075, 1, 0, 0, 0]])
    sim.reset(world, world, Start(q, q, plug, socket, settle_s=0.05))
    idle = sim.tactile()
    for _ in range(3):
        sim.step(q - [0, 0, 0, 0.01])
    assert idle.shape == (1, 1, 32)
    assert (sim.tactile().astype(int) - idle).max() > 20
    assert 1.0 < sim._episode.pad_force[0, 0] < 10.0


def test_environment_and_dataset_have_its_joints_and_pads(dataset: Path) -> None:
    env = VtRefineVectorEnv(environment(), 2)
    assert env.single_action_space.shape == (4,)
    np.testing.assert_allclose(env.single_action_space.low, TOY.lower)
    observation, _ = env.reset(seed=0)
    assert observation["agent_pos"].shape == (2, 4)
    assert observation["tactile.only_skin"].shape == (2, 32)
    with pytest.raises(ValueError, match=r"shape \(2, 4\), got \(2, 16\)"):
        env.step(np.zeros((2, 16)))
    found = LeRobotDataset("local/toy", root=dataset)
    assert found.meta.robot_type == "toy_follower"
    assert found.meta.features[STATE_KEY]["names"] == [f"{name}.pos" for name in TOY.joint_names]
    assert found.meta.features[TOUCHES[0]]["info"]["array_shape"] == [4, 8]
    assert found[0][STATE_KEY].shape == (4,)


def toy_policy(dataset: Path, folder: Path) -> Path:
    """One training step of a tiny vt_dp3 on the dataset; the checkpoint's folder."""
    meta = LeRobotDataset("local/toy", root=dataset).meta
    config = VtDp3Config(
        preset="small", point_dims=(8, 8), point_features=8, down_dims=(32,), time_dim=8, device="cpu"
    )
    config.observation = type(config.observation)(
        embodiment="toy", num_visual_points=8, pixel_stride=1, pool_rows=2, pool_cols=4
    )
    for key in config.required_keys:
        config.input_features[key] = PolicyFeature(FeatureType.STATE, tuple(meta.features[key]["shape"]))
    config.output_features = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (TOY.num_joints,))}
    config.validate_features()
    seen = (STATE_KEY, *raw_keys(TOY))
    steps = {key: [k / 10 for k in config.observation_delta_indices] for key in seen}
    steps[ACTION_KEY] = [k / 10 for k in config.action_delta_indices]
    windows = LeRobotDataset("local/toy", root=dataset, delta_timestamps=steps)
    batch = torch.utils.data.default_collate([windows[5], windows[20]])
    processors = make_vt_dp3_pre_post_processors(config, dict(meta.stats))
    batch = processors[0](batch)
    assert batch["observation.visuo_tactile"].shape == (2, 2, 8 + 2 * 2, 5)
    policy = VtDp3Policy(config)
    loss, _ = policy.forward(batch)
    loss.backward()
    assert torch.isfinite(loss)
    for part in (policy, *processors):
        part.save_pretrained(folder)
    return folder


def test_policy_trains_and_dppo_iterates(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, output = toy_policy(dataset, tmp_path / "policy"), tmp_path / "run"
    flags = [
        f"--policy.path={policy}",
        f"--output_dir={output}",
        "--env.type=vtrefine",
        "--env.scene.embodiment=toy",
        "--env.scene.timestep_s=0.005",
        "--env.episode_steps=16",
        "--env.backend=single",
        "--eval_freq=0",
        "--dppo.type=small",
        "--dppo.iterations=1",
        "--dppo.num_envs=2",
        "--dppo.epochs=1",
        "--dppo.minibatch_decisions=2",
        "--dppo.critic_width=8",
    ]
    monkeypatch.setattr("sys.argv", ["vtrefine-finetune", *flags])
    assert finetune() == 0
    assert (output / "checkpoints" / "last" / "pretrained_model" / "model.safetensors").is_file()


def test_replay_reproduces_its_recording(dataset: Path) -> None:
    comparison = compare_episodes(open_episodes(dataset), [1])
    assert comparison.parts == "recorded"
    assert [(pad.pad, pad.identical_frames) for pad in comparison.touch] == [("only_skin", FRAMES)]
    assert max(row.peak for row in comparison.tracking) == 0.0


def test_diagnosis_finds_its_play_and_its_weight(faulty: Path, tmp_path: Path) -> None:
    """Which joints gravity pulls at, and how much, is the body's knowledge: their names do not tell."""
    # Of eight episodes six are left to learn from, and the last digits of a sum decide whether that suffices.
    root = record(tmp_path / "faulty", environment(faulty), 12)
    options = diagnose_command.make_parser().parse_args([f"--dataset.root={root}", "--output_dir=unused"])
    found = diagnose_robot(diagnose_command.read(options), seed=0)
    params = {
        cause.name: {key: item.value for key, item in cause.params.items()} for cause in found.verdict.causes
    }
    assert set(params) == {"backlash", "gravity_sag"}
    assert params["backlash"] == pytest.approx({"only_alpha_rad": PLAY_RAD}, rel=0.05)
    # Weights [kg] times levers [m] of the stretched arm: forearm and finger, then upper arm as well.
    forearm, stiffness, g = 0.5 * 0.1 + 0.05 * 0.23, 60.0, 9.81
    both = 0.5 * 0.1 + 0.5 * 0.3 + 0.05 * 0.43
    sag = {"only_beta_rad": both * g / stiffness, "only_gamma_rad": forearm * g / stiffness}
    assert params["gravity_sag"] == pytest.approx(sag, rel=0.03)


def test_diagnosis_says_what_it_lacks_to_weigh_parts(dataset: Path) -> None:
    """In a line: its hand has one pad, and whether a hand holds something takes two that face each other."""
    scene = assumed_scene(open_episodes(dataset))
    assert scene is not None
    episodes = read_episodes(dataset, scene)
    found = diagnose_parts(scene, episodes, weigh(scene, episodes))
    assert found.verdict.status == "adequate"
    reasons = {item.name: (item.decision, item.reason) for item in found.evidence}
    assert {decision for decision, _ in reasons.values()} == {"not identifiable"}
    assert "toy has no hand that holds the socket" in reasons["clearance"][1]
    assert "toy has one pad per hand" in reasons["object_friction"][1]
    assert "toy has one pad per hand" in reasons["object_mass"][1]


def test_bodies_differ_in_the_names_of_their_pads() -> None:
    """Otherwise a policy of one body would read another one's touch without a word."""
    assert not set(TOY.pad_names) & set(ALOHA.pad_names)
