"""Native loops over a pad's lattice: eight points at a time on CPU, one on CUDA, same source.

Warp's own code handles one number at a time on CPU, which costs these loops most of their speed.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import Share, ivec4

wp.set_module_options({"enable_backward": False})

vec10 = wp.types.vector(length=10, dtype=wp.float32)

PACKS = """
#if defined(__CUDA_ARCH__)
typedef float pack;
const int span = share.width * share.lanes;
const int own = area[2] / span * span + share.lane * share.width;
#define FOR_COLUMNS for (int g = own; g < area[3]; g += span) for (int c = g; c < g + share.width; ++c) \\
    if (c >= area[2] && c < area[3])
#define LOAD(to, from) to = (from)[c]
#define STORE(to, from) (to)[c] = from
#else
typedef float pack __attribute__((ext_vector_type(8)));
#define FOR_COLUMNS for (int c = area[2]; c < area[3]; c += 8)
#define LOAD(to, from) if (c + 8 <= area[3]) __builtin_memcpy(&to, (from) + c, sizeof(pack)); \\
    else for (int k = 0; k < area[3] - c; ++k) to[k] = (from)[c + k]
#define STORE(to, from) if (c + 8 <= area[3]) __builtin_memcpy((to) + c, &from, sizeof(pack)); \\
    else for (int k = 0; k < area[3] - c; ++k) (to)[c + k] = from[k]
#endif
"""
"""Loop over the columns of `area` that a thread owns, a pack at a time; entries past its end keep their
value."""


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
for (int step = 16; step > 0; step >>= 1)
    for (int i = 0; i < 10; ++i) x[i] += __shfl_xor_sync(0xffffffffu, x[i], step);
#endif
return x;
""")
def add_all_lanes(x: vec10) -> vec10:
    """Ten sums over the lanes of a pad at once, the same bits in each lane."""
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


@wp.func_native(
    PACKS
    + """
for (int row = area[0]; row < area[1]; ++row) {
    float* out = values.data + row * cols;
    FOR_COLUMNS {
        pack v = value;
        STORE(out, v);
    }
}
"""
)
def fill_area(share: Share, area: ivec4, cols: int, value: float, values: wp.array(dtype=float)) -> None:
    """Set this thread's points of an area."""
    ...


@wp.func_native(
    PACKS
    + """
for (int row = area[0]; row < area[1]; ++row) {
    float* depths = depth.data + row * cols;
    const float* rates = rate.data + row * cols;
    FOR_COLUMNS {
        pack d = 0.f, r = 0.f;
        LOAD(d, depths);
        LOAD(r, rates);
        pack f = stiffness * d + damping * r;
        f = f > 0.f ? f : (pack)0.f;
        f = f < ceiling ? f : (pack)ceiling;
        f = d > 0.f ? f : (pack)0.f;
        STORE(depths, f);
    }
}
"""
)
def penalties(
    share: Share,
    area: ivec4,
    cols: int,
    stiffness: float,
    damping: float,
    ceiling: float,
    rate: wp.array(dtype=float),
    depth: wp.array(dtype=float),
) -> None:
    """Put min(max(0, stiffness d + damping d'), ceiling) in place of positive depths d, 0 in place of
    others."""
    ...


