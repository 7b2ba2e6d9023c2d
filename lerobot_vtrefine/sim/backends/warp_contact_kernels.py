"""Warp kernels around mujoco_warp's contacts: pairs that cannot touch are dropped, forces are added up.

Shape legend: N worlds, G geoms, S contact sensors, Q pairs of geoms from the broad phase, C contacts.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

PLANE = wp.constant(0)
CYLINDER = wp.constant(5)
BOX = wp.constant(6)
MESH = wp.constant(7)
CONSTRAINT = wp.constant(1)
"""Flag of contacts that the solver sees."""
FAR = wp.constant(1.0e3)
"""Above the size of any geom [m]."""
TINY = wp.constant(1.0e-15)
"""Readings of a contact sensor: found, force, torque, position."""


@wp.struct
class Shapes:
    """What mujoco_warp's model says of the geoms."""

    kind: wp.array(dtype=int)
    size: wp.array(dtype=wp.vec3, ndim=2)
    margin: wp.array(dtype=float, ndim=2)
    mesh: wp.array(dtype=int, ndim=2)
    mesh_first: wp.array(dtype=int)
    mesh_count: wp.array(dtype=int)
    vertices: wp.array(dtype=wp.vec3)


@wp.struct
class Pairs:
    """Pairs of geoms that may touch: geoms, ids as mujoco_warp keeps them, world, and how many there are."""

    geoms: wp.array(dtype=wp.vec2i)
    ids: wp.array(dtype=wp.vec2i)
    world: wp.array(dtype=int)
    count: wp.array(dtype=int)


@wp.struct
class Contacts:
    """mujoco_warp's contacts (C,) and the rows of constraint forces (N, rows) that they point to."""

    kind: wp.array(dtype=int)
    world: wp.array(dtype=int)
    geoms: wp.array(dtype=wp.vec2i)
    frame: wp.array(dtype=wp.mat33)
    pos: wp.array(dtype=wp.vec3)
    dim: wp.array(dtype=int)
    row: wp.array(dtype=int, ndim=2)
    force: wp.array(dtype=float, ndim=2)
    count: wp.array(dtype=int)


@wp.struct
class Sums:
    """Per contact sensor (N, S): contacts, forces, torques about the world's origin, weighted positions."""

    found: wp.array(dtype=float, ndim=2)
    weight: wp.array(dtype=float, ndim=2)
    force: wp.array(dtype=wp.vec3, ndim=2)
    torque: wp.array(dtype=wp.vec3, ndim=2)
    pos: wp.array(dtype=wp.vec3, ndim=2)


@wp.func
def extent(shapes: Shapes, world: int, geom: int, rot: wp.mat33, direction: wp.vec3) -> wp.vec2:
    """Smallest and largest coordinate of a geom along a unit `direction`, from the geom's centre [m]."""
    local = wp.transpose(rot) * direction
    size = shapes.size[world % shapes.size.shape[0], geom]
    kind = shapes.kind[geom]
    if kind == MESH:
        mesh = shapes.mesh[world % shapes.mesh.shape[0], geom]
        low = float(1.0e10)
        high = float(-1.0e10)
        for index in range(shapes.mesh_count[mesh]):
            along = wp.dot(local, shapes.vertices[shapes.mesh_first[mesh] + index])
            low = wp.min(low, along)
            high = wp.max(high, along)
        return wp.vec2(low, high)
    reach = wp.abs(local[0]) * size[0] + wp.abs(local[1]) * size[1] + wp.abs(local[2]) * size[2]
    if kind == CYLINDER:
        reach = size[0] * wp.sqrt(local[0] * local[0] + local[1] * local[1]) + size[1] * wp.abs(local[2])
    return wp.vec2(-reach, reach)


@wp.kernel
def take_apart(
    kind: wp.array(dtype=int),
    idle: wp.array(dtype=int),
    geom_xpos: wp.array(dtype=wp.vec3, ndim=2),
    apart: wp.array(dtype=wp.vec3, ndim=2),
) -> None:
    """Where geoms are; those of idle worlds stand above each other, far from the next one and every plane."""
    world, geom = wp.tid()
    if idle[world] == 1 and kind[geom] != PLANE:
        apart[world, geom] = wp.vec3(0.0, 0.0, FAR * float(geom + 1))
    else:
        apart[world, geom] = geom_xpos[world, geom]


