"""Warp kernels that make a stereo camera's depth image of true depths; one source for CPU and CUDA.

Shape legend: m worlds, H x W pixels of ours, which see every `spacing`-th pixel of the sensor's; disparities
in the sensor's pixels, 0 where there is none. `match` finds what both imagers see, to a whole pixel of ours,
`draw` the errors of its disparities, `read` what the sensor gives.

Noise is a sum of mosaics: squares as large as the matching window, each at a place of its own and with one
random number per square. That has exactly the correlation of white noise averaged over the window,
(1 - |x| / window)(1 - |y| / window), and costs one number per pixel. All of it is integer arithmetic on
hashes of (seed, step, square), so that every device draws the same.
"""

import warp as wp

from lerobot_vtrefine.sim.depth_kernels import MAX_M

wp.set_module_options({"enable_backward": False})

FRACTION = 256
"""Places in the image are whole numbers of 1/256 pixel."""
MOSAICS = wp.constant(4)
TO_NORMAL = wp.constant(1.0 / (16.0 * 65535.0 / 12.0) ** 0.5)
"""One over the standard deviation of a sum of 16 bytes."""
JUMP_PX = wp.constant(1.0)
"""Disparities further apart belong to different surfaces."""
MIX_1 = wp.constant(wp.uint32(0x85EBCA6B))
MIX_2 = wp.constant(wp.uint32(0xC2B2AE35))
GOLDEN = wp.constant(wp.uint32(0x9E3779B9))
FRESH = wp.constant(1)
FIXED = wp.constant(2)
SYSTEMATIC = wp.constant(3)
EDGES = wp.constant(4)


@wp.struct
class Stereo:
    """A sensor behind our pixels."""

    pixel_metres: float
    nearest_m: float
    left_px: float
    """Our first column, from the sensor's left border."""
    spacing_px: float
    spacing: int
    """[1/256 pixel]"""
    window: int
    """[1/256 pixel]"""
    half_window: float
    """[our pixels]"""
    systematic_px: float
    fresh_px: float
    fixed_px: float
    edge: float
    """[our pixels]"""
    steps_per_px: float


@wp.func
def mixed(value: wp.uint32) -> wp.uint32:
    """A hash: the finaliser of MurmurHash3."""
    value = (value ^ (value >> wp.uint32(16))) * MIX_1
    value = (value ^ (value >> wp.uint32(13))) * MIX_2
    return value ^ (value >> wp.uint32(16))


@wp.func
def added(key: wp.uint32, number: int) -> wp.uint32:
    """The key with one more number in it."""
    return mixed(key * wp.uint32(31) + wp.uint32(number) + GOLDEN)


@wp.func
def stream(seed: wp.int64, step: wp.int64, purpose: int) -> wp.uint32:
    """A key for one of an episode's random fields."""
    key = added(added(wp.uint32(purpose), int(seed & wp.int64(0x7FFFFFFF))), int(seed >> wp.int64(31)))
    return added(key, int(step))


@wp.func
def bytes_of(value: wp.uint32) -> int:
    """Sum of the four bytes less its mean."""
    byte = wp.uint32(255)
    low, high = (value & byte) + ((value >> wp.uint32(8)) & byte), value >> wp.uint32(16)
    return int(low + (high & byte) + (high >> wp.uint32(8))) - 510


@wp.struct
class Line:
    """One image row's way through a mosaic, from left to right."""

    key: wp.uint32
    column: int
    """Of squares."""
    place: int
    """From the square's left edge [1/256 pixel]."""


