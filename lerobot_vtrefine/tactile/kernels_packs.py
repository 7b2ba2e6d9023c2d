"""Native loops over a pad's lattice: eight points at a time on CPU, a lane's own on CUDA, a branch for each.

Warp's own code handles one number at a time on CPU, which costs these loops most of their speed. `stride` is
the length of a row of heights and leads, which `kernels_surface` lays out.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import ivec4
from lerobot_vtrefine.tactile.kernels_lanes import Share
from lerobot_vtrefine.tactile.kernels_surface import KEYS

wp.set_module_options({"enable_backward": False})

vec10 = wp.types.vector(length=10, dtype=wp.float32)

PACKS = (
    KEYS
    + """
#if defined(__CUDA_ARCH__)
#define LEAD(at) lead.data[2 * (at)]
#define TAXEL(i) floorf(((float)(i) + 0.5f) * taxels)
#else
typedef float pack __attribute__((ext_vector_type(8)));
#define FOR_COLUMNS for (int c = area[2]; c < area[3]; c += 8)
#define LOAD(to, from) if (c + 8 <= area[3]) __builtin_memcpy(&to, (from) + c, sizeof(pack)); \\
    else for (int k = 0; k < area[3] - c; ++k) to[k] = (from)[c + k]
#define STORE(to, from) if (c + 8 <= area[3]) __builtin_memcpy((to) + c, &from, sizeof(pack)); \\
    else for (int k = 0; k < area[3] - c; ++k) (to)[c + k] = from[k]
#endif
"""
)
"""Loop over the columns of `area` a pack at a time, entries past its end keep their value; for CUDA, the lead
of a point and the taxel to which a row or column belongs, given taxels per point."""


@wp.func_native(
    PACKS
    + """
#if defined(__CUDA_ARCH__)
long long* keys = (long long*)values.data;
FOR_OWN_ROWS FOR_OWN_COLUMNS keys[row * stride + c] = KEY(value, 0.f);
#else
for (int row = area[0]; row < area[1]; ++row) {
    float* out = values.data + row * stride;
    FOR_COLUMNS {
        pack v = value;
        STORE(out, v);
    }
}
#endif
"""
)
def fill_area(share: Share, area: ivec4, stride: int, value: float, values: wp.array(dtype=float)) -> None:
    """Set the heights of this thread's points of an area."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int i = share.lane; i < count; i += 32) values.data[i] = 0.f;
__syncwarp();
#else
for (int i = 0; i < count; ++i) values.data[i] = 0.f;
#endif
""")
def clear(share: Share, count: int, values: wp.array(dtype=float)) -> None:
    """Zero `count` numbers, after which each lane may write any of them."""
    ...


@wp.func_native(
    PACKS
    + """
