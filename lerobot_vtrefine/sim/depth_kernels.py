"""Warp kernels of the depth camera; one source for CPU and CUDA.

Shape legend: m worlds of N, named by ids; S solids of a model's G geoms, F planes, H x W pixels; metres.
`project` brings solids into the camera's optical frame and finds the pixels that each can cover, `raster`
intersects only those. Solids are convex: a ray meets them in one interval; a capsule is three of them.
"""

import warp as wp

from lerobot_vtrefine.sim.camera import MAX_DEPTH_M

wp.set_module_options({"enable_backward": False})

PLANE = wp.constant(0)
SPHERE = wp.constant(2)
CAPSULE = wp.constant(3)
CYLINDER = wp.constant(5)
BOX = wp.constant(6)
HULL = wp.constant(7)
MISS = wp.constant(1.0e9)
NEAR_M = wp.constant(0.01)
MAX_M = wp.constant(float(MAX_DEPTH_M))
NEVER_PER_M = wp.constant(1.0e9)
"""Bound of the inverse depth where a face sets none."""
LEAST_M = wp.constant(1.0e-9)

ivec4 = wp.types.vector(length=4, dtype=wp.int32)


@wp.func
def clip_slab(interval: wp.vec2, origin: float, slope: float, half: float) -> wp.vec2:
    """Part of `interval` in which |origin + t slope| <= half."""
    if wp.abs(slope) < 1.0e-12:
        if wp.abs(origin) > half:
            return wp.vec2(MISS, -MISS)
        return interval
    middle = -origin / slope
    reach = wp.abs(half / slope)
    return wp.vec2(wp.max(interval[0], middle - reach), wp.min(interval[1], middle + reach))


@wp.func
def clip_ball(interval: wp.vec2, a: float, b: float, c: float) -> wp.vec2:
    """Part of `interval` in which a t^2 + 2 b t + c <= 0."""
    if a < 1.0e-14:
        if c > 0.0:
            return wp.vec2(MISS, -MISS)
        return interval
    disc = b * b - a * c
    if disc < 0.0:
        return wp.vec2(MISS, -MISS)
    root = wp.sqrt(disc)
    return wp.vec2(wp.max(interval[0], (-b - root) / a), wp.min(interval[1], (-b + root) / a))


@wp.func
def entry(interval: wp.vec2) -> float:
    """Where a ray enters, MISS when it does not or starts inside."""
    if interval[0] > interval[1] or interval[0] <= 0.0:
        return MISS
    return interval[0]


@wp.func
def hit_sphere(origin: wp.vec3, slope: wp.vec3, radius: float) -> float:
    """Entry into a sphere around the frame's origin."""
    whole = wp.vec2(-MISS, MISS)
    c = wp.dot(origin, origin) - radius * radius
    return entry(clip_ball(whole, wp.dot(slope, slope), wp.dot(origin, slope), c))


@wp.func
def hit_cylinder(origin: wp.vec3, slope: wp.vec3, radius: float, half: float) -> float:
    """Entry into a cylinder along z."""
    interval = clip_slab(wp.vec2(-MISS, MISS), origin[2], slope[2], half)
    a = slope[0] * slope[0] + slope[1] * slope[1]
    b = origin[0] * slope[0] + origin[1] * slope[1]
    c = origin[0] * origin[0] + origin[1] * origin[1] - radius * radius
    return entry(clip_ball(interval, a, b, c))


@wp.func
def hit_hull(
    origin: wp.vec3, slope: wp.vec3, planes: wp.array(dtype=wp.vec4), first: int, count: int
) -> float:
    """Entry into the intersection of half-spaces n x + d <= 0."""
    low = float(-MISS)
    high = float(MISS)
    for index in range(first, first + count):
        plane = planes[index]
        normal = wp.vec3(plane[0], plane[1], plane[2])
        distance = wp.dot(normal, origin) + plane[3]
        rate = wp.dot(normal, slope)
        if wp.abs(rate) < 1.0e-12:
            if distance > 0.0:
                return MISS
        else:
            t = -distance / rate
            if rate < 0.0:
                low = wp.max(low, t)
            else:
                high = wp.min(high, t)
        if low > high:
            return MISS
    return entry(wp.vec2(low, high))


@wp.func
def hit(
    kind: int,
    size: wp.vec3,
    origin: wp.vec3,
    slope: wp.vec3,
    planes: wp.array(dtype=wp.vec4),
    range_: wp.vec2i,
) -> float:
    """z-depth at which a ray meets a geom other than a box, both in the geom's frame."""
    if kind == CYLINDER:
        return hit_cylinder(origin, slope, size[0], size[1])
    if kind == CAPSULE:
        end = wp.vec3(0.0, 0.0, size[1])
        nearest = hit_cylinder(origin, slope, size[0], size[1])
        nearest = wp.min(nearest, hit_sphere(origin - end, slope, size[0]))
        return wp.min(nearest, hit_sphere(origin + end, slope, size[0]))
    if kind == HULL:
        return hit_hull(origin, slope, planes, range_[0], range_[1])
    if kind == SPHERE:
        return hit_sphere(origin, slope, size[0])
    if slope[2] < 0.0 and origin[2] > 0.0:  # a plane is seen from above only
        return -origin[2] / slope[2]
    return MISS


