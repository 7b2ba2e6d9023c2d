"""Stereo sensors against what their figures imply for scenes with analytic answers."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from lerobot_vtrefine.sim.camera import Camera
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.depth import DepthCamera
from lerobot_vtrefine.sim.depth_sensors import DEPTH_SENSORS
from lerobot_vtrefine.sim.simulation import InsertionSim

FOCAL_PX = 154.0
CAMERA = Camera(80, 60, FOCAL_PX, FOCAL_PX, 39.5, 29.5, np.zeros(3), np.eye(3))
D405, D435 = DEPTH_SENSORS["d405"], DEPTH_SENSORS["d435"]
BOTH = pytest.mark.parametrize("sensor", [D405, D435], ids=["d405", "d435"])


def box(left_m, right_m, depth_m):
    """XML of a box whose face towards the camera reaches from left to right (x) at a depth."""
    half, middle = (right_m - left_m) / 2, (right_m + left_m) / 2
    return f'<body pos="{middle} 0 {depth_m + 0.01}"><geom type="box" size="{half} 5 .01"/></body>'


def wall(depth_m):
    return box(-5.0, 5.0, depth_m)


def look(xml, sensor, seeds=(0,), steps=0, device="cpu", camera=CAMERA):
    """Images (m, H, W) [mm] of one scene in episodes of these seeds, at these steps."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{xml}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    moments = np.stack(np.broadcast_arrays(np.asarray(seeds, np.int64), steps), 1)
    count = len(moments)
    poses = data.geom_xpos[None].repeat(count, 0), data.geom_xmat.reshape(1, -1, 3, 3).repeat(count, 0)
    eye = DepthCamera(model, camera, count, device, sensor=sensor)
    return eye.start_mm(np.arange(count), *poses, moments)().numpy(force=True).astype(int)


def only(sensor, **kept):
    """The sensor with no errors but these."""
    none = {"noise_px": 0.0, "systematic_px": 0.0, "edge_px": 0.0, "steps_per_px": 100_000}
    return replace(sensor, **(none | kept))


@BOTH
@pytest.mark.parametrize("depth_m", [0.5, 1.0, 1.8])
def test_noise_of_a_flat_wall_grows_with_the_square_of_its_distance(sensor, depth_m):
    images = look(wall(depth_m), only(sensor, noise_px=0.08), range(64))
    expected = 1e3 * depth_m**2 * 0.08 / (sensor.focal_px * sensor.baseline_m)
    expected = np.hypot(expected, 1 / np.sqrt(12))  # rounded to millimetres
    assert images.std() == pytest.approx(expected, rel=0.03)


def test_noise_is_as_correlated_as_averages_over_the_matching_window():
    errors = look(wall(1.5), only(D435, noise_px=0.08), range(200)) - 1500.0
    share = np.clip(1.0 - np.arange(4) * D435.focal_px / FOCAL_PX / D435.window_px, 0.0, None)
    for right in range(4):
        for down in range(2):
            other = errors[:, down:, right:]
            here = errors[:, : 60 - down, : 80 - right]
            found = (here * other).mean() / errors.var()
            assert found == pytest.approx(share[right] * share[down], abs=0.02)
    neighbours = (errors[:, :, 1:] * errors[:, :, :-1]).mean((0, 1)) / errors.var()
    np.testing.assert_allclose(neighbours, share[1], atol=0.1)  # the same all over the image


def test_a_tenth_of_the_noise_stays_through_an_episode():
    errors = look(wall(1.5), only(D435, noise_px=0.08), np.zeros(200, int), np.arange(200)) - 1500.0
    assert errors.mean(0).var() / errors.var() == pytest.approx(D435.fixed_share + 1 / 200, abs=0.02)
    pairs = (errors[1:] * errors[:-1]).mean() / errors.var()
    assert pairs == pytest.approx(D435.fixed_share, abs=0.02)


@pytest.mark.parametrize(("sensor", "at_m"), [(D405, 0.5), (D435, 2.0)], ids=["d405", "d435"])
def test_two_percent_at_the_specified_distance_are_two_deviations_over_cameras(sensor, at_m):
    systematic = only(sensor, systematic_px=sensor.systematic_px)
    near = look(wall(at_m / 2), systematic, range(400))
    assert (np.ptp(near, axis=(1, 2)) == 0).all()
    expected = 1e3 * 0.01 * at_m / 4  # a quarter at half the distance
    assert (near[:, 0, 0] - 500 * at_m).std() == pytest.approx(expected, rel=0.12)
    later = look(wall(at_m / 2), systematic, range(400), 7)
    np.testing.assert_array_equal(near, later)


