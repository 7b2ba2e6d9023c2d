"""ALOHA is what it was before other bodies came; the Kinova is the arm and the linkage of its sources."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature

from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY, dataset_features, raw_keys
from lerobot_vtrefine.embodiments import ALOHA, KINOVA, get_embodiment, register_embodiment
from lerobot_vtrefine.observation.depth import deproject
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.scene import build_scene
from lerobot_vtrefine.sim.simulation import InsertionSim

# Of the version that knew ALOHA only: grasped start, round pair, seed 5.
STATE = [
    -0.0150338,
    0.1687849,
    0.7002522,
    -0.0048375,
    -0.4134333,
    0.0034669,
    0.0219677,
    -0.0219677,
    -0.0381175,
    -0.0099612,
    0.7145525,
    -0.0957133,
    -0.5033706,
    0.0743284,
    0.0166769,
    -0.0166769,
]
COUNTS = [16861, 16953, 16481, 16847]
BASELINE = [9621, 9714, 9362, 9657]
DEPTH_SUM = 2609870


def test_alohas_dataset_features_are_what_they_were() -> None:
    pads = [f"{arm}_arm_{side}_finger" for arm in ("left", "right") for side in ("left", "right")]
    links = [
        "waist",
        "shoulder",
        "elbow",
        "forearm_roll",
        "wrist_angle",
        "wrist_rotate",
        "left_finger",
        "right_finger",
    ]
    names = [f"{arm}_{joint}.pos" for arm in ("left", "right") for joint in links]
    info = {"array_shape": [12, 32], "unit": "adc_counts"}
    expected = {"observation.state": {"dtype": "float32", "shape": (16,), "names": names}}
    for kind in ("tactile", "tactile_baseline"):
        for pad in pads:
            expected[f"observation.{kind}.{pad}"] = {"dtype": "uint8", "shape": (384,), "info": info}
    expected["observation.tactile_age"] = {"dtype": "float32", "shape": (4,)}
    for name, width in (("intrinsics", 4), ("pose", 7), ("noise_level", 1)):
        expected[f"observation.camera.front.{name}"] = {"dtype": "float32", "shape": (width,)}
    expected["observation.images.front_depth"] = {
        "dtype": "image",
        "shape": (60, 80, 1),
        "names": ["height", "width", "channels"],
        "info": {"is_depth_map": True},
    }
    expected["action"] = {"dtype": "float32", "shape": (16,), "names": names}
    found = dataset_features(60, 80, ALOHA)
    assert list(found) == list(expected)
    assert found == expected


def test_alohas_observation_is_what_it_was() -> None:
    """Values of the version before; counts and millimetres may differ by one where arithmetic does."""
    sim = InsertionSim(SceneConfig(start="grasped"), num_envs=1, num_threads=1)
    sim.reset(np.zeros(1, np.int64), np.array([5]))
    seen = sim.observe()
    np.testing.assert_allclose(seen["state"][0], STATE, atol=2e-6)
    np.testing.assert_allclose(seen["tactile"].astype(int).sum((0, 2)), COUNTS, atol=20)
    assert seen["tactile_baseline"].astype(int).sum((0, 2)).tolist() == BASELINE
    assert int(seen["depth_mm"].astype(int).sum()) == pytest.approx(DEPTH_SUM, rel=1e-5)


@pytest.mark.parametrize("start", ["grasped", "table"])
@pytest.mark.parametrize("body", ["aloha", "kinova"])
def test_every_bodys_camera_sees_both_parts(body: str, start: str) -> None:
    """Points that its depth image measures lie on the plug and on the socket."""
    sim = InsertionSim(SceneConfig(embodiment=body, start=start), num_envs=1, num_threads=1)
    sim.reset(np.zeros(1, np.int64), np.array([5]))
    views = sim.depth_mm() / 1000, sim.camera_intrinsics[None], sim.camera_pose.reshape(1, 7)
    points = deproject(*(torch.as_tensor(np.asarray(values), dtype=torch.float64) for values in views))
    for pose in sim.part_poses():
        distance = (points[:, 0].T - torch.as_tensor(pose[0, :3])).norm(dim=1)
        assert (distance < 0.03).sum() >= 20


def test_every_body_stands_in_its_scene_as_its_kinematics_say() -> None:
    """Poses and velocities of the Kinova's pads, which turn as they close (ALOHA's: test_kinematics.py)."""
    scene = build_scene(SceneConfig(embodiment="kinova"))
    data = mujoco.MjData(scene.model)
    rng = np.random.default_rng(0)
    for q in rng.uniform(KINOVA.lower, KINOVA.upper, (10, KINOVA.num_joints)):
        qpos = data.qpos[None].copy()
        scene.joints.write(qpos, q[None])
        data.qpos[:] = qpos[0]
        mujoco.mj_kinematics(scene.model, data)
        position, rotation = KINOVA.pad_poses(torch.from_numpy(q))
        for index, name in enumerate(KINOVA.pad_names):
            face = position[index].numpy() - rotation[index, :, 2].numpy() * KINOVA.fingers.pad.size_m[2] / 2
            np.testing.assert_allclose(data.geom(name).xpos, face, atol=1e-9)
        rates, step = torch.from_numpy(rng.normal(size=KINOVA.num_joints)), 1e-6
        after, before = (KINOVA.pad_poses(torch.from_numpy(q) + sign * step * rates) for sign in (1, -1))
        turning = ((after[1] - before[1]) / (2 * step)) @ rotation.transpose(-1, -2)
        twist = torch.cat([(after[0] - before[0]) / (2 * step), turning[:, [2, 0, 1], [1, 2, 0]]], -1)
        torch.testing.assert_close(
            KINOVA.hands(torch.from_numpy(q)).pad_twists(rates), twist, atol=1e-7, rtol=0
        )


def test_four_bar_closes_and_turns_its_pads() -> None:
    """Distances between the linkage's four hinges stay; the pads turn by 2 degrees over the stroke."""
    fingers = KINOVA.fingers
    angles = np.linspace(0, fingers.closed_rad, 71)
    turn = fingers.linkage_turn(angles)
    out, ahead = fingers.knuckle_m
    lengths = []
    for angle, turned in zip(angles, turn, strict=True):
        cos, sin = np.cos(angle), np.sin(angle)
        end = np.add(fingers.driver_axis_m, (out * cos - ahead * sin, out * sin + ahead * cos))
        x, y = fingers.inner_hinge_m
        hinge = end + np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]]) @ (x, y)
        lengths.append(np.linalg.norm(hinge - fingers.inner_axis_m))
    np.testing.assert_allclose(lengths, lengths[0], atol=1e-9)
    assert np.degrees(turn[0] - turn[-1]) == pytest.approx(2.05, abs=0.02)
    polynomial = np.polynomial.Polynomial(fingers.turn_terms)(angles)
    np.testing.assert_allclose(polynomial, turn - turn[-1], atol=2e-5)
    openings = np.linspace(0.0, fingers.travel_m, 20)
    np.testing.assert_allclose(fingers.opening(fingers.joints(openings)), openings, atol=1e-9)


