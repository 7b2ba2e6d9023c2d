"""What pads hold of a mesh by few points stays where it is held."""

from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
from ring_on_post import folder_with_ring

from lerobot_vtrefine.embodiments.fingers import SIDES
from lerobot_vtrefine.sim.config import SceneConfig, WarpConfig
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.simulation import InsertionSim

pytest.importorskip("trimesh", reason="needs the assets extra")
pytest.importorskip("manifold3d", reason="needs the assets extra")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with folder_with_ring(tmp_path_factory) as folder:
        yield folder


def scene(folder: Path, timestep_s: float, **settings: float) -> SceneConfig:
    """The ring in the right hand."""
    start = {"start": "grasped", "timestep_s": timestep_s} | settings
    return SceneConfig(pair="automate/ring", mesh_dir=folder, mesh_scale="unit", **start)


@pytest.mark.parametrize("timestep_s", [0.0025, 0.005])
def test_parts_do_not_creep_in_the_hand(folder: Path, timestep_s: float) -> None:
    """Friction is a damper in MuJoCo: a torque that it bears with ease still turns what two points hold."""
    sim = InsertionSim(scene(folder, timestep_s))
    sim.reset(np.arange(1), np.arange(1))
    model, data = sim.mj_data(0)
    plug, pads = model.body("plug").id, [model.geom(f"right_arm_{side}_finger").id for side in SIDES]
    torque_nm = 0.06
    borne_nm = model.geom_friction[pads[0], 1] * sum(_normal_force_n(model, data, pad) for pad in pads)
    assert torque_nm < 0.5 * borne_nm
    before = _in_pad(data, pads[0], plug)
    for _ in range(round(0.5 / timestep_s)):
        data.xfrc_applied[plug, 3:] = torque_nm * data.geom_xmat[pads[0]].reshape(3, 3)[:, 1]
        mujoco.mj_step(model, data)
    turned = before.T @ _in_pad(data, pads[0], plug)
    assert np.degrees(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1))) < 0.3


@pytest.mark.timeout(900)  # kernels may have to be compiled
def test_a_heavy_part_stays_where_mujoco_warp_holds_it(folder: Path) -> None:
    """Half a kilogram, once the pads have given way, in single precision."""
    pytest.importorskip("mujoco_warp")
    room = WarpConfig(device="cpu", contacts_per_world=256, rows_per_world=1024)
    sim = InsertionSim(scene(folder, 0.005, part_density=30_000.0), backend="warp", warp=room)
    world = np.arange(1)
    sim.reset(world, world)
    still = sim.command_targets().copy()
    shifts_m = []
    for _ in range(10):
        sim.step(still)
        shifts_m.append(float(sim.metrics(world)["in_hand_shift_m"][0]))
    assert shifts_m[9] - shifts_m[4] < 1e-5


@pytest.mark.timeout(900)
def test_the_solver_of_mujoco_warp_is_not_cut_short(folder: Path) -> None:
    """Hard friction takes it up to twenty steps; given up after ten, it leaves false forces of up to 55 N."""
    pytest.importorskip("mujoco_warp")
    room = WarpConfig(device="cpu", contacts_per_world=256, rows_per_world=1024)
    sim = InsertionSim(scene(folder, 0.005), num_envs=8, backend="warp", warp=room)
    worlds, rng, steps = np.arange(8), np.random.default_rng(0), []
    sim.reset(worlds, worlds)
    expert = ScriptedExpert(sim)
    expert.reset(worlds)
    for _ in range(20):
        action = expert.act(worlds)
        sim.step(action + rng.normal(0, 0.01, action.shape))
        steps.append(sim._backend.worlds.data.solver_niter.numpy().copy())
    assert 10 < np.max(steps) < sim.scene.model.opt.iterations


def _normal_force_n(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    force, total = np.zeros(6), 0.0
    for index in range(data.ncon):
        if geom in data.contact.geom[index]:
            mujoco.mj_contactForce(model, data, index, force)
            total += force[0]
    return total


def _in_pad(data: mujoco.MjData, pad: int, body: int) -> np.ndarray:
    """A body's rotation seen from a pad (3, 3)."""
    return data.geom_xmat[pad].reshape(3, 3).T @ data.xmat[body].reshape(3, 3)