@wp.func_native(
    PACKS
    + """
pack best = -1.f;
for (int row = area[0]; row < area[1]; ++row) {
    const float* heights = height.data + row * cols;
    float* rates = rate.data + row * cols;
    FOR_COLUMNS {
        pack h = -1.f, r = 0.f;
        LOAD(h, heights);
        LOAD(r, rates);
        r = r * damping_s;
        r = r > limit ? (pack)limit : r;
        r = r < -limit ? (pack)-limit : r;
        h = h > -0.5f ? h + r : (pack)-1.f;
        best = best > h ? best : h;
        STORE(rates, h);
    }
}
#if defined(__CUDA_ARCH__)
return best;
#else
float top = -1.f;
for (int k = 0; k < 8; ++k) top = top > best[k] ? top : best[k];
return top;
#endif
"""
)
def add_lead(
    share: Share,
    area: ivec4,
    cols: int,
    damping_s: float,
    limit: float,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> wp.float32:
    """Put height plus viscous lead in place of the rates; returns the largest, -1 m without a body."""
    ...


@wp.func_native(
    PACKS
    + """
pack n = 0.f, sx = 0.f, sy = 0.f, sxx = 0.f, sxy = 0.f, syy = 0.f, su = 0.f, sux = 0.f, suy = 0.f, suu = 0.f;
for (int row = area[0]; row < area[1]; ++row) {
    const float* leads = lead.data + row * cols;
    float y = (float)(row / share.width) - middle_row;
    float base = trial[0] + trial[2] * y;
    pack rn = 0.f, rx = 0.f, ru = 0.f;
    FOR_COLUMNS {
        pack u = -1.f, x = 0.f;
        LOAD(u, leads);
        LOAD(x, taxel_x.data);
        u = u + (base + trial[1] * x);
        pack k = u > 0.f ? (pack)1.f : (pack)0.f;
        u = u > 0.f ? u : (pack)0.f;
        pack kx = k * x;
        rn += k;
        rx += kx;
        ru += u;
        sxx += kx * x;
        sux += u * x;
        suu += u * u;
    }
    n += rn;
    sx += rx;
    su += ru;
    sy += rn * y;
    sxy += rx * y;
    syy += rn * (y * y);
    suy += ru * y;
}
wp::vec_t<10, float> sums;
#if defined(__CUDA_ARCH__)
sums[0] = n; sums[1] = sx; sums[2] = sy; sums[3] = sxx; sums[4] = sxy; sums[5] = syy;
sums[6] = su; sums[7] = sux; sums[8] = suy; sums[9] = suu;
#else
pack all[10] = {n, sx, sy, sxx, sxy, syy, su, sux, suy, suu};
for (int i = 0; i < 10; ++i) {
    pack v = all[i];
    sums[i] = ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
}
#endif
return sums;
"""
)
def raw_sums(
    share: Share,
    area: ivec4,
    cols: int,
    middle_row: float,
    trial: wp.vec3,
    taxel_x: wp.array(dtype=float),
    lead: wp.array(dtype=float),
) -> vec10:
    """(n, x, y, x^2, x y, y^2, u, u x, u y, u^2) summed over this thread's points in contact."""
    ...


@wp.func_native(
    PACKS
    + """
float whole = 0.f;
int s = share.width, taxel_cols = cols / s;
for (int row = area[0] / s; row < area[1] / s; ++row) {
    float base = answer[0] + answer[2] * ((float)row - middle_row);
    FOR_COLUMNS {
        pack sum = 0.f;
        for (int line = row * s; line < row * s + s; ++line) {
            pack u = -1.f, x = 0.f;
            LOAD(u, lead.data + line * cols);
            LOAD(x, taxel_x.data);
            u = u + (base + answer[1] * x);
            sum += u > 0.f ? u : (pack)0.f;
        }
        float* out = force.data + row * taxel_cols;
#if defined(__CUDA_ARCH__)
        out[c / s] += stiffness * sum;
        whole += sum;
#else
        for (int k = 0; k < 8 && c + k < area[3]; ++k) {
            out[(c + k) / s] += stiffness * sum[k];
            whole += sum[k];
        }
#endif
    }
}
return whole;
"""
)
def add_forces(
    share: Share,
    area: ivec4,
    cols: int,
    middle_row: float,
    stiffness: float,
    answer: wp.vec3,
    taxel_x: wp.array(dtype=float),
    lead: wp.array(dtype=float),
    force: wp.array(dtype=float),
) -> wp.float32:
    """Add a solution's forces to this thread's taxels, which must come in as zero; returns the sum of u."""
    ...
