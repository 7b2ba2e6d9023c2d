"""Warp kernels around mujoco_warp's step: commands in, trace out, and what the sensors need of the state.

Shape legend: N worlds, K substeps, nq positions, nv velocities, nu servos, ns sensor readings, P pads, B
parts, m worlds addressed by `ids`.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import Poses

wp.set_module_options({"enable_backward": False})

WORST = wp.constant(1.0e10)
"""MuJoCo gives up on a world whose positions or velocities exceed this."""


@wp.struct
class Trace:
    """What is kept of every substep, and the number of the present one."""

    cursor: wp.array(dtype=int)
    qpos: wp.array(dtype=float, ndim=3)
    sensors: wp.array(dtype=float, ndim=3)


@wp.struct
class Touching:
    """Which geoms are pads, how a pad's face lies in its geom, where its contact sensor is, and the parts."""

    pad_geom: wp.array(dtype=int)
    pad_body: wp.array(dtype=int)
    pad_offset: wp.array(dtype=wp.vec3)
    pad_turn: wp.array(dtype=wp.mat33)
    pad_sensor: wp.array(dtype=int)
    part_body: wp.array(dtype=int)


@wp.kernel
def ramp_controls(
    ids: wp.array(dtype=int),
    start: wp.array(dtype=float, ndim=2),
    stop: wp.array(dtype=float, ndim=2),
    substeps: int,
    controls: wp.array(dtype=float, ndim=3),
) -> None:
    """Commands (N, K, nu) of worlds `ids` that move linearly from `start` to `stop` (m, nu)."""
    row, step, servo = wp.tid()
    share = float(step + 1) / float(substeps)
    begin = start[row, servo]
    controls[ids[row], step, servo] = begin + share * (stop[row, servo] - begin)


@wp.kernel
def give_controls(
    cursor: wp.array(dtype=int), controls: wp.array(dtype=float, ndim=3), ctrl: wp.array(dtype=float, ndim=2)
) -> None:
    """Commands of the present substep."""
    world, servo = wp.tid()
    ctrl[world, servo] = controls[world, cursor[0], servo]


@wp.kernel
def record(qpos: wp.array(dtype=float, ndim=2), sensors: wp.array(dtype=float, ndim=2), trace: Trace) -> None:
    """Keep positions and readings after a substep; one thread per number."""
    world, index = wp.tid()
    step = trace.cursor[0]
    positions = qpos.shape[1]
    if index < positions:
        trace.qpos[world, step, index] = qpos[world, index]
    else:
        trace.sensors[world, step, index - positions] = sensors[world, index - positions]


@wp.func
def is_bad(values: wp.array(dtype=float)) -> bool:
    """Whether any value is not a number or too large; written so that NaN counts."""
    bad = bool(False)
    for index in range(values.shape[0]):
        if not (wp.abs(values[index]) < WORST):
            bad = True
    return bad


@wp.kernel
def guard(
    qpos0: wp.array(dtype=float, ndim=2),
    qpos: wp.array(dtype=float, ndim=2),
    qvel: wp.array(dtype=float, ndim=2),
    warmstart: wp.array(dtype=float, ndim=2),
    diverged: wp.array(dtype=int),
    cursor: wp.array(dtype=int),
) -> None:
    """Put worlds whose state has blown up back to the model's pose, as MuJoCo does, and say so; begins a
    substep.
    """
    world = wp.tid()
    if is_bad(qpos[world]) or is_bad(qvel[world]) or is_bad(warmstart[world]):
        diverged[world] = 1
        for index in range(qpos.shape[1]):
            qpos[world, index] = qpos0[world % qpos0.shape[0], index]
        for index in range(qvel.shape[1]):
            qvel[world, index] = 0.0
            warmstart[world, index] = 0.0
    if world == 0:
        cursor[0] += 1


@wp.func
def velocity_at(cvel: wp.spatial_vector, point: wp.vec3, centre: wp.vec3) -> wp.spatial_vector:
    """mujoco's com-based velocity (angular first) -> linear velocity of `point`, then angular."""
    turning = wp.spatial_top(cvel)
    linear = wp.spatial_bottom(cvel) + wp.cross(turning, point - centre)
    return wp.spatial_vector(linear, turning)


@wp.kernel
def pad_frames(
    ids: wp.array(dtype=int),
    touching: Touching,
    geom_xpos: wp.array(dtype=wp.vec3, ndim=2),
    geom_xmat: wp.array(dtype=wp.mat33, ndim=2),
    cvel: wp.array(dtype=wp.spatial_vector, ndim=2),
    subtree_com: wp.array(dtype=wp.vec3, ndim=2),
    body_rootid: wp.array(dtype=int),
    sensors: wp.array(dtype=float, ndim=2),
    poses: Poses,
    pull: wp.array(dtype=wp.vec2, ndim=2),
) -> None:
    """Pose and velocity of every pad's face, and the solver's load on it: force along the normal [N] and its
    centre's x and y [m] in the pad's frame, and the tangential force `pull` [N]; zeros where nothing touches.
    """
    row, pad = wp.tid()
    world = ids[row]
    geom = touching.pad_geom[pad]
    body = touching.pad_body[pad]
    geom_rot = geom_xmat[world, geom]
    position = geom_xpos[world, geom] + geom_rot * touching.pad_offset[pad]
    rotation = geom_rot * touching.pad_turn[pad]
    poses.pad_pos[row, pad] = position
    poses.pad_rot[row, pad] = rotation
    poses.pad_vel[row, pad] = velocity_at(cvel[world, body], position, subtree_com[world, body_rootid[body]])
    first = touching.pad_sensor[pad]
    load = wp.vec3()
    tangential = wp.vec2()
    if sensors[world, first] > 0.0:
        force = wp.vec3(sensors[world, first + 1], sensors[world, first + 2], sensors[world, first + 3])
        centre = wp.vec3(sensors[world, first + 7], sensors[world, first + 8], sensors[world, first + 9])
        back = wp.transpose(rotation)
        local = back * (centre - position)
        pressed = back * force
        load = wp.vec3(wp.max(pressed[2], 0.0), local[0], local[1])
        tangential = wp.vec2(-pressed[0], -pressed[1])  # the sensor has the pad's force on what it touches
    poses.load[row, pad] = load
    pull[row, pad] = tangential


@wp.kernel
def part_frames(
    ids: wp.array(dtype=int),
    touching: Touching,
    xpos: wp.array(dtype=wp.vec3, ndim=2),
    xmat: wp.array(dtype=wp.mat33, ndim=2),
    cvel: wp.array(dtype=wp.spatial_vector, ndim=2),
    subtree_com: wp.array(dtype=wp.vec3, ndim=2),
    body_rootid: wp.array(dtype=int),
    poses: Poses,
) -> None:
    """Pose and velocity of every part's frame."""
    row, part = wp.tid()
    world = ids[row]
    body = touching.part_body[part]
    position = xpos[world, body]
    poses.body_pos[row, part] = position
    poses.body_rot[row, part] = xmat[world, body]
    poses.body_vel[row, part] = velocity_at(
        cvel[world, body], position, subtree_com[world, body_rootid[body]]
    )