@BOTH
def test_the_background_left_of_an_edge_is_seen_by_one_imager_only(sensor):
    far_m, columns = 0.6, np.arange(80)
    for near_m in np.linspace(0.35, 0.45, 12):
        left_m, right_m = np.array([-4.2, 15.2]) * near_m / FOCAL_PX  # columns 36 to 54
        image = look(wall(far_m) + box(left_m, right_m, near_m), only(sensor))[0]
        band_px = FOCAL_PX * sensor.baseline_m * (1 / near_m - 1 / far_m)
        hidden = (columns < 36) & (columns >= 36 - round(band_px))
        expected = np.where(hidden, 0, np.where((columns < 36) | (columns > 54), 600, round(1e3 * near_m)))
        np.testing.assert_array_equal(image, expected[None].repeat(60, 0))


def test_the_shadow_of_a_slanted_surface_has_no_holes():
    from_m, to_m = np.array([0.0, 0.35]), np.array([0.05, 0.45])  # x and z of the face's ends
    along = to_m - from_m
    middle = (from_m + to_m) / 2 + 0.001 * np.array([-along[1], along[0]]) / np.linalg.norm(along)
    turn, half = -np.arctan2(along[1], along[0]), np.linalg.norm(along) / 2
    xml = f'<body pos="{middle[0]} 0 {middle[1]}"><geom type="box" euler="0 {np.rad2deg(turn)} 0" '
    xml += f'size="{half} 5 .001"/></body>'
    image = look(wall(0.6) + xml, only(D435))[0]
    left = 39.5 - FOCAL_PX * D435.baseline_m * (1 / 0.35 - 1 / 0.6)
    hidden = np.flatnonzero(image[30] == 0)
    assert hidden[0] == pytest.approx(left, abs=1.0)
    assert hidden[-1] >= 38
    np.testing.assert_array_equal(np.diff(hidden), 1)


def test_beside_a_pole_narrower_than_its_shadow_the_background_is_seen():
    near_m, far_m = 0.3, 0.6
    image = look(wall(far_m) + box(0.0, 0.01, near_m), only(D435))[0]
    pole = 39.5 + FOCAL_PX * np.array([0.0, 0.01]) / near_m
    shadow = pole - FOCAL_PX * D435.baseline_m * (1 / near_m - 1 / far_m)
    assert shadow[1] < pole[0] - 3
    columns = np.arange(80)
    np.testing.assert_array_equal(image[0] == 0, (columns >= shadow[0]) & (columns <= shadow[1]))


@BOTH
def test_nothing_is_measured_below_the_least_distance_or_beyond_two_metres(sensor):
    assert (look(wall(sensor.nearest_m - 0.002), only(sensor)) == 0).all()
    near = sensor.nearest_m + 0.002
    np.testing.assert_array_equal(look(wall(near), only(sensor)), round(1e3 * near))
    assert (look(wall(2.01), only(sensor)) == 0).all()


def test_the_left_border_of_the_whole_view_is_seen_by_one_imager_only():
    whole = Camera(106, 60, D435.focal_px / 8, D435.focal_px / 8, 52.5, 29.5, np.zeros(3), np.eye(3))
    image = look(wall(0.5), only(D435), camera=whole)[0]
    band = D435.pixel_metres / 0.5 / 8
    for row in image:
        assert (row == 0).argmin() == pytest.approx(band, abs=1.0)
        assert (row[round(band) + 1 :] == 500).all()


def test_a_camera_that_sees_more_than_its_sensor_is_refused():
    wide = replace(CAMERA, fx=60.0, fy=60.0)
    with pytest.raises(ValueError, match=r"1\.18 times as high as .* smaller fov_y_rad"):
        look(wall(0.5), replace(D435, size_px=(848, 360)), camera=wide)


def test_a_ridge_finer_than_the_matching_window_is_flattened():
    pixel_m = 0.6 / FOCAL_PX
    ridge = box(0.1 * pixel_m, 0.9 * pixel_m, 0.594)  # 0.4 pixels of disparity, on one column of pixels
    image = look(wall(0.6) + ridge, only(D435))[0]
    spacing = D435.focal_px / FOCAL_PX
    assert spacing < D435.window_px < 3 * spacing
    share = spacing / D435.window_px
    np.testing.assert_allclose(image[30, 39:42], 600 - 6.0 * share, atol=0.7)
    assert (image[30, :38] == 600).all()
    assert (image[30, 43:] == 600).all()