def test_kinova_stretched_arm_reaches_as_far_as_the_makers_gen3() -> None:
    """902 mm from the shoulder's axis to the flange (Kinova's data sheet), here with its 7 joints at 0."""
    chain = KINOVA.hands(torch.zeros(KINOVA.num_joints, dtype=torch.float64))
    reach = (chain.position[0] - chain.origins[0, 1]).norm() + 0.061525
    assert float(reach) == pytest.approx(0.902, abs=2e-3)


def test_grippers_squeeze_alike() -> None:
    """10 mm below the part's width is about 20 N per pad on every body."""
    for body in (ALOHA, KINOVA):
        sim = InsertionSim(SceneConfig(start="grasped", embodiment=body.name), num_envs=1, num_threads=1)
        sim.reset(np.zeros(1, np.int64), np.zeros(1, np.int64))
        np.testing.assert_allclose(sim._episode.pad_force[0], 20.0, rtol=0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"arms": KINOVA.arms[::-1]}, "its arms hold plug, socket; they must hold socket, then plug"),
        ({"cameras": {}}, "needs a camera for each start: table, grasped"),
        ({"joints": KINOVA.joints[:6]}, "home_rad of left must give 6 joints"),
    ],
)
def test_a_body_that_makes_no_sense_is_told(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(KINOVA, **change)


def test_names_are_taken_once() -> None:
    with pytest.raises(ValueError, match="there is an embodiment 'aloha' already"):
        register_embodiment(replace(KINOVA, name="aloha"))
    with pytest.raises(ValueError, match="unknown embodiment 'ur5': use one of aloha, kinova"):
        get_embodiment("ur5")


def test_a_policy_says_whose_data_it_was_given() -> None:
    config = VtDp3Config(preset="small", device="cpu")
    for key in (STATE_KEY, *raw_keys(KINOVA)):
        config.input_features[key] = PolicyFeature(FeatureType.STATE, (KINOVA.pad_layout.num_taxels,))
    config.input_features[STATE_KEY] = PolicyFeature(FeatureType.STATE, (KINOVA.num_joints,))
    config.output_features = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (KINOVA.num_joints,))}
    with pytest.raises(ValueError, match=r"is of kinova: set --policy\.observation\.embodiment=kinova"):
        config.validate_features()
    config.observation = replace(config.observation, embodiment="kinova")
    config.validate_features()


def test_a_pad_without_room_for_its_taxels_is_refused() -> None:
    with pytest.raises(ValueError, match=r"need 64\.0 x 24\.0 mm"):
        replace(ALOHA.fingers.pad, size_m=(0.06, 0.026, 0.003))
    with pytest.raises(ValueError, match=r"need 64\.0 x 24\.0 mm"):
        replace(ALOHA.fingers.pad, size_m=(0.065, 0.0235, 0.003))
