"""Warp kernels of the constraint solver: what sliding contacts add to the Hessian, and when to stop.

Shape legend: N worlds, C contacts, nv velocities.
"""

import warp as wp
from mujoco_warp._src.types import OverflowType, vec5

wp.set_module_options({"enable_backward": False})

CONE = wp.constant(4)
"""State of the rows of a contact that slides."""
TOO_FEW_ITERATIONS = wp.constant(int(OverflowType.ITERATIONS))
TINY = wp.constant(1.0e-15)


@wp.struct
class Rows:
    """Constraint rows of N worlds, as mujoco_warp keeps them; (N, rows) each."""

    first: wp.array(dtype=int)
    """(N,) equalities, which come before friction, limits and contacts."""
    count: wp.array(dtype=int)
    contact: wp.array(dtype=int, ndim=2)
    state: wp.array(dtype=int, ndim=2)
    stiffness: wp.array(dtype=float, ndim=2)
    residual: wp.array(dtype=float, ndim=2)
    jacobian: wp.array(dtype=float, ndim=3)


@wp.struct
class Cones:
    """Contacts (C,): which rows each has, its friction, and the solver's ratio of the impedances."""

    row: wp.array(dtype=int, ndim=2)
    dim: wp.array(dtype=int)
    friction: wp.array(dtype=vec5)
    ratio: wp.array(dtype=float)


@wp.struct
class Sliding:
    """Which contacts slide: how many in each world (N,), and their first rows (N, most)."""

    count: wp.array(dtype=int)
    row: wp.array(dtype=int, ndim=2)


@wp.func
def curvature(
    world: int, row: int, contact: int, i: int, j: int, ratio: float, rows: Rows, cones: Cones
) -> float:
    """Second derivative by velocities i and j of a sliding contact's cost, s/2 (n - mu t)^2.

    With n = mu r_0 and u_k = f_k r_k of the residuals r, t = |u|, and z = dn, du the same of the Jacobian's
    columns, p = u.z / t:  s (z_n z_n - mu (z_n p + p z_n) + (mu^2 - mu n / t) z_u.z_u + mu n / t p p).
    """
    friction = cones.friction[contact]
    mu = friction[0] * ratio
    stiffness = rows.stiffness[world, row] / wp.max(mu * mu * (1.0 + mu * mu), TINY)
    normal = mu * rows.residual[world, row]
    z_i = mu * rows.jacobian[world, row, i]
    z_j = mu * rows.jacobian[world, row, j]
    square = float(0.0)
    along_i = float(0.0)
    along_j = float(0.0)
    both = float(0.0)
    for k in range(1, cones.dim[contact]):
        other = cones.row[contact, k]
        if other >= 0:
            scale = friction[k - 1]
            u = scale * rows.residual[world, other]
            u_i = scale * rows.jacobian[world, other, i]
            u_j = scale * rows.jacobian[world, other, j]
            square += u * u
            along_i += u * u_i
            along_j += u * u_j
            both += u_i * u_j
    length = wp.max(wp.sqrt(square), TINY)
    share = mu * normal / length
    p_i = along_i / length
    p_j = along_j / length
    return stiffness * (
        z_i * z_j - mu * (z_i * p_j + p_i * z_j) + (mu * mu - share) * both + share * p_i * p_j
    )


@wp.kernel
def find_sliding(done: wp.array(dtype=bool), rows: Rows, cones: Cones, sliding: Sliding) -> None:
    """List the contacts that slide; a thread per row. `sliding.count` is zero before."""
    world, row = wp.tid()
    if done[world] or row < rows.first[world] or row >= rows.count[world]:
        return
    if rows.state[world, row] != CONE:  # also rows that are no contact's
        return
    if cones.row[rows.contact[world, row], 0] == row:
        sliding.row[world, wp.atomic_add(sliding.count, world, 1)] = row


@wp.kernel
def add_curvature(
    pair_i: wp.array(dtype=int),
    pair_j: wp.array(dtype=int),
    done: wp.array(dtype=bool),
    rows: Rows,
    cones: Cones,
    sliding: Sliding,
    hessian: wp.array(dtype=float, ndim=3),
) -> None:
    """Add the curvature of all sliding contacts to the Hessians (N, nv, nv); a thread per entry."""
    world, pair = wp.tid()
    if done[world] or sliding.count[world] == 0:
        return
    i = pair_i[pair]
    j = pair_j[pair]
    ratio = cones.ratio[world % cones.ratio.shape[0]]
    total = float(0.0)
    for index in range(sliding.count[world]):
        row = sliding.row[world, index]
        total += curvature(world, row, rows.contact[world, row], i, j, ratio, rows, cones)
    hessian[world, i, j] += total


@wp.kernel
def finish_by_step(
    tolerance: wp.array(dtype=float),
    iterations: int,
    scale: wp.array(dtype=float),
    gradient_squared: wp.array(dtype=float),
    improvement: wp.array(dtype=float),
    alpha: wp.array(dtype=float),
    count: wp.array(dtype=int),
    flags: wp.array(dtype=int),
    sliding: wp.array(dtype=int),
    unsolved: wp.array(dtype=int),
    done: wp.array(dtype=bool),
) -> None:
    """Worlds in which the last step, or the gradient after it, says that no further one is needed."""
    world = wp.tid()
    sliding[world] = 0
    if done[world]:
        return
    count[world] += 1
    enough = tolerance[world % tolerance.shape[0]]
    gained = scale[world] * improvement[world]
    gradient = scale[world] * wp.sqrt(gradient_squared[world])
    solved = alpha[world] == 0.0 or (gained > 0.0 and gained < enough) or gradient < enough
    if solved or count[world] == iterations:
        if not solved:
            flags[world] = flags[world] | TOO_FEW_ITERATIONS
        done[world] = True
        wp.atomic_add(unsolved, 0, -1)


@wp.kernel
def finish_by_model(
    tolerance: wp.array(dtype=float),
    scale: wp.array(dtype=float),
    decrement: wp.array(dtype=float),
    unsolved: wp.array(dtype=int),
    done: wp.array(dtype=bool),
) -> None:
    """Worlds in which the next step would gain next to nothing."""
    world = wp.tid()
    if not done[world] and scale[world] * 0.5 * decrement[world] < tolerance[world % tolerance.shape[0]]:
        done[world] = True
        wp.atomic_add(unsolved, 0, -1)
