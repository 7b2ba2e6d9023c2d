"""A pad's heights and their rates while its bodies are looked at: one name for two native
implementations.

On CPU two arrays. On CUDA, in the memory of a multiprocessor, one number per point that has the height in its
upper half, ordered as whole numbers are, and the rate (later the lead) in its lower: that the higher of two
lanes' surfaces wins, with its rate, is then one atomic maximum, whatever their order. `stride` is the length
of a row there.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import ivec4
from lerobot_vtrefine.tactile.kernels_lanes import Share, lanes

wp.set_module_options({"enable_backward": False})

KEYS = """
#define ORDERED(i) ((i) ^ (((i) >> 31) & 0x7fffffff))
#define KEY(h, r) (((long long)ORDERED(__float_as_int(h)) << 32) | (long long)(unsigned)__float_as_int(r))
#define HEIGHT(key) __int_as_float(ORDERED((int)((key) >> 32)))
#define RATE(key) __int_as_float((int)(key))
#define OWN_FIRST(begin, offset, step) ((begin) + (((offset) - (begin)) & ((step) - 1)))
#define FOR_OWN(i, begin, end, at, step) for (int i = OWN_FIRST(begin, at, step); i < (end); i += (step))
#define FOR_OWN_ROWS FOR_OWN(row, area[0], area[1], share.row, share.rows)
#define FOR_OWN_COLUMNS FOR_OWN(c, area[2], area[3], share.col, share.cols)
"""
"""For CUDA: the numbers in which heights and rates are kept, and loops over a lane's points of `area`."""


@wp.func
def row_length(cols: int, area: ivec4) -> int:
    """Stride of an area's rows: on CUDA such that four of them, eight points each, lie in different banks."""
    if lanes() == 1:
        return cols
    return ((wp.max(area[3] - area[2], 1) + 7) / 8 | 1) * 8


TAXEL_POINTS = 480
"""Points of a pad, a taxel each, that fit into a multiprocessor's memory beside enough others."""
LATTICE_POINTS = 1728
"""The same with four points a taxel."""
ROOM = """
#if defined(__CUDA_ARCH__)
__shared__ long long pool[WP_TILE_BLOCK_DIM / 32 * POINTS];
wp::array_t<wp::float32> room = other;
if ((area[1] - area[0]) * stride <= POINTS) room.data = (float*)(pool + (threadIdx.x >> 5) * POINTS);
room.data -= 2 * (area[0] * stride + area[2]);
return room;
#else
return own;
#endif
"""


@wp.func_native(ROOM.replace("POINTS", str(TAXEL_POINTS)))
def taxel_room(
    area: ivec4, stride: int, own: wp.array(dtype=float), other: wp.array(dtype=float)
) -> wp.array(dtype=float):
    """Where heights are kept, indexed by `row * stride + column`: on CPU `own`, on CUDA the multiprocessor's
    memory where the area fits there, else `other`, two numbers a point."""
    ...


@wp.func_native(ROOM.replace("POINTS", str(LATTICE_POINTS)))
def lattice_room(
    area: ivec4, stride: int, own: wp.array(dtype=float), other: wp.array(dtype=float)
) -> wp.array(dtype=float):
    """`taxel_room` for four points a taxel."""
    ...


@wp.func_native(
    KEYS
    + """
#if defined(__CUDA_ARCH__)
return HEIGHT(((const long long*)height.data)[index]);
#else
return height.data[index];
#endif
"""
)
def height_at(height: wp.array(dtype=float), index: int) -> wp.float32:
    """Height of a point."""
    ...


@wp.func_native(
    KEYS
    + """
#if defined(__CUDA_ARCH__)
((long long*)height.data)[index] = KEY(value, speed);
#else
height.data[index] = value;
rate.data[index] = speed;
#endif
"""
)
def put_point(
    height: wp.array(dtype=float), rate: wp.array(dtype=float), index: int, value: float, speed: float
) -> None:
    """Set height and rate of a point that this thread owns."""
    ...