@wp.struct
class Slabs:
    """The planes of a box's faces, in pairs; a ray's inverse depth at a plane is linear in its direction, so
    that nothing need be divided until the ray has hit.
    """

    near: wp.mat33
    """Inverse depth [1/m] at the plane of each pair that is nearer to the camera: this times a direction."""
    far: wp.mat33
    """The same of the other one."""
    beyond: wp.vec3
    """How far the camera lies outside the nearer plane, negative within the pair [m]."""


@wp.func
def make_slabs(position: wp.vec3, rotation: wp.mat33, half: wp.vec3) -> Slabs:
    """Of a box in the camera's frame."""
    back = wp.transpose(rotation)
    origin = back * (-position)
    slabs = Slabs()
    for axis in range(3):
        sign = wp.where(origin[axis] < 0.0, -1.0, 1.0)
        beyond = sign * origin[axis] - half[axis]
        beyond = wp.where(wp.abs(beyond) < LEAST_M, LEAST_M, beyond)
        slabs.beyond[axis] = beyond
        slabs.near[axis] = -sign / beyond * back[axis]
        slabs.far[axis] = -sign / (sign * origin[axis] + half[axis]) * back[axis]
    return slabs


@wp.func
def draw_box(
    image: wp.array(dtype=float, ndim=3),
    nth: int,
    row: int,
    first: int,
    last: int,
    start: wp.vec3,
    step: wp.vec3,
    slabs: Slabs,
) -> None:
    """Lower columns `first` to `last` of a row to a box: rays start + column step in the camera's frame."""
    near, near_step = slabs.near * start, slabs.near * step
    far, far_step = slabs.far * start, slabs.far * step
    upper, upper_step = wp.vec3(NEVER_PER_M), wp.vec3()
    lower, lower_step = wp.vec3(), wp.vec3()
    for axis in range(3):
        if slabs.beyond[axis] > 0.0:
            upper[axis] = near[axis]
            upper_step[axis] = near_step[axis]
        else:
            lower[axis] = near[axis]
            lower_step[axis] = near_step[axis]
    entered = int(0)
    for column in range(first, last + 1):
        u = float(column)
        high = wp.min(upper + u * upper_step)
        low = wp.max(wp.max(lower + u * lower_step), wp.max(far + u * far_step))
        if low <= high and high < NEVER_PER_M:
            entered = int(1)
            if high * image[nth, row, column] > 1.0:
                image[nth, row, column] = 1.0 / high
        elif entered == 1:
            break


@wp.struct
class Solids:
    """Some of a model's geoms."""

    geom: wp.array(dtype=int)
    """(S,) their numbers."""
    kind: wp.array(dtype=int)
    planes: wp.array(dtype=wp.vec4)
    """(F,) half-spaces of convex meshes, in their own frames."""
    plane_range: wp.array(dtype=wp.vec2i)
    """(S,) which of them."""


@wp.struct
class Shapes:
    """Of all geoms, (N or 1, G)."""

    size: wp.array(dtype=wp.vec3, ndim=2)
    centre: wp.array(dtype=wp.vec3, ndim=2)
    """Of the bounding box, in the geom's frame."""
    half: wp.array(dtype=wp.vec3, ndim=2)
    """Of the bounding box."""


@wp.struct
class Eye:
    """The cameras of all worlds."""

    position: wp.array(dtype=wp.vec3d)
    """(N,)"""
    axes: wp.array(dtype=wp.mat33d)
    """(N,) optical frames."""
    intrinsics: wp.vec4
    height: int
    width: int


@wp.struct
class View:
    """Solids as cameras see them, (m, S) each."""

    position: wp.array(dtype=wp.vec3, ndim=2)
    rotation: wp.array(dtype=wp.mat33, ndim=2)
    slabs: wp.array(dtype=Slabs, ndim=2)
    """Of boxes only."""
    cover: wp.array(dtype=ivec4, ndim=2)
    """First and last column, first and last row of the pixels around a solid's bounding box."""


