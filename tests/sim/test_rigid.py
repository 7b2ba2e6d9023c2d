"""Rigid contacts: as stiff in long physics steps as in short ones, in which they are MuJoCo's default."""

import mujoco
import numpy as np
import pytest

from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.rigid import rigid_contact
from lerobot_vtrefine.sim.scene import build_scene

MASS_KG, FORCE_N = 0.05, 6.0


def pressed_depth(timestep_s: float, time_constant_s: float = 0.005) -> float:
    """How far [m] a cube sinks into the fixed one below it when it is pressed down."""
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = [0, 0, 0]
    law = rigid_contact(time_constant_s, timestep_s)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02] * 3, solref=law[0], solimp=law[1])
    body = spec.worldbody.add_body(pos=[0, 0, 0.04])
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02] * 3, mass=MASS_KG, solref=law[0], solimp=law[1])
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qfrc_applied[0] = -FORCE_N
    mujoco.mj_step(model, data, round(0.5 / timestep_s))
    assert abs(data.qvel[0]) < 1e-4
    return -float(data.qpos[0])


@pytest.mark.parametrize("timestep_s", [0.001, 0.004, 0.005])
def test_parts_sink_nearly_as_deep_into_each_other_in_any_step(timestep_s):
    assert pressed_depth(timestep_s) == pytest.approx(pressed_depth(0.0025), rel=0.1)


def test_a_time_constant_makes_contacts_stiffer_by_its_square():
    assert pressed_depth(0.002, 0.004) == pytest.approx(pressed_depth(0.0025, 0.005) * 0.8**2, rel=0.05)


def test_in_short_steps_it_is_the_default_impedance():
    default = mujoco.MjSpec().worldbody.add_geom().solimp
    assert rigid_contact(0.005, 0.0025) == ([0.005, 1.0], list(default))


def test_parts_and_couplings_take_it():
    scene = build_scene(SceneConfig(start="grasped", timestep_s=0.005))
    solref, solimp = rigid_contact(0.005, 0.005)
    model = scene.model
    for geom in scene.addresses.part_geoms:
        np.testing.assert_allclose(model.geom_solref[geom], solref)
        np.testing.assert_allclose(model.geom_solimp[geom], solimp)
    np.testing.assert_allclose(model.eq_solimp[0], solimp)