#if defined(__CUDA_ARCH__)
const long long* keys = (const long long*)height.data;
for (int row = 0; row < whole[1]; ++row) {
    bool within = row >= area[0] && row < area[1];
    for (int c = share.lane; c < whole[3]; c += 32) {
        float f = 0.f;
        if (within && c >= area[2] && c < area[3]) {
            long long key = keys[row * stride + c];
            float d = HEIGHT(key);
            if (d > 0.f) f = fminf(fmaxf(stiffness * d + damping * RATE(key), 0.f), ceiling);
        }
        force.data[row * whole[3] + c] = f;
    }
}
#else
for (int row = area[0]; row < area[1]; ++row) {
    float* out = force.data + row * whole[3];
    const float* depths = height.data + row * stride;
    const float* rates = rate.data + row * stride;
    FOR_COLUMNS {
        pack d = 0.f, r = 0.f;
        LOAD(d, depths);
        LOAD(r, rates);
        pack f = stiffness * d + damping * r;
        f = f > 0.f ? f : (pack)0.f;
        f = f < ceiling ? f : (pack)ceiling;
        f = d > 0.f ? f : (pack)0.f;
        STORE(out, f);
    }
}
#endif
"""
)
def penalties(
    share: Share,
    area: ivec4,
    whole: ivec4,
    stride: int,
    stiffness: float,
    damping: float,
    ceiling: float,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
    force: wp.array(dtype=float),
) -> None:
    """Forces min(max(0, stiffness d + damping d'), ceiling) of the `area` with positive depths d; on CUDA 0
    in the rest of the `whole` pad, on CPU it must be there (force may be where the heights are)."""
    ...


@wp.func_native(
    PACKS
    + """
#if defined(__CUDA_ARCH__)
float best = -1.f;
long long* keys = (long long*)height.data;
FOR_OWN_ROWS FOR_OWN_COLUMNS {
    long long key = keys[row * stride + c];
    float h = HEIGHT(key);
    float r = fmaxf(fminf(RATE(key) * damping_s, limit), -limit);
    h = h > -0.5f ? h + r : -1.f;
    best = fmaxf(best, h);
    ((float*)keys)[2 * (row * stride + c)] = h;
}
return best;
#else
pack best = -1.f;
for (int row = area[0]; row < area[1]; ++row) {
    const float* heights = height.data + row * stride;
    float* rates = rate.data + row * stride;
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
float top = -1.f;
for (int k = 0; k < 8; ++k) top = top > best[k] ? top : best[k];
return top;
#endif
"""
)
def add_lead(
    share: Share,
    area: ivec4,
    stride: int,
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
wp::vec_t<10, float> sums;
#if defined(__CUDA_ARCH__)
float n = 0.f, sx = 0.f, sy = 0.f, sxx = 0.f, sxy = 0.f, syy = 0.f, su = 0.f, sux = 0.f, suy = 0.f, suu = 0.f;
const float taxels = 1.f / (float)share.width, first_x = taxel_x.data[0];
FOR_OWN_ROWS {
    float y = TAXEL(row) - middle_row, base = trial[0] + trial[2] * y, rn = 0.f, rx = 0.f, ru = 0.f;
    FOR_OWN_COLUMNS {
        float x = TAXEL(c) + first_x, u = LEAD(row * stride + c) + (base + trial[1] * x);
        if (u > 0.f) {
            rn += 1.f;
            rx += x;
            ru += u;
            sxx += x * x;
            sux += u * x;
            suu += u * u;
        }
    }
    n += rn;
    sx += rx;
    su += ru;
    sy += rn * y;
    sxy += rx * y;
    syy += rn * (y * y);
    suy += ru * y;
}
sums[0] = n; sums[1] = sx; sums[2] = sy; sums[3] = sxx; sums[4] = sxy; sums[5] = syy;
sums[6] = su; sums[7] = sux; sums[8] = suy; sums[9] = suu;
#else
pack n = 0.f, sx = 0.f, sy = 0.f, sxx = 0.f, sxy = 0.f, syy = 0.f, su = 0.f, sux = 0.f, suy = 0.f, suu = 0.f;
for (int row = area[0]; row < area[1]; ++row) {
    const float* leads = lead.data + row * stride;
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
    stride: int,
    middle_row: float,
    trial: wp.vec3,
    taxel_x: wp.array(dtype=float),
    lead: wp.array(dtype=float),
) -> vec10:
    """(n, x, y, x^2, x y, y^2, u, u x, u y, u^2) summed over this thread's points in contact."""
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


@wp.func_native(
    PACKS
    + """
float whole = 0.f;
#if defined(__CUDA_ARCH__)
const float taxels = 1.f / (float)share.width, first_x = taxel_x.data[0];
FOR_OWN_ROWS {
    float base = answer[0] + answer[2] * (TAXEL(row) - middle_row);
    FOR_OWN_COLUMNS whole += fmaxf(LEAD(row * stride + c) + (base + answer[1] * (TAXEL(c) + first_x)), 0.f);
}
#else
int s = share.width;
for (int row = area[0] / s; row < area[1] / s; ++row) {
    float base = answer[0] + answer[2] * ((float)row - middle_row);
    float* out = force.data + row * taxel_cols;
    FOR_COLUMNS {
        pack sum = 0.f;
        for (int line = row * s; line < row * s + s; ++line) {
            pack u = -1.f, x = 0.f;
            LOAD(u, lead.data + line * stride);
            LOAD(x, taxel_x.data);
            u = u + (base + answer[1] * x);
            sum += u > 0.f ? u : (pack)0.f;
        }
        for (int k = 0; k < 8 && c + k < area[3]; ++k) {
            out[(c + k) / s] += sum[k];
            whole += sum[k];
        }
    }
}
#endif
return whole;
"""
)
def add_forces(
    share: Share,
    area: ivec4,
    stride: int,
    taxel_cols: int,
    middle_row: float,
    answer: wp.vec3,
    taxel_x: wp.array(dtype=float),
    lead: wp.array(dtype=float),
    force: wp.array(dtype=float),
) -> wp.float32:
    """The sum of a solution's u over this thread's points; on CPU also that of each taxel, into zeros."""
    ...


@wp.func_native(
    PACKS
    + """
int s = share.width;
#if defined(__CUDA_ARCH__)
const float first_x = taxel_x.data[0];
const int row0 = area[0] / s, row1 = area[1] / s, col0 = area[2] / s, col1 = area[3] / s;
for (int row = 0; row < taxel_rows; ++row) {
    bool within = row >= row0 && row < row1;
    float base = answer[0] + answer[2] * ((float)row - middle_row);
    for (int col = share.lane; col < taxel_cols; col += 32) {
        float f = 0.f;
        if (within && col >= col0 && col < col1) {
            float rise = base + answer[1] * ((float)col + first_x);
            for (int i = 0; i < s; ++i)
                for (int j = 0; j < s; ++j)
                    f += fmaxf(LEAD((row * s + i) * stride + col * s + j) + rise, 0.f);
        }
        force.data[row * taxel_cols + col] = f * factor;
    }
}
#else
for (int row = area[0] / s; row < area[1] / s; ++row)
    for (int col = area[2] / s; col < area[3] / s; ++col) force.data[row * taxel_cols + col] *= factor;
#endif
"""
)
def scale_forces(
    share: Share,
    area: ivec4,
    stride: int,
    taxel_rows: int,
    taxel_cols: int,
    middle_row: float,
    factor: float,
    answer: wp.vec3,
    taxel_x: wp.array(dtype=float),
    lead: wp.array(dtype=float),
    force: wp.array(dtype=float),
) -> None:
    """Forces from the taxels' sums of u, by a factor; on CUDA the sums are taken here, and all taxels
    written."""
    ...
