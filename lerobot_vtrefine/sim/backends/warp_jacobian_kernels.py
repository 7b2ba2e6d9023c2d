"""Warp kernels for the contacts' constraint rows: Jacobian and relative velocity, a thread per number.

mujoco_warp has a block per world go through the rows one after the other. Shape legend: N worlds, C contacts,
nv velocities.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

CONSTRAINT = wp.constant(1)
"""Flag of contacts that the solver sees."""


@wp.struct
class Bodies:
    """Bodies as mujoco_warp has them: of each geom, root of its tree, which velocities move it; and (N, nv)
    motion per velocity about the centres of mass (N, bodies) of the trees.
    """

    of_geom: wp.array(dtype=int)
    root: wp.array(dtype=int)
    moved_by: wp.array(dtype=int, ndim=2)
    motion: wp.array(dtype=wp.spatial_vector, ndim=2)
    centre: wp.array(dtype=wp.vec3, ndim=2)


@wp.struct
class Touches:
    """Contacts (C,): where, between which geoms, and their rows; how many there are."""

    kind: wp.array(dtype=int)
    world: wp.array(dtype=int)
    geoms: wp.array(dtype=wp.vec2i)
    pos: wp.array(dtype=wp.vec3)
    frame: wp.array(dtype=wp.mat33)
    dim: wp.array(dtype=int)
    row: wp.array(dtype=int, ndim=2)
    count: wp.array(dtype=int)


@wp.func
def has_rows(contact: int, touches: Touches) -> bool:
    """Whether the solver has rows for a contact."""
    if contact >= wp.min(touches.count[0], touches.geoms.shape[0]):
        return False
    return (touches.kind[contact] & CONSTRAINT) != 0


@wp.func
def carried(world: int, geom: int, dof: int, pos: wp.vec3, bodies: Bodies) -> wp.spatial_vector:
    """Velocity of a geom's body at `pos` per unit of a velocity: linear, then angular."""
    body = bodies.of_geom[geom]
    if bodies.moved_by[body, dof] == 0:
        return wp.spatial_vector()
    motion = bodies.motion[world, dof]
    turning = wp.spatial_top(motion)
    offset = pos - bodies.centre[world, bodies.root[body]]
    return wp.spatial_vector(wp.spatial_bottom(motion) + wp.cross(turning, offset), turning)


@wp.kernel
def contact_jacobian(touches: Touches, bodies: Bodies, jacobian: wp.array(dtype=float, ndim=3)) -> None:
    """Rows of the Jacobian (N, rows, nv or more) of all contacts; a thread per contact and velocity."""
    contact, dof = wp.tid()
    if not has_rows(contact, touches):
        return
    world = touches.world[contact]
    geoms = touches.geoms[contact]
    pos = touches.pos[contact]
    relative = wp.spatial_vector()
    if dof < bodies.motion.shape[1]:
        relative = carried(world, geoms[1], dof, pos, bodies) - carried(world, geoms[0], dof, pos, bodies)
    linear = touches.frame[contact] * wp.spatial_top(relative)
    angular = touches.frame[contact] * wp.spatial_bottom(relative)
    for index in range(touches.dim[contact]):
        row = touches.row[contact, index]
        if row >= 0:
            if index < 3:
                jacobian[world, row, dof] = linear[index]
            else:
                jacobian[world, row, dof] = angular[index - 3]


@wp.kernel
def contact_velocity(
    touches: Touches,
    jacobian: wp.array(dtype=float, ndim=3),
    qvel: wp.array(dtype=float, ndim=2),
    velocity: wp.array(dtype=float, ndim=2),
) -> None:
    """Velocity (N, rows) of all contacts' rows; a thread per contact and row of it."""
    contact, index = wp.tid()
    if not has_rows(contact, touches) or index >= touches.dim[contact]:
        return
    row = touches.row[contact, index]
    if row >= 0:
        world = touches.world[contact]
        total = float(0.0)
        for dof in range(qvel.shape[1]):
            total += jacobian[world, row, dof] * qvel[world, dof]
        velocity[world, row] = total