@wp.func
def covered(eye: Eye, position: wp.vec3, rotation: wp.mat33, centre: wp.vec3, half: wp.vec3) -> ivec4:
    """Pixels around a box; a box that reaches behind the camera covers all of them."""
    low_u, low_v, high_u, high_v = float(MISS), float(MISS), float(-MISS), float(-MISS)
    behind = int(0)  # a bare literal would be a constant to warp
    for corner in range(8):
        sign = wp.vec3(
            wp.where((corner & 1) == 1, 1.0, -1.0),
            wp.where((corner & 2) == 2, 1.0, -1.0),
            wp.where((corner & 4) == 4, 1.0, -1.0),
        )
        p = position + rotation * (centre + wp.cw_mul(sign, half))
        if p[2] < NEAR_M:
            behind += 1
        else:
            u = p[0] / p[2] * eye.intrinsics[0] + eye.intrinsics[2]
            v = p[1] / p[2] * eye.intrinsics[1] + eye.intrinsics[3]
            low_u, high_u = wp.min(low_u, u), wp.max(high_u, u)
            low_v, high_v = wp.min(low_v, v), wp.max(high_v, v)
    if behind == 8:
        return ivec4(0, -1, 0, -1)
    if behind > 0:
        return ivec4(0, eye.width - 1, 0, eye.height - 1)
    width, height = float(eye.width), float(eye.height)
    # Clamped as floats: a far-off corner would overflow an integer.
    return ivec4(
        int(wp.ceil(wp.clamp(low_u, 0.0, width) - 1.0e-3)),
        int(wp.floor(wp.clamp(high_u, -1.0, width - 1.0) + 1.0e-3)),
        int(wp.ceil(wp.clamp(low_v, 0.0, height) - 1.0e-3)),
        int(wp.floor(wp.clamp(high_v, -1.0, height - 1.0) + 1.0e-3)),
    )


@wp.kernel
def project(
    first: int,
    ids: wp.array(dtype=int),
    solids: Solids,
    shapes: Shapes,
    eye: Eye,
    position: wp.array(dtype=wp.vec3d, ndim=2),
    rotation: wp.array(dtype=wp.mat33d, ndim=2),
    view: View,
) -> None:
    """Fill `view` from the geoms' poses (m, G) in the world, for the worlds ids[first] and on."""
    nth, solid = wp.tid()
    nth += first
    world, geom = ids[nth], solids.geom[solid]
    back = wp.transpose(eye.axes[world])
    here = wp.vec3(back * (position[nth, geom] - eye.position[world]))
    turned = wp.mat33(back * rotation[nth, geom])
    view.position[nth, solid] = here
    view.rotation[nth, solid] = turned
    own = wp.min(world, shapes.size.shape[0] - 1)
    if solids.kind[solid] == BOX:
        view.slabs[nth, solid] = make_slabs(here, turned, shapes.size[own, geom])
    if solids.kind[solid] == PLANE:
        view.cover[nth, solid] = ivec4(0, eye.width - 1, 0, eye.height - 1)
    else:
        centre, half = shapes.centre[own, geom], shapes.half[own, geom]
        view.cover[nth, solid] = covered(eye, here, turned, centre, half)


@wp.kernel
def raster(
    first: int,
    ids: wp.array(dtype=int),
    solids: Solids,
    shapes: Shapes,
    eye: Eye,
    view: View,
    background: wp.array(dtype=float, ndim=3),
    depth: wp.array(dtype=float, ndim=3),
    millimetres: wp.array(dtype=wp.int16, ndim=3),
) -> None:
    """Depth (m, H, W) of the nearest solid [m], of `background` (N or 1, H, W) where there is none, and the
    same in millimetres, 0 beyond `MAX_M`; for the worlds ids[first] and on, a thread per image row.
    """
    nth, row = wp.tid()
    nth += first
    world = ids[nth]
    own = wp.min(world, shapes.size.shape[0] - 1)
    behind = wp.min(world, background.shape[0] - 1)
    camera = eye.intrinsics
    start = wp.vec3(-camera[2] / camera[0], (float(row) - camera[3]) / camera[1], 1.0)
    step = wp.vec3(1.0 / camera[0], 0.0, 0.0)
    for column in range(eye.width):
        depth[nth, row, column] = background[behind, row, column]
    for solid in range(solids.kind.shape[0]):
        rect = view.cover[nth, solid]
        if row >= rect[2] and row <= rect[3]:
            kind = solids.kind[solid]
            if kind == BOX:
                draw_box(depth, nth, row, rect[0], rect[1], start, step, view.slabs[nth, solid])
            else:
                back = wp.transpose(view.rotation[nth, solid])
                origin, first_ray, turn = back * (-view.position[nth, solid]), back * start, back * step
                size, planes = shapes.size[own, solids.geom[solid]], solids.plane_range[solid]
                for column in range(rect[0], rect[1] + 1):
                    t = hit(kind, size, origin, first_ray + float(column) * turn, solids.planes, planes)
                    depth[nth, row, column] = wp.min(depth[nth, row, column], t)
    for column in range(eye.width):
        far = depth[nth, row, column]
        millimetres[nth, row, column] = wp.int16(wp.where(far <= MAX_M, wp.rint(1.0e3 * far), 0.0))
