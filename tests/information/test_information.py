"""What a study of a task's information says, and the encoders that it leaves."""

import html
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_vtrefine.datasets.features import GRIDS_KEY, SURFACE_KEY
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.factory import make_simulation
from lerobot_vtrefine.information.contact import SIDE, TOUCHING, has_side, side_of
from lerobot_vtrefine.information.estimator import (
    POLICY,
    SENSES,
    STRONG,
    Estimator,
    contact_known,
    episode_errors,
    rms_with_interval,
    train_estimator,
    views_of,
)
from lerobot_vtrefine.information.frames import Frames, MisjudgedHolds, collect_frames
from lerobot_vtrefine.information.page import render_page
from lerobot_vtrefine.information.quantities import NAMES, Grasps, observe, part_poses
from lerobot_vtrefine.information.scale import HeldScale
from lerobot_vtrefine.information.strong import SurfaceStep
from lerobot_vtrefine.information.study import Effort, Finding, Study, as_json, save_keeper, study
from lerobot_vtrefine.information.tolerance import LATERAL, SIZES, TILT, Tolerated, tolerance
from lerobot_vtrefine.sim.config import GraspedStart, TaskConfig
from lerobot_vtrefine.sim.ik import hand_poses
from lerobot_vtrefine.sim.poses import Poses, rotation_vector

EPISODES, LENGTH, JOINTS = 60, 9, 16
PRESSED, SEEN = 0, 1
"""Quantities of ``synthetic`` that pads and the depth image tell."""


def synthetic(seed: int, pads: int = 4, rows: int = 12) -> Frames:
    """Frames whose first quantity is where a pad is pressed, and whose second one is where the depth image
    has a bump; joints tell nothing. Whether and where parts touch follows from the pads.
    """
    rng = torch.Generator().manual_seed(seed)
    place = torch.randint(32, (EPISODES, LENGTH), generator=rng)
    grids = torch.zeros(EPISODES, LENGTH, pads, rows, 32)
    grids.scatter_(-1, place[..., None, None, None].expand(-1, -1, pads, rows, 1), 1.0)
    truth = torch.zeros(EPISODES, LENGTH, len(NAMES))
    truth[..., PRESSED] = 1e-3 * (place - 16)
    columns = {"state": torch.randn(EPISODES, LENGTH, JOINTS, generator=rng), f"grids/{GRIDS_KEY}": grids}
    length = torch.randint(3, LENGTH + 1, (EPISODES,), generator=rng)
    bump = torch.randint(16, (EPISODES, LENGTH), generator=rng)
    surface = torch.zeros(EPISODES, LENGTH, 3, 8, 16)
    surface.scatter_(-1, bump[..., None, None, None].expand(-1, -1, 3, 8, 1), 1.0)
    truth[..., SEEN] = 1e-3 * (bump - 7.5)
    columns[f"surface/{SURFACE_KEY}"] = surface.half()
    contact = torch.zeros(EPISODES, LENGTH, 4)
    contact[..., 0] = place >= 12
    contact[..., 1] = contact[..., 0] * torch.where(place >= 22, 0.004, -0.004)
    held = torch.arange(truth.shape[1]) < length[:, None]
    return Frames(columns, truth, length, Grasps(np.tile(np.eye(3), (3, 1, 1))), contact, held)


def trained(senses: str, frames: Frames, network: str = POLICY, steps: int = 160) -> Estimator:
    torch.manual_seed(0)
    estimator = Estimator(replace(SENSES[senses], network=network), frames, "aloha", "small", "cpu", 1)
    train_estimator(estimator, frames, steps, batch_size=64, seed=0)
    return estimator


def test_frames_are_seen_with_the_environments_body() -> None:
    views = views_of([SENSES["visuo_tactile"], SENSES["visuo_tactile_cloud"]], "kinova", "small", "cpu")
    assert [view.observation_config.embodiment for view in views.values()] == ["kinova"] * 3


def test_the_larger_network_tells_what_its_senses_determine_and_nothing_else() -> None:
    frames, held_out = (synthetic(seed, pads=1, rows=4) for seed in (0, 1))  # small ones, for speed
    prior = held_out.truth[held_out.index()].std(0)
    for senses, tells in (("tactile", {PRESSED}), ("visual", {SEEN}), ("visuo_tactile", {PRESSED, SEEN})):
        estimator = trained(senses, frames, STRONG, steps=80)
        errors = episode_errors(estimator, held_out).mean(0).sqrt() / prior
        for quantity in (PRESSED, SEEN):
            assert (errors[quantity] < 0.4) if quantity in tells else (errors[quantity] > 0.9), senses
        told, unseen = contact_known(estimator, held_out, 0)
        for name in (TOUCHING, SIDE):  # which the pads tell
            assert (told[name][0] > 0.9) if PRESSED in tells else (told[name][0] < unseen[name] + 0.06)


