"""What a block of threads does together, in native code: wait, add up, solve an equation. Imports warp.

On the CPU a block is one thread, or several that take turns (`warp.config.enable_cpu_blocks`), as in tests.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native(snippet="WP_TILE_SYNC();")
def wait() -> None:
    """Until all threads of a block are here."""
    ...


SUM = """
#if defined(__CUDA_ARCH__)
    constexpr int width = 32;
    for (int k = 0; k < 4; ++k)
        for (int offset = width / 2; offset > 0; offset /= 2)
            value[k] += __shfl_xor_sync(0xffffffff, value[k], offset);
    // Memory of its own: Warp gives a block none of the tiles' where a kernel has no tiles.
    __shared__ float shared[WP_TILE_BLOCK_DIM / width][4];
#else
    constexpr int width = 1;
    wp::wp_block_shared<float[WP_TILE_BLOCK_DIM][4]> holder;
    auto& shared = *holder;
#endif
    for (int k = 0; k < 4; ++k)
        shared[WP_TILE_THREAD_IDX / width][k] = value[k];
    WP_TILE_SYNC();
    value = {};
    for (int part = 0; part < WP_TILE_BLOCK_DIM / width; ++part)
        for (int k = 0; k < 4; ++k)
            value[k] += shared[part][k];
    WP_TILE_SYNC();
    return value;
"""


@wp.func_native(snippet=SUM)
def total(value: wp.vec4) -> wp.vec4:
    """Sum over the threads of a block, to the last bit the same for all of them; a third of the machine code
    of `wp.tile_reduce`. Blocks are whole warps.
    """
    ...


AIM = """
    constexpr int nv = %d;
#if defined(__CUDA_ARCH__)
    __shared__ float matrix[nv][nv + 1];
#else
    wp::wp_block_shared<float[nv][nv + 1]> holder;
    auto& matrix = *holder;
#endif
    const int lane = WP_TILE_THREAD_IDX, lanes = WP_TILE_BLOCK_DIM;
    const int stripe = lanes < 32 ? lanes : 32, step = lanes / stripe;
    for (int item = lane; item < nv * nv; item += lanes) {
        float sum = 0.0f;
        if (item %% nv >= item / nv)
            for (int group = 0; group < hessian.shape[0]; ++group)
                sum += hessian.data[group * nv * nv + item];
        matrix[item / nv][item %% nv] = sum;
    }
    for (int dof = lane; dof < nv; dof += lanes)
        matrix[dof][nv] = -gradient.data[dof];
    for (int pivot = 0; pivot < nv; ++pivot) {
        WP_TILE_SYNC();
        for (int column = pivot + 1 + lane %% stripe; column <= nv; column += stripe) {
            const float share = matrix[pivot][column] / matrix[pivot][pivot];
            const int last = column < nv ? column : nv - 1;
            // Four at a time: none of their loads waits for a store that may be to the same place.
            for (int row = pivot + 1 + lane / stripe; row <= last; row += 4 * step) {
                float lead[4], own[4];
                for (int k = 0; k < 4; ++k) {
                    const int place = row + k * step <= last ? row + k * step : row;
                    lead[k] = matrix[pivot][place];
                    own[k] = matrix[place][column];
                }
                for (int k = 0; k < 4; ++k)
                    if (row + k * step <= last)
                        matrix[row + k * step][column] = own[k] - share * lead[k];
            }
        }
    }
    for (int pivot = nv - 1; pivot >= 0; --pivot) {
        WP_TILE_SYNC();
        const float solved = matrix[pivot][nv] / matrix[pivot][pivot];
        for (int row = lane; row < pivot; row += lanes)
            matrix[row][nv] -= solved * matrix[row][pivot];
    }
    WP_TILE_SYNC();
    wp::vec2 sums(0.0f, 0.0f);
    for (int dof = 0; dof < nv; ++dof) {
        const float along = matrix[dof][nv] / matrix[dof][dof];
        sums[0] += along * along;
        sums[1] -= along * gradient.data[dof];
        if (dof %% lanes == lane)
            direction.data[dof] = along;
    }
    WP_TILE_SYNC();
    return sums;
"""


def make_aim(nv: int) -> wp.Function:
    """The function that finds a direction, for so many velocities."""

    @wp.func_native(snippet=AIM % nv)
    def aim(
        hessian: wp.array(dtype=float, ndim=3),
        gradient: wp.array(dtype=float),
        direction: wp.array(dtype=float),
    ) -> wp.vec2:
        """Solve H direction = -gradient; returns its squared length and its product with the negative
        gradient.

        By elimination, H = U' D^-1 U with D the diagonal of U, in place of H's upper triangle and in a
        block's own memory: a thread has a column, of every so many rows, and waits once for each row.
        """
        ...

    return aim