@wp.func_native(
    KEYS
    + """
#if defined(__CUDA_ARCH__)
long long* keys = (long long*)height.data + row;
for (int c = OWN_FIRST(begin, share.col, share.cols); c < end; c += share.cols) {
    float x = ((float)c - middle) * pitch;
    float h = plane[0] + plane[1] * x;
    h = h < bounds[1] ? bounds[1] : h;
    h = h > bounds[2] ? bounds[2] : h;
    if (h >= bounds[0] && h <= bounds[3]) {
        long long key = KEY(h, speed[0] + speed[1] * x - speed[2] * h);
        if (key > keys[c]) {
            if (share.cols == 1) atomicMax(keys + c, key);
            else keys[c] = key;
        }
    }
}
#else
float* heights = height.data + row;
float* rates = rate.data + row;
int c = begin;
typedef float pack __attribute__((ext_vector_type(8)));
pack index = {0.f, 1.f, 2.f, 3.f, 4.f, 5.f, 6.f, 7.f};
for (; c + 8 <= end; c += 8) {
    pack x = (index + ((float)c - middle)) * pitch, h = plane[0] + plane[1] * x, old, oldrate;
    h = __builtin_elementwise_min(__builtin_elementwise_max(h, (pack)bounds[1]), (pack)bounds[2]);
    __builtin_memcpy(&old, heights + c, sizeof(pack));
    __builtin_memcpy(&oldrate, rates + c, sizeof(pack));
    auto wins = (h > old) & (h >= bounds[0]) & (h <= bounds[3]);
    pack r = speed[0] + speed[1] * x - speed[2] * h;
    h = wins ? h : old;
    r = wins ? r : oldrate;
    __builtin_memcpy(heights + c, &h, sizeof(pack));
    __builtin_memcpy(rates + c, &r, sizeof(pack));
}
for (; c < end; ++c) {
    float x = ((float)c - middle) * pitch;
    float h = plane[0] + plane[1] * x;
    h = h < bounds[1] ? bounds[1] : h;
    h = h > bounds[2] ? bounds[2] : h;
    if (h > heights[c] && h >= bounds[0] && h <= bounds[3]) {
        heights[c] = h;
        rates[c] = speed[0] + speed[1] * x - speed[2] * h;
    }
}
#endif
"""
)
def raise_span(
    share: Share,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
    row: int,
    begin: int,
    end: int,
    middle: float,
    pitch: float,
    plane: wp.vec2,
    bounds: wp.vec4,
    speed: wp.vec3,
) -> None:
    """Raise one row's columns begin..end to a plane: height plane . (1, x), rate speed . (1, x, -height).

    `row` is the row's place in the arrays, `bounds` the lowest height that counts, the two between which the
    plane's is held, and the highest that counts. Lanes that work alone may come to the same point.
    """
    ...


@wp.func_native(
    KEYS
    + """
#if defined(__CUDA_ARCH__)
long long* keys = (long long*)height.data;
FOR_OWN_ROWS FOR_OWN_COLUMNS
    keys[row * stride + c] = KEY(given_height.data[row * cols + c], given_rate.data[row * cols + c]);
#endif
"""
)
def take_in(
    share: Share,
    area: ivec4,
    stride: int,
    cols: int,
    given_height: wp.array(dtype=float),
    given_rate: wp.array(dtype=float),
    height: wp.array(dtype=float),
) -> None:
    """Begin with the heights and rates of two arrays; on CPU these are the ones that are worked on."""
    ...


@wp.func_native(
    KEYS
    + """
#if defined(__CUDA_ARCH__)
const long long* keys = (const long long*)height.data;
FOR_OWN_ROWS FOR_OWN_COLUMNS {
    long long key = keys[row * stride + c];
    given_height.data[row * cols + c] = HEIGHT(key);
    given_rate.data[row * cols + c] = RATE(key);
}
#endif
"""
)
def give_out(
    share: Share,
    area: ivec4,
    stride: int,
    cols: int,
    height: wp.array(dtype=float),
    given_height: wp.array(dtype=float),
    given_rate: wp.array(dtype=float),
) -> None:
    """Inverse of `take_in`."""
    ...