def test_contacts_are_told_by_pads_and_not_by_joints() -> None:
    frames, held_out = synthetic(0), synthetic(1)
    told, unseen = contact_known(trained("tactile", frames), held_out, 0)
    guessed, _ = contact_known(trained("joints", frames), held_out, 0)
    for name in (TOUCHING, SIDE):
        assert told[name][0] > 0.9 > unseen[name] + 0.2
        assert guessed[name][0] < unseen[name] + 0.06
        assert guessed[name][1] < guessed[name][0] < guessed[name][2]
    assert told["contact_x"][0] < 0.5 * unseen["contact_x"]
    assert guessed["contact_x"][0] > 0.9 * unseen["contact_x"]


def test_contacts_do_not_shape_the_encoder_that_policies_start_from() -> None:
    frames, other = synthetic(0), synthetic(0)
    other.contact = other.contact.roll(1, 0)
    for network, same in ((POLICY, True), (STRONG, False)):
        first, second = (trained("tactile", item, network, steps=2).encoder for item in (frames, other))
        pairs = zip(first.parameters(), second.parameters(), strict=True)
        assert all(torch.equal(a, b) for a, b in pairs) == same


def test_sides_are_the_four_directions_and_the_middle_has_none() -> None:
    places = torch.tensor([[3.0, 1.0], [-1.0, 2.0], [-3.0, -2.0], [0.5, -4.0], [0.3, 0.2]]) * 1e-3
    assert side_of(places).tolist()[:4] == [0, 1, 2, 3]
    contact = torch.cat([torch.ones(5, 1), places, torch.zeros(5, 1)], 1)
    assert has_side(contact).tolist() == [True] * 4 + [False]


def test_pads_tell_what_joints_do_not() -> None:
    frames, held_out = synthetic(0), synthetic(1)
    prior = held_out.truth[held_out.index()][:, 0].std()
    for senses, lowest, highest in (("tactile", 0.0, 0.35), ("joints", 0.9, 1.5)):
        value, low, high = rms_with_interval(episode_errors(trained(senses, frames), held_out))[:, 0]
        assert lowest < value / prior < highest, senses
        assert low < value < high


def test_windows_start_at_the_episodes_first_frame() -> None:
    frames = synthetic(0)
    estimator = Estimator(SENSES["tactile"], frames, "aloha", "small", "cpu", 3)
    window = estimator.window(frames, torch.tensor([5, 5]), torch.tensor([0, 4]))
    state = frames.columns["state"][5]
    assert torch.equal(window["state"][0], state[[0, 0, 0]])
    assert torch.equal(window["state"][1], state[[2, 3, 4]])
    assert estimator(window).shape == (2, len(NAMES))


def test_the_depth_image_becomes_points_of_the_workspace() -> None:
    """A pixel's point lies on the surface that the camera sees; what is outside of the box is left out."""
    sim = make_simulation(VtRefineEnvConfig(start="grasped"), 2)
    ids = np.arange(2)
    sim.reset(ids, ids)
    frame = {
        "observation.images.front_depth": torch.from_numpy(sim.depth_mm(ids).astype(np.float32))[:, None],
        "observation.camera.front.pose": torch.from_numpy(sim.camera_pose),
        "observation.camera.front.intrinsics": torch.from_numpy(sim.camera_intrinsics).expand(2, -1),
        "observation.camera.front.noise_level": torch.zeros(2, 1),
    }
    config = SENSES["visual"].policy("aloha", "small", "cpu", 1).observation
    image = SurfaceStep(config).observation(frame)[SURFACE_KEY].float()
    points = image.movedim(1, -1)[(image != 0).any(1)] * config.scale_m + torch.tensor(config.center_m)
    assert 100 < len(points) < 2 * 4800
    low, high = torch.tensor(config.crop_min_m), torch.tensor(config.crop_max_m)
    assert ((points > low - 1e-3) & (points < high + 1e-3)).all()
    plug, _ = sim.part_poses(ids)
    nearest = torch.cdist(points, torch.from_numpy(plug[:, :3]).float()).min(0).values
    assert (nearest < 0.03).all()  # the plug in its hand is in view
    noisy = SurfaceStep(config).observation(
        frame | {"observation.camera.front.noise_level": torch.full((2, 1), 3.0)}
    )
    moved = (noisy[SURFACE_KEY].float() - image).abs().mean()
    assert 0.001 < moved < 0.2