@wp.kernel
def drop_separated(
    shapes: Shapes,
    geom_xpos: wp.array(dtype=wp.vec3, ndim=2),
    geom_xmat: wp.array(dtype=wp.mat33, ndim=2),
    given: Pairs,
    left: Pairs,
) -> None:
    """Keep the pairs that no face of a box, and no end of a cylinder, separates; one thread per pair.

    The broad phase compares bounding boxes, which never separates a round plug from the walls around it.
    Exact: what is dropped has no contact.
    """
    pair = wp.tid()
    if pair >= wp.min(given.count[0], given.geoms.shape[0]):
        return
    world = given.world[pair]
    geoms = given.geoms[pair]
    first = shapes.kind[geoms[0]]
    second = shapes.kind[geoms[1]]
    if (first == CYLINDER and second == BOX) or (first == BOX and second == MESH):
        box = wp.where(first == BOX, geoms[0], geoms[1])
        other = wp.where(first == BOX, geoms[1], geoms[0])
        offset = geom_xpos[world, other] - geom_xpos[world, box]
        box_rot = geom_xmat[world, box]
        other_rot = geom_xmat[world, other]
        margins = shapes.margin.shape[0]
        margin = shapes.margin[world % margins, box] + shapes.margin[world % margins, other]
        axes = wp.where(first == CYLINDER, 4, 3)
        for axis in range(axes):
            direction = wp.vec3(other_rot[0, 2], other_rot[1, 2], other_rot[2, 2])
            if axis < 3:
                direction = wp.vec3(box_rot[0, axis], box_rot[1, axis], box_rot[2, axis])
            away = wp.dot(offset, direction)
            mine = extent(shapes, world, box, box_rot, direction)
            its = extent(shapes, world, other, other_rot, direction)
            if away + its[0] > mine[1] + margin or away + its[1] < mine[0] - margin:
                return
    place = wp.atomic_add(left.count, 0, 1)
    left.geoms[place] = geoms
    left.ids[place] = given.ids[pair]
    left.world[place] = world


@wp.kernel
def spread_general(
    given: Pairs,
    kind: wp.array(dtype=int),
    general: wp.array(dtype=int, ndim=2),
    threads: int,
    warps: int,
    spread: Pairs,
) -> None:
    """Those pairs whose kinds `general` (kinds, kinds) marks, dealt out to so many warps of so many threads:
    few threads of one warp then wait for each other. `spread` is full of other pairs before.
    """
    pair = wp.tid()
    if pair >= wp.min(given.count[0], given.geoms.shape[0]):
        return
    geoms = given.geoms[pair]
    if general[kind[geoms[0]], kind[geoms[1]]] == 0:
        return
    number = wp.atomic_add(spread.count, 1, 1)
    dealt = threads * warps
    first = number // dealt * dealt
    place = number
    if first + dealt <= spread.geoms.shape[0]:
        place = first + number % warps * threads + (number - first) // warps
    wp.atomic_max(spread.count, 0, place + 1)
    spread.geoms[place] = geoms
    spread.ids[place] = given.ids[pair]
    spread.world[place] = given.world[pair]


@wp.kernel
def add_forces(
    contacts: Contacts, own: wp.array(dtype=int, ndim=2), other: wp.array(dtype=int, ndim=2), sums: Sums
) -> None:
    """Add each contact to the sensors that it concerns, as MuJoCo's net force does; one thread per contact.

    `own` and `other` (S, G) say which geoms a sensor's two sides are.
    """
    contact = wp.tid()
    if contact >= wp.min(contacts.count[0], contacts.geoms.shape[0]):
        return
    if contacts.kind[contact] & CONSTRAINT == 0:
        return
    world = contacts.world[contact]
    geoms = contacts.geoms[contact]
    dim = contacts.dim[contact]
    local = wp.spatial_vector()
    if contacts.row[contact, 0] >= 0:
        for index in range(dim):
            row = contacts.row[contact, index]
            if row < contacts.force.shape[1]:
                local[index] = contacts.force[world, row]
    back = wp.transpose(contacts.frame[contact])
    weight = wp.length(wp.spatial_top(local))
    place = contacts.pos[contact]
    for sensor in range(own.shape[0]):
        sign = float(0.0)
        if own[sensor, geoms[0]] == 1 and other[sensor, geoms[1]] == 1:
            sign = 1.0
        elif other[sensor, geoms[0]] == 1 and own[sensor, geoms[1]] == 1:
            sign = -1.0
        if sign != 0.0:
            force = sign * (back * wp.spatial_top(local))
            torque = sign * (back * wp.spatial_bottom(local)) + wp.cross(place, force)
            wp.atomic_add(sums.found, world, sensor, 1.0)
            wp.atomic_add(sums.weight, world, sensor, weight)
            wp.atomic_add(sums.force, world, sensor, force)
            wp.atomic_add(sums.torque, world, sensor, torque)
            wp.atomic_add(sums.pos, world, sensor, weight * place)


@wp.func
def put(values: wp.array(dtype=float), first: int, vector: wp.vec3) -> None:
    """Write three numbers."""
    for axis in range(3):
        values[first + axis] = vector[axis]


@wp.kernel
def finish_forces(
    sums: Sums, addresses: wp.array(dtype=int), readings: wp.array(dtype=float, ndim=2)
) -> None:
    """Sums -> a contact sensor's readings, torque about the forces' centre; clears the sums."""
    world, sensor = wp.tid()
    centre = sums.pos[world, sensor] / wp.max(sums.weight[world, sensor], TINY)
    force = sums.force[world, sensor]
    first = addresses[sensor]
    mine = readings[world]
    mine[first] = sums.found[world, sensor]
    put(mine, first + 1, force)
    put(mine, first + 4, sums.torque[world, sensor] - wp.cross(centre, force))
    put(mine, first + 7, centre)
    sums.found[world, sensor] = 0.0
    sums.weight[world, sensor] = 0.0
    sums.force[world, sensor] = wp.vec3()
    sums.torque[world, sensor] = wp.vec3()
    sums.pos[world, sensor] = wp.vec3()