def test_disparities_come_in_steps():
    image = look(wall(1.9), only(D435, noise_px=0.08, steps_per_px=32), range(8))
    steps = D435.pixel_metres * 1e3 / np.unique(image[image > 0]) * 32
    wrong = np.abs(steps - steps.round())
    assert wrong.max() < 0.5 * 32 * D435.pixel_metres * 1e3 / 1700**2  # what rounding to millimetres makes


def test_edges_move_from_frame_to_frame_and_slanted_walls_do_not():
    edges = only(D435, edge_px=3.0)
    scene = wall(0.6) + box(0.0, 5.0, 0.5)
    frames = look(scene, edges, np.zeros(50, int), np.arange(50))
    moving = (frames != frames[0]).any(0).any(0)
    edge = 39.5 + np.array([-FOCAL_PX * D435.baseline_m * (1 / 0.5 - 1 / 0.6), 0.0])
    reach = 4 * 3.0 * FOCAL_PX / D435.focal_px
    columns = np.arange(80)
    assert moving[39:41].all()
    assert not moving[(columns < edge[0] - reach) | (columns > edge[1] + reach)].any()
    slanted = '<body pos="0 0 0.6" euler="40 0 0"><geom type="box" size="5 5 .001"/></body>'
    frames = look(slanted, edges, np.zeros(9, int), np.arange(9))
    assert np.ptp(frames) > 100
    np.testing.assert_array_equal(frames, frames[:1].repeat(9, 0))


def test_noise_is_a_function_of_seed_step_and_pixel_alone():
    scene = wall(1.0)
    several = look(scene, D435, [3, 5, 3], [1, 1, 2])
    np.testing.assert_array_equal(look(scene, D435, [5], 1), several[1:2])
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert (several[one] != several[other]).mean() > 0.5
    huge = look(scene, D435, [2**40 + 3, 3], 1)
    assert (huge[0] != huge[1]).mean() > 0.5


def test_no_sensor_no_errors():
    np.testing.assert_array_equal(look(wall(0.6), None, [3, 4], [5, 6]), 600)


@pytest.mark.parametrize("name", ["d405", "d435"])
def test_worlds_give_the_same_noise_in_every_backend_and_order(name):
    scene = SceneConfig(start="grasped", depth_sensor=name)
    first = InsertionSim(scene, num_envs=2, backend="batch", num_threads=2)
    second = InsertionSim(scene, num_envs=1, backend="single")
    first.reset(np.arange(2), np.array([4, 9]))
    second.reset([0], [9])
    np.testing.assert_array_equal(first.depth_mm()[1:], second.depth_mm())
    first.step(first.command_targets(), images=np.array([1]))
    second.step(second.command_targets())
    image = second.depth_mm()
    np.testing.assert_array_equal(first.depth_mm(np.array([1])), image)
    state = second.get_state(0)
    second.step(second.command_targets())
    assert (second.depth_mm() != image).mean() > 0.1
    second.set_state(0, state)
    np.testing.assert_array_equal(second.depth_mm(), image)


def test_a_sensor_changes_nothing_but_the_depth_image():
    sims = [InsertionSim(SceneConfig(start="grasped", depth_sensor=name)) for name in ("ideal", "d435")]
    for sim in sims:
        sim.reset([0], [4])
        sim.step(sim.command_targets())
    plain, noisy = (sim.observe() for sim in sims)
    assert (plain["depth_mm"] != noisy["depth_mm"]).mean() > 0.3
    for key in plain.keys() - {"depth_mm"}:
        np.testing.assert_array_equal(plain[key], noisy[key])
    # Noise that training would add stands for a sensor's.
    assert [sim.noise_level for sim in sims] == [3.0, 0.0]


def test_unknown_sensors_are_named():
    with pytest.raises(ValueError, match="depth_sensor=d999 is unknown; choose from ideal, d405, d435"):
        SceneConfig(depth_sensor="d999")


@pytest.mark.gpu
def test_a_gpu_draws_the_same():
    scene = wall(0.6) + box(-0.01, 0.04, 0.4)
    here, there = (look(scene, D435, range(8), 3, device) for device in ("cpu", "cuda"))
    assert (here != there).mean() < 1e-3  # single precision may round either way