def test_quantities_say_where_the_parts_are() -> None:
    sim = make_simulation(VtRefineEnvConfig(start="grasped"), 3)
    ids = np.arange(3)
    sim.reset(ids, ids)
    seen = observe(sim, ids)
    grasps = Grasps.mean(seen)
    q = np.asarray(sim.joint_state(ids), float)
    believed = part_poses(sim.scene.embodiment, q, seen.quantities(grasps), grasps)
    for pose, truth in zip(believed, sim.part_poses(ids), strict=True):
        np.testing.assert_allclose(pose[:, :3], truth[:, :3], atol=1e-9)
        same = np.abs((pose[:, 3:] * truth[:, 3:]).sum(-1))  # q and -q are one rotation
        np.testing.assert_allclose(same, 1, atol=1e-9)


@pytest.mark.parametrize(
    ("truth", "both", "vision", "said"),
    [
        (0.90, 0.9, 0.1, "knows everything"),
        (0.99, 0.8, 0.1, "do not suffice"),
        (0.99, 0.95, 0.8, "vision alone suffices"),
        (0.99, 0.95, 0.5, "A touch task"),
        (0.99, None, 0.5, "Not judged"),
    ],
)
def test_verdicts(truth: float, both: float | None, vision: float, said: str) -> None:
    def finding(senses: str, rate: float | None) -> Finding:
        return Finding(senses, 1, {}, None if rate is None else (round(100 * rate), 100))

    found = Study({}, [finding("visuo_tactile", both), finding("visual", vision)], (round(100 * truth), 100))
    assert said in found.verdict.reason
    assert as_json(found, Effort())["accepted"] is {"A touch task": True, "Not judged": None}.get(said, False)


def test_a_study_leaves_encoders_that_policies_start_from(tmp_path: Path) -> None:
    from aloha_columns import BASELINE_KEYS, TACTILE_KEYS
    from lerobot.configs import FeatureType, PolicyFeature

    from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY
    from lerobot_vtrefine.policies.vt_dp3 import VtDp3Config
    from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy

    env = VtRefineEnvConfig(start="grasped", episode_steps=3)
    effort = Effort(episodes=8, num_envs=4, steps=2, batch_size=8, history=(1,), closed_loop_episodes=4)
    effort = replace(effort, tolerance_episodes=4, clearances_m=(0.001,), networks=(POLICY, STRONG))
    state = torch.get_rng_state()
    found = study(env, ["tactile"], effort, keep=save_keeper(tmp_path, effort))
    assert torch.equal(torch.get_rng_state(), state)  # whoever asks goes on with numbers of their own
    assert list(found.at_clearance) == [0.001]
    assert found.at_clearance[0.001].prior != found.prior
    assert [item.success[1] for item in found.tolerated] == [4] * 12
    told = as_json(found, effort)
    assert told["true_state"]["episodes"] == told["findings"][0]["expert"]["episodes"] == 4
    assert set(told["findings"][0]["rms"]) == set(NAMES) == set(told["prior"])
    assert [item["network"] for item in told["findings"]] == [POLICY, STRONG]
    json.dumps(told, allow_nan=False)
    assert {path.name for path in tmp_path.iterdir()} == {"encoder_tactile_pads.safetensors"}

    def policy(folder: Path, **changes: object) -> VtDp3Policy:
        settings = {"preset": "small", "device": "cpu", "modalities": "tactile", "fusion": "pads"}
        config = VtDp3Config(**settings | changes, pretrained_encoder=str(folder))
        sizes = dict.fromkeys((*TACTILE_KEYS, *BASELINE_KEYS), 384) | {STATE_KEY: JOINTS}
        config.input_features = {
            key: PolicyFeature(FeatureType.STATE, (size,)) for key, size in sizes.items()
        }
        config.output_features = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (JOINTS,))}
        return VtDp3Policy(config)

    first, second = policy(tmp_path), policy(tmp_path, freeze_encoder=True)
    pads, frozen = first.model.encoder.pads, second.model.encoder.pads
    assert pads is not None
    assert frozen is not None
    assert all(torch.equal(a, b) for a, b in zip(pads.parameters(), frozen.parameters(), strict=True))
    assert len(second.get_optim_params()) == len(first.get_optim_params()) - len(list(pads.parameters()))
    second.save_pretrained(tmp_path / "checkpoint")
    (tmp_path / "encoder_tactile_pads.safetensors").unlink()
    VtDp3Policy.from_pretrained(tmp_path / "checkpoint")  # needs the encoder's folder no more
    with pytest.raises(FileNotFoundError, match=r"holds no encoder_tactile_pads.safetensors .*vtrefine:"):
        policy(tmp_path)