@wp.func
def line_through(key: wp.uint32, y: int, window: int) -> Line:
    """The row at height y of a mosaic whose squares begin at a random place, at its left end."""
    offsets = added(key, 1)
    line = Line()
    line.place = int(offsets & wp.uint32(0xFFFF)) % window
    line.key = added(key, (y + int(offsets >> wp.uint32(16)) % window) // window)
    line.column = 0
    return line


@wp.func
def add_mosaic(noise: wp.array(dtype=float), row: int, key: wp.uint32, s: Stereo, scale: float) -> None:
    """Add one mosaic to an image row's noise (W,)."""
    line = line_through(key, row * s.spacing, s.window)
    value = scale * float(bytes_of(added(line.key, 0)))
    for column in range(noise.shape[0]):
        if line.place >= s.window:
            line.column += line.place // s.window
            line.place = line.place % s.window
            value = scale * float(bytes_of(added(line.key, line.column)))
        noise[column] += value
        line.place += s.spacing


@wp.kernel
def draw(
    first: int,
    moments: wp.array(dtype=wp.int64, ndim=2),
    s: Stereo,
    noise: wp.array(dtype=float, ndim=3),
) -> None:
    """Errors (m, H, W) of the disparities, for the worlds `first` and on; a thread per image row. `moments`
    (m, 2) are each world's seed and control step.
    """
    nth, row = wp.tid()
    nth += first
    seed, step, ever = moments[nth, 0], moments[nth, 1], wp.int64(0)
    systematic = int(0)
    for layer in range(MOSAICS):
        systematic += bytes_of(added(stream(seed, ever, SYSTEMATIC), layer))
    for column in range(noise.shape[2]):
        noise[nth, row, column] = s.systematic_px * float(systematic) * TO_NORMAL
    fresh, fixed = stream(seed, step, FRESH), stream(seed, ever, FIXED)
    for layer in range(MOSAICS):
        add_mosaic(noise[nth, row], row, added(fresh, layer), s, s.fresh_px * TO_NORMAL)
        add_mosaic(noise[nth, row], row, added(fixed, layer), s, s.fixed_px * TO_NORMAL)


@wp.func
def hidden(
    depth: wp.array(dtype=float, ndim=3), nth: int, row: int, column: int, most: float, s: Stereo
) -> bool:
    """Whether something nearer hides a pixel's surface from the right imager: something right of it in our
    view then falls on the same place in the right imager's. `most` is the row's largest disparity. A surface
    that the right imager sees shrunk to half counts, too.
    """
    own = s.pixel_metres / depth[nth, row, column]
    before = float(0.0)
    for away in range(1, int((most - own) / s.spacing_px + 1.5)):
        if column + away >= depth.shape[2]:
            break
        nearer = s.pixel_metres / depth[nth, row, column + away] - own
        gap = float(away) - nearer / s.spacing_px
        if nearer > JUMP_PX:
            if wp.abs(gap) <= 0.5 or (before < 0.0 and gap > 0.0):
                return True
            before = gap
        else:
            before = 0.0
    return False


@wp.kernel
def match(
    first: int, depth: wp.array(dtype=float, ndim=3), s: Stereo, disparity: wp.array(dtype=float, ndim=3)
) -> None:
    """Disparities (m, H, W) of the depths [m] that both imagers see; a thread per image row."""
    nth, row = wp.tid()
    nth += first
    most = float(0.0)
    for column in range(depth.shape[2]):
        most = wp.max(most, s.pixel_metres / depth[nth, row, column])
    for column in range(depth.shape[2]):
        disparity[nth, row, column] = 0.0
        far = depth[nth, row, column]
        own = s.pixel_metres / far
        outside = s.left_px + float(column) * s.spacing_px < own  # of the right imager's view
        if far <= MAX_M and not outside and not hidden(depth, nth, row, column, most, s):
            disparity[nth, row, column] = own


@wp.func
def window_mean(disparity: wp.array(dtype=float, ndim=2), row: int, column: int, s: Stereo) -> float:
    """Mean disparity (H, W) of the same surface over the matching window around a pixel."""
    centre = disparity[row, column]
    reach = int(s.half_window + 0.5)
    total, weight = float(0.0), float(0.0)
    for v in range(wp.max(row - reach, 0), wp.min(row + reach + 1, disparity.shape[0])):
        line = disparity[v]
        down = share_of(v - row, s.half_window)
        for u in range(wp.max(column - reach, 0), wp.min(column + reach + 1, disparity.shape[1])):
            beside = line[u] - centre
            if wp.abs(beside) <= JUMP_PX:
                share = down * share_of(u - column, s.half_window)
                total += share * beside
                weight += share
    return centre + total / weight


@wp.func
def share_of(away: int, half_window: float) -> float:
    """How much of a pixel so far away the window covers, along one axis; all of its own."""
    return wp.where(away == 0, 1.0, wp.min(half_window + 0.5 - float(wp.abs(away)), 1.0))


@wp.kernel
def read(
    first: int,
    moments: wp.array(dtype=wp.int64, ndim=2),
    disparity: wp.array(dtype=float, ndim=3),
    noise: wp.array(dtype=float, ndim=3),
    s: Stereo,
    millimetres: wp.array(dtype=wp.int16, ndim=3),
) -> None:
    """What the sensor gives (m, H, W) [mm], 0 for nothing, of `match` and `draw`; a thread per image row."""
    nth, row = wp.tid()
    nth += first
    line = line_through(stream(moments[nth, 0], moments[nth, 1], EDGES), row * s.spacing, s.window)
    scale = 2.0 * TO_NORMAL * s.edge  # a sum of 4 bytes, not of 16
    down, right = int(0), int(0)
    for column in range(disparity.shape[2]):
        if column == 0 or line.place >= s.window:
            line.column += line.place // s.window
            line.place = line.place % s.window
            shift = added(line.key, line.column)
            down = int(wp.rint(scale * float(bytes_of(shift))))
            right = int(wp.rint(scale * float(bytes_of(added(shift, 1)))))
        v = wp.clamp(row + down, 0, disparity.shape[1] - 1)
        u = wp.clamp(column + right, 0, disparity.shape[2] - 1)
        if wp.abs(disparity[nth, v, u] - disparity[nth, row, column]) <= JUMP_PX:
            v, u = row, column
        found = int(0)
        if disparity[nth, v, u] > 0.0:
            value = window_mean(disparity[nth], v, u, s) + noise[nth, row, column]
            value = wp.rint(value * s.steps_per_px) / s.steps_per_px
            if value * MAX_M >= s.pixel_metres and value * s.nearest_m <= s.pixel_metres:
                found = int(wp.rint(1.0e3 * s.pixel_metres / value))
        millimetres[nth, row, column] = wp.int16(found)
        line.place += s.spacing
