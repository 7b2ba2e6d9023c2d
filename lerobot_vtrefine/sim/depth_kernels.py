"""Warp kernels of the depth camera; one source for CPU and CUDA.

Shape legend: m worlds, G geoms, F planes, H x W pixels; float32, metres, everything in the camera's optical
frame. `project` finds the pixels that a geom can cover, `raster` intersects only those. Solids are convex, so
that a ray meets them in one interval; a capsule is three of them.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

PLANE = wp.constant(0)
SPHERE = wp.constant(2)
CAPSULE = wp.constant(3)
CYLINDER = wp.constant(5)
BOX = wp.constant(6)
HULL = wp.constant(7)
MISS = wp.constant(1.0e9)
NEAR_M = wp.constant(0.01)

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
    """z-depth at which a ray meets a geom, both in the geom's frame."""
    if kind == BOX:
        interval = clip_slab(wp.vec2(-MISS, MISS), origin[0], slope[0], size[0])
        interval = clip_slab(interval, origin[1], slope[1], size[1])
        return entry(clip_slab(interval, origin[2], slope[2], size[2]))
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


@wp.kernel
def project(
    kind: wp.array(dtype=int),
    centre: wp.array(dtype=wp.vec3, ndim=2),
    half: wp.array(dtype=wp.vec3, ndim=2),
    shared: int,
    pos: wp.array(dtype=wp.vec3, ndim=2),
    rot: wp.array(dtype=wp.mat33, ndim=2),
    camera: wp.vec4,
    height: int,
    width: int,
    cover: wp.array(dtype=ivec4, ndim=2),
) -> None:
    """Pixel rectangle (first and last column, first and last row) around each geom's bounding box."""
    world, geom = wp.tid()
    own = wp.where(shared == 1, 0, world)
    low_u, low_v, high_u, high_v = float(MISS), float(MISS), float(-MISS), float(-MISS)
    whole = kind[geom] == PLANE
    behind = int(0)  # a bare literal would be a constant to warp
    for corner in range(8):
        sign = wp.vec3(
            wp.where((corner & 1) == 1, 1.0, -1.0),
            wp.where((corner & 2) == 2, 1.0, -1.0),
            wp.where((corner & 4) == 4, 1.0, -1.0),
        )
        p = pos[world, geom] + rot[world, geom] * (centre[own, geom] + wp.cw_mul(sign, half[own, geom]))
        if p[2] < NEAR_M:
            behind += 1
        else:
            u, v = p[0] / p[2] * camera[0] + camera[2], p[1] / p[2] * camera[1] + camera[3]
            low_u, high_u = wp.min(low_u, u), wp.max(high_u, u)
            low_v, high_v = wp.min(low_v, v), wp.max(high_v, v)
    if whole or (behind > 0 and behind < 8):
        cover[world, geom] = ivec4(0, width - 1, 0, height - 1)
    elif behind == 8:
        cover[world, geom] = ivec4(0, -1, 0, -1)
    else:
        # Clamped as floats: a far-off corner would overflow an integer.
        cover[world, geom] = ivec4(
            int(wp.ceil(wp.clamp(low_u, -1.0, float(width)) - 1.0e-3)),
            int(wp.floor(wp.clamp(high_u, -1.0, float(width)) + 1.0e-3)),
            int(wp.ceil(wp.clamp(low_v, -1.0, float(height)) - 1.0e-3)),
            int(wp.floor(wp.clamp(high_v, -1.0, float(height)) + 1.0e-3)),
        )


@wp.kernel
def raster(
    first_world: int,
    kind: wp.array(dtype=int),
    size: wp.array(dtype=wp.vec3, ndim=2),
    shared: int,
    pos: wp.array(dtype=wp.vec3, ndim=2),
    rot: wp.array(dtype=wp.mat33, ndim=2),
    cover: wp.array(dtype=ivec4, ndim=2),
    planes: wp.array(dtype=wp.vec4),
    plane_range: wp.array(dtype=wp.vec2i),
    camera: wp.vec4,
    width: int,
    depth: wp.array(dtype=float, ndim=3),
) -> None:
    """Lower `depth` [m] to the nearest geom of each pixel, from `first_world` on; a thread per image row."""
    nth, row = wp.tid()
    world = first_world + nth
    own = wp.where(shared == 1, 0, world)
    for geom in range(kind.shape[0]):
        rect = cover[world, geom]
        if row >= rect[2] and row <= rect[3]:
            back = wp.transpose(rot[world, geom])
            origin = back * (-pos[world, geom])
            start = back * wp.vec3(-camera[2] / camera[0], (float(row) - camera[3]) / camera[1], 1.0)
            step = back * wp.vec3(1.0 / camera[0], 0.0, 0.0)
            dims = size[own, geom]
            for column in range(wp.max(rect[0], 0), wp.min(rect[1], width - 1) + 1):
                slope = start + float(column) * step
                t = hit(kind[geom], dims, origin, slope, planes, plane_range[geom])
                if t < depth[world, row, column]:
                    depth[world, row, column] = t