def test_frames_do_not_tell_the_hold_by_where_the_hands_are_brought() -> None:
    """Believed parts are off by up to the slip, in their hands, and remain so; right where there is none."""
    for slip_m, slip_z_m, slip_rad in ((0.004, None, 0.3), (0.004, 0.001, 0.3), (0.0, 0.0, 0.0)):
        start = GraspedStart(slip_m=slip_m, slip_z_m=slip_z_m, slip_rad=slip_rad, plug_height_m=0.03)
        sim = make_simulation(VtRefineEnvConfig(start="grasped", rules=TaskConfig(grasped=start)), 12)
        ids = np.arange(12)
        sim.reset(ids, ids)
        holds = MisjudgedHolds(sim)
        holds.draw(ids)
        hands = Poses(*hand_poses(sim.scene.embodiment, np.asarray(sim.joint_state(ids), float)))
        believed, true = (
            hands.inverse() @ Poses.from_quaternions(np.stack([socket, plug], 1))
            for plug, socket in (holds.part_poses(ids), sim.part_poses(ids))
        )
        error = believed @ true.inverse()
        turns = rotation_vector(error.rotation)
        assert np.abs(turns[..., 1]).max() <= slip_rad + 1e-9
        assert np.abs(error.position[..., 0]).max() <= slip_m + 1e-9
        highest = np.abs(error.position[..., 2]).max()
        assert 0.4 * start.slip_xz_m[1] <= highest <= start.slip_xz_m[1] + 1e-9
        np.testing.assert_allclose(turns[..., [0, 2]], 0, atol=1e-9)  # about the pads' normal alone
        assert (np.abs(turns[..., 1]).max(0) >= 0.4 * slip_rad).all()
        again = hands.inverse() @ Poses.from_quaternions(np.stack(holds.part_poses(ids)[::-1], 1))
        np.testing.assert_allclose(again.position, believed.position, atol=1e-12)


def test_the_verdict_is_on_the_best_network() -> None:
    """A task on which the policy's encoder alone is blind needs no touch."""
    findings = [
        Finding("visuo_tactile", 1, {}, (95, 100)),
        Finding("visual", 1, {}, (50, 100)),
        Finding("visual", 1, {}, (80, 100), STRONG),
    ]
    assert "vision alone suffices" in Study({}, findings, (99, 100)).verdict.reason


def test_the_page_shows_contacts_and_outlines_the_larger_network() -> None:
    rms = dict.fromkeys(NAMES, (1.0, 0.8, 1.2))
    findings = [
        Finding(
            "tactile", 1, rms, None, network, {TOUCHING: (share, 0.8, 0.99), "contact_x": (1.0, 0.9, 1.1)}
        )
        for network, share in ((POLICY, 0.9), (STRONG, 0.95))
    ]
    unseen = {TOUCHING: 0.7, "contact_x": 4.0}
    found = Study(dict.fromkeys(NAMES, 2.0), findings, None, contact_unseen=unseen)
    page = render_page(found, "round", 0.002)
    pictures = dict(re.findall(r'<svg[^>]*aria-label="([^"]*)"(.*?)</svg>', page, re.DOTALL))
    heights = {
        name: [float(h) for h in re.findall(r'<rect class="bar m[^"]*"[^>]*height="([0-9.]+)"', picture)]
        for name, picture in pictures.items()
    }
    assert heights["told rightly contact"] == pytest.approx([182 * 0.9 / 1.1, 182 * 0.95 / 1.1], abs=0.1)
    assert heights["errors of place of the contact"] == pytest.approx([182 * 0.25 / 1.1] * 2, abs=0.1)
    assert page.count('class="bar m strong"') == 3 * 6 + 2
    assert "outlined: a larger network" in page


