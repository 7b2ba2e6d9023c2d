"""How the threads of a pad share its work: one on CPU, on CUDA the 32 lanes of a warp.

Each is a native snippet with a branch for CUDA; kernels that call them are written once.

What these functions answer is known when a kernel is compiled, so that nothing is left of them on CPU.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BLOCK = 64
"""Threads of a block on CUDA: few, as the memory that a block may have for its pads is limited."""


@wp.struct
class Share:
    """This thread's `lane`, and the lattice points it owns: rows `row` of every `rows` and columns `col` of
    every `cols`, both powers of two; `width` lattice points make a taxel, in either direction."""

    lane: int
    row: int
    rows: int
    col: int
    cols: int
    width: int


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 32;
#else
return 1;
#endif
""")
def lanes() -> wp.int32:
    """Threads of a pad."""
    ...


@wp.func
def make_share(width: int, lane: int) -> Share:
    """What a lane owns: four by eight points of every tile go to the lanes of a warp."""
    share = Share()
    share.lane = lane
    share.width = width
    share.rows = 1
    share.cols = 1
    if lanes() > 1:
        share.row = lane / 8
        share.rows = 4
        share.col = lane % 8
        share.cols = 8
    return share


@wp.func
def alone(share: Share) -> Share:
    """For a lane that works on what no other does, wherever it lies."""
    own = share
    own.row = 0
    own.rows = 1
    own.col = 0
    own.cols = 1
    return own


@wp.func
def own_first(begin: int, offset: int, step: int) -> int:
    """First index from `begin` on that is `offset` past a multiple of `step`, a power of two."""
    return begin + ((offset - begin) & (step - 1))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
""")
def sync_lanes() -> None:
    """From here on, each lane of a pad sees what the others have written."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return (int)__ballot_sync(0xffffffffu, yes);
#else
return yes ? 1 : 0;
#endif
""")
def ballot(yes: bool) -> wp.int32:
    """The lanes that say yes, a bit each."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
unsigned rest = (unsigned)bits;
for (int i = 0; i < n; ++i) rest &= rest - 1u;
return __ffs((int)rest) - 1;
#else
return 0;
#endif
""")
def nth_bit(bits: int, n: int) -> wp.int32:
    """Place of the n-th set bit, counted from 0; there must be so many."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return (int)((unsigned)bits & ((unsigned)bits - 1u));
#else
return 0;
#endif
""")
def drop_bit(bits: int) -> wp.int32:
    """The bits without the lowest that is set."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __popc((unsigned)bits);
#else
return bits;
#endif
""")
def count_bits(bits: int) -> wp.int32:
    """How many bits are set."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return n > 1 ? __clz(n - 1) - 27 : 5;
#else
return 0;
#endif
""")
def share_bits(n: int) -> wp.int32:
    """log2 of the lanes that each of n tasks, 1 to 32, can have."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int step = 16; step > 0; step >>= 1) x += __shfl_xor_sync(0xffffffffu, x, step);
#endif
return x;
""")
def add_lanes(x: wp.float32) -> wp.float32:
    """Sum over the lanes of a pad, the same bits in each."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int step = 16; step > 0; step >>= 1) x = fmaxf(x, __shfl_xor_sync(0xffffffffu, x, step));
__syncwarp();
#endif
return x;
""")
def max_lanes(x: wp.float32) -> wp.float32:
    """Maximum over the lanes of a pad, after which each sees what the others have written."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __reduce_max_sync(0xffffffffu, x);
#else
return x;
#endif
""")
def most_of_lanes(x: int) -> wp.int32:
    """Maximum of whole numbers over the lanes of a pad."""
    ...


@wp.func_native("""
wp::array_t<int> queue;
#if defined(__CUDA_ARCH__)
__shared__ int pool[WP_TILE_BLOCK_DIM / 32 * 64];
queue.data = pool + (threadIdx.x >> 5) * 64;
queue.shape[0] = 64;
queue.strides[0] = 4;
queue.ndim = 1;
#endif
return queue;
""")
def make_queue() -> wp.array(dtype=int):
    """Room for 64 numbers of a pad, on CUDA."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
unsigned all = __ballot_sync(0xffffffffu, yes);
if (yes) queue.data[count + __popc(all & ((1u << lane) - 1u))] = value;
__syncwarp();
return count + __popc(all);
#else
return count;
#endif
""")
def push_queue(queue: wp.array(dtype=int), count: int, lane: int, yes: bool, value: int) -> wp.int32:
    """Append the values of the lanes that say yes to a queue of `count`, at most 32; returns the new
    count."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
int value = queue.data[lane + 32];
__syncwarp();
queue.data[lane] = value;
__syncwarp();
return count > 32 ? count - 32 : 0;
#else
return 0;
#endif
""")
def pop_queue(queue: wp.array(dtype=int), count: int, lane: int) -> wp.int32:
    """Drop the first 32 of a queue; returns the new count."""
    ...