def test_the_page_draws_every_error_as_a_share_of_the_unseen() -> None:
    prior = dict.fromkeys(NAMES, 2.0)
    rms = dict.fromkeys(NAMES, (1.0, 0.8, 1.2))
    found = Study(prior, [Finding("visual", 1, rms, (3, 8)), Finding("tactile", 10, rms, None)], (8, 8))
    page = render_page(found, "round", 0.002)
    assert found.verdict.reason in html.unescape(page)
    assert page.count("<svg") == 3 + 1
    bars = re.findall(r'<rect class="bar (?:a|m faded)"[^>]*y="([0-9.]+)"[^>]*height="([0-9.]+)"', page)
    assert len(bars) == 3 * 6 * 2 + 1  # and the expert on what vision tells; what was not measured has no bar
    heights = {float(height) for _, height in bars[: 3 * 6 * 2]}
    assert sorted(heights) == pytest.approx([182 * 0.5 / 1.1], abs=0.1)


def test_an_error_of_known_size_costs_success(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SIZES, LATERAL, (0.0, 0.004))
    monkeypatch.setitem(SIZES, TILT, ())
    none, large = tolerance(VtRefineEnvConfig(start="grasped"), 6, 6)
    assert (none.size, none.success) == (0.0, (6, 6))
    assert large.success[0] <= 2  # beside a hole that leaves 1 mm on each side


def test_the_page_draws_curves_where_they_were_measured() -> None:
    """A set of senses stands at its own error; the line of errors ends at the largest clearance."""
    rms = {name: (3.0 if name.endswith("_x") else 1.0, 0.8, 1.2) for name in NAMES}
    findings = [Finding("visual", 1, rms, (6, 8))]
    found = Study(
        dict.fromkeys(NAMES, 2.0),
        findings,
        (8, 8),
        [Tolerated(LATERAL, 0.0, (8, 8)), Tolerated(LATERAL, 0.002, (2, 8)), Tolerated(TILT, 0.1, (4, 8))],
        {0.001: Study({}, findings, (7, 8))},
    )
    page = render_page(found, "cross", 0.002)
    assert page.count("<svg") == 3 + 1 + 2 + 2
    pictures = re.findall(r'<svg[^>]*aria-label="([^"]*)"(.*?)</svg>', page, re.DOTALL)
    drawn = dict(pictures)["success against error of where the hole is, per axis"]
    (place,) = re.findall(r'class="dot a" cx="([0-9.]+)" cy="([0-9.]+)"', drawn)
    end = np.hypot(3.0, 1.0) / np.sqrt(2)  # RMS over both axes, beyond the sizes
    assert float(place[0]) == pytest.approx(62 + 440 / 1.05, abs=0.1)
    assert f">{end:.0f}<" in drawn
    assert float(place[1]) == pytest.approx(28 + 220 * 0.25, abs=0.1)
    both = dict(pictures)["error against clearance"]
    assert len(re.findall('class="dot a"', both)) == 2
    assert "Other clearances" not in render_page(replace(found, at_clearance={}), "cross", 0.002)


def test_the_scale_is_linear_in_the_hands_and_logarithmic_beyond() -> None:
    held = torch.randn(500, 2, dtype=torch.float64) * torch.tensor([0.002, 0.05])
    far = torch.tensor([[0.2, 0.5], [-0.4, -1.0]], dtype=torch.float64)
    scale = HeldScale(held, torch.cat([held, far]))
    torch.testing.assert_close(scale.compress(held), (held - held.mean(0)) / held.std(0))
    torch.testing.assert_close(scale.expand(scale.compress(far)), far)
    near, twice = scale.compress(torch.tensor([[0.1], [0.2]], dtype=torch.float64).expand(2, 2))[:, 0]
    assert float(twice - near) == pytest.approx(np.log(2), rel=0.1)
    wild = scale.expand(torch.full((1, 2), 1e6, dtype=torch.float64)) - held.mean(0)
    torch.testing.assert_close(wild, 2 * (far - held.mean(0)).abs().amax(0, keepdim=True))


def test_from_the_table_errors_are_told_of_parts_in_the_hands() -> None:
    """Frames before the grasp train the encoder and count for no error: there parts are far away."""
    frames = collect_frames(VtRefineEnvConfig(start="table"), 4, 4, {}, torch.device("cpu"))
    assert frames.held.any()
    first = frames.held.int().argmax(1)
    assert (first[frames.held.any(1)] > 10).all()  # reaching comes before
    assert not frames.held[:, 0].any()
    episode, frame = frames.held_index()
    plug = NAMES.index("plug_in_hand_x")
    in_hand, all_frames = frames.truth[episode, frame, plug], frames.truth[frames.index()][:, plug]
    assert float(in_hand.std()) < 0.004 < 0.02 < float(all_frames.std())
