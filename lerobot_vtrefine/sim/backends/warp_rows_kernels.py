"""Constraint rows as functions of the accelerations: forces, cost along a line, curvature. Imports warp.

MuJoCo's cost of a row with residual r and stiffness D: an equality D/2 r^2, a limit the same where r < 0, dry
friction the same as far as its force is below the loss, and linear beyond. A contact with friction has one
cost for all of its rows: with n = mu r_0 and t = |f_k r_k| nothing where n >= mu t, D_k/2 r_k^2 summed where
mu n + t <= 0, and s/2 (n - mu t)^2 between (it slides), s = D_0 / (mu^2 (1 + mu^2)).

Shape legend: N worlds, C contacts, nv velocities.
"""

import warp as wp
from mujoco_warp._src.types import ConstraintState, ConstraintType

wp.set_module_options({"enable_backward": False})

ELLIPTIC = wp.constant(int(ConstraintType.CONTACT_ELLIPTIC))
FREE = wp.constant(int(ConstraintState.SATISFIED))
QUADRATIC = wp.constant(int(ConstraintState.QUADRATIC))
LINEAR_NEGATIVE = wp.constant(int(ConstraintState.LINEARNEG))
LINEAR_POSITIVE = wp.constant(int(ConstraintState.LINEARPOS))
SLIDING = wp.constant(int(ConstraintState.CONE))
EQUALITY = wp.constant(0)
DRY = wp.constant(1)
LIMIT = wp.constant(2)
CONE = wp.constant(3)
NOTHING = wp.constant(4)
"""What a cost along a line can be; the last is a contact whose rows had no room."""
TINY = wp.constant(1.0e-15)


@wp.struct
class Rows:
    """Constraint rows of N worlds, as mujoco_warp keeps them, (N, rows) each, and what the solver adds."""

    equalities: wp.array(dtype=int)
    """(N,): they come first, then dry friction, limits and contacts."""
    frictions: wp.array(dtype=int)
    count: wp.array(dtype=int)
    kind: wp.array(dtype=int, ndim=2)
    contact: wp.array(dtype=int, ndim=2)
    stiffness: wp.array(dtype=float, ndim=2)
    loss: wp.array(dtype=float, ndim=2)
    target: wp.array(dtype=float, ndim=2)
    jacobian: wp.array(dtype=float, ndim=3)
    quads: wp.array(dtype=wp.vec4, ndim=3)
    """The same Jacobian, four neighbours at a time."""
    force: wp.array(dtype=float, ndim=2)
    state: wp.array(dtype=int, ndim=2)
    residual: wp.array(dtype=float, ndim=2)
    slope: wp.array(dtype=float, ndim=2)
    """Change of the residual along the search direction."""
    lone: wp.array(dtype=int, ndim=2)
    """Rows with a cost of their own: all but those of a contact after its first."""
    lones: wp.array(dtype=int)
    """(N,) how many."""
    line: wp.array(dtype=wp.vec4, ndim=3)
    """(N, rows, 3) what the costs of lone rows along the search direction depend on."""


@wp.struct
class Cones:
    """Contacts (C,): which rows each has, one after the other, its friction, and the solver's ratio of the
    impedances.
    """

    row: wp.array(dtype=int, ndim=2)
    dim: wp.array(dtype=int)
    friction: wp.array(dtype=float, ndim=2)
    ratio: wp.array(dtype=float)


@wp.func
def is_whole(contact: int, row: int, cones: Cones) -> bool:
    """Whether `row` is the first of a contact's rows and the buffer had room for all of them."""
    return cones.row[contact, 0] == row and cones.row[contact, cones.dim[contact] - 1] >= 0


@wp.func
def mu_of(world: int, contact: int, cones: Cones) -> float:
    """Friction that the solver's cone has once it is made circular."""
    return cones.friction[contact, 0] * cones.ratio[world % cones.ratio.shape[0]]


@wp.func
def set_row(world: int, row: int, force: float, state: int, rows: Rows) -> None:
    """Write one row."""
    rows.force[world, row] = force
    rows.state[world, row] = state


@wp.func
def push_cone(world: int, row: int, contact: int, rows: Rows, cones: Cones) -> None:
    """Forces of a contact's rows."""
    dim = cones.dim[contact]
    mu = mu_of(world, contact, cones)
    n = mu * rows.residual[world, row]
    square = float(0.0)
    for k in range(1, dim):
        u = cones.friction[contact, k - 1] * rows.residual[world, row + k]
        square += u * u
    t = wp.sqrt(square)
    state = zone(n, t, mu)
    pull = float(0.0)
    if state == SLIDING:
        pull = rows.stiffness[world, row] / wp.max(mu * mu * (1.0 + mu * mu), TINY) * mu * (mu * t - n)
    for k in range(dim):
        other = row + k
        residual = rows.residual[world, other]
        force = float(0.0)
        if state == QUADRATIC:
            force = -rows.stiffness[world, other] * residual
        elif state == SLIDING and k == 0:
            force = pull
        elif state == SLIDING:
            friction = cones.friction[contact, k - 1]
            share = friction * friction * residual / t
            force = -pull * share
        set_row(world, other, force, state, rows)


@wp.func
def is_lone(world: int, row: int, rows: Rows, cones: Cones) -> bool:
    """Whether a row has a cost of its own, or stands for those of a whole contact."""
    if rows.kind[world, row] != ELLIPTIC:
        return True
    return is_whole(rows.contact[world, row], row, cones)


@wp.func
def push(world: int, row: int, rows: Rows, cones: Cones) -> None:
    """Force and state of a row; of a whole contact where it is the first of one."""
    if rows.kind[world, row] == ELLIPTIC:
        contact = rows.contact[world, row]
        if is_whole(contact, row, cones):
            push_cone(world, row, contact, rows, cones)
        return
    residual = rows.residual[world, row]
    force = -rows.stiffness[world, row] * residual
    state = int(QUADRATIC)
    equalities = rows.equalities[world]
    if row >= equalities:
        if row < equalities + rows.frictions[world]:
            loss = rows.loss[world, row]
            if force >= loss:
                force = loss
                state = LINEAR_NEGATIVE
            elif force <= -loss:
                force = -loss
                state = LINEAR_POSITIVE
        elif residual >= 0.0:
            force = 0.0
            state = FREE
    set_row(world, row, force, state, rows)


@wp.func
def quadratic(stiffness: float, residual: float, slope: float, step: float) -> wp.vec3:
    """D/2 r^2 along a line: its change, and its first two derivatives."""
    rate = stiffness * slope
    return wp.vec3(
        rate * step * (residual + 0.5 * step * slope), rate * (residual + step * slope), rate * slope
    )


@wp.func
def dry(stiffness: float, loss: float, residual: float, slope: float, step: float) -> wp.vec3:
    """Dry friction along a line: change of the cost, first two derivatives."""
    edge = loss / wp.max(stiffness, TINY)
    after = residual + step * slope
    if wp.abs(residual) < edge and wp.abs(after) < edge:
        return quadratic(stiffness, residual, slope, step)
    if residual <= -edge and after <= -edge:
        return wp.vec3(-loss * step * slope, -loss * slope, 0.0)
    if residual >= edge and after >= edge:
        return wp.vec3(loss * step * slope, loss * slope, 0.0)
    change = huber(stiffness, loss, edge, after) - huber(stiffness, loss, edge, residual)
    if wp.abs(after) < edge:
        return wp.vec3(change, stiffness * after * slope, stiffness * slope * slope)
    return wp.vec3(change, wp.where(after > 0.0, loss, -loss) * slope, 0.0)


@wp.func
def huber(stiffness: float, loss: float, edge: float, residual: float) -> float:
    """Cost of dry friction."""
    if wp.abs(residual) < edge:
        return 0.5 * stiffness * residual * residual
    return loss * (wp.abs(residual) - 0.5 * edge)


@wp.func
def limit(stiffness: float, residual: float, slope: float, step: float) -> wp.vec3:
    """A limit along a line: change of the cost, first two derivatives."""
    after = residual + step * slope
    if residual < 0.0 and after < 0.0:
        return quadratic(stiffness, residual, slope, step)
    if after < 0.0:
        return wp.vec3(0.5 * stiffness * after * after, stiffness * after * slope, stiffness * slope * slope)
    if residual < 0.0:
        return wp.vec3(-0.5 * stiffness * residual * residual, 0.0, 0.0)
    return wp.vec3(0.0)


@wp.func
def slide(world: int, row: int, contact: int, rows: Rows, cones: Cones) -> wp.vec4:
    """A contact's tangential residuals u and their slopes w: |u|, u along w, u across w, |w|."""
    uu = float(0.0)
    uw = float(0.0)
    ww = float(0.0)
    for k in range(1, cones.dim[contact]):
        other = row + k
        u = cones.friction[contact, k - 1] * rows.residual[world, other]
        w = cones.friction[contact, k - 1] * rows.slope[world, other]
        uu += u * u
        uw += u * w
        ww += w * w
    speed = wp.sqrt(ww)
    along = uw / wp.max(speed, TINY)
    across = float(0.0)
    for k in range(1, cones.dim[contact]):
        other = row + k
        u = cones.friction[contact, k - 1] * rows.residual[world, other]
        w = cones.friction[contact, k - 1] * rows.slope[world, other]
        rest = u - along * w / wp.max(speed, TINY)
        across += rest * rest
    return wp.vec4(wp.sqrt(uu), along, wp.sqrt(across), speed)


@wp.func
def cone(step: float, first: wp.vec4, second: wp.vec4, third: wp.vec4) -> wp.vec3:
    """A contact along a line, as `lay_cone` laid it out: change of the cost, first two derivatives.

    The tangential residual's length t is put together from its parts along and across the line, which keeps
    the digits that u.u + 2 a u.w + a^2 w.w loses.
    """
    normal = first[1]
    normal_slope = first[2]
    scale = first[3]
    mu = second[0]
    whole = second[3]
    before = third[0]
    along = third[1]
    across = third[2]
    speed = third[3]
    reached = along + step * speed
    t = wp.sqrt(across + reached * reached)
    n = mu * (normal + step * normal_slope)
    zone_before = zone(mu * normal, before, mu)
    zone_after = zone(n, t, mu)
    gap_before = mu * (normal - before)
    gap = n - mu * t
    cost_before = wp.where(zone_before == SLIDING, 0.5 * scale * gap_before * gap_before, 0.0)
    if zone_before == QUADRATIC:
        cost_before = 0.5 * whole
    if zone_after == FREE:
        return wp.vec3(-cost_before, 0.0, 0.0)
    if zone_after == QUADRATIC:
        rise = wp.where(zone_before == QUADRATIC, 0.0, 0.5 * whole - cost_before)
        change = step * (second[1] + 0.5 * step * second[2])
        return wp.vec3(rise + change, second[1] + step * second[2], second[2])
    turn = speed * reached / wp.max(t, TINY)
    bend = speed * speed * (across / wp.max(t * t, TINY * TINY)) / wp.max(t, TINY)
    rate = mu * (normal_slope - turn)
    change = 0.5 * scale * gap * gap - cost_before
    if zone_before == SLIDING:
        longer = step * speed * (along + reached) / wp.max(t + before, TINY)
        change = 0.5 * scale * mu * (step * normal_slope - longer) * (gap + gap_before)
    return wp.vec3(change, scale * gap * rate, scale * (rate * rate - gap * mu * bend))


@wp.func
def zone(n: float, t: float, mu: float) -> int:
    """What a contact does at normal and tangential residual n and t."""
    if n >= mu * t:
        return FREE
    if mu * n + t <= 0.0:
        return QUADRATIC
    return SLIDING


@wp.func
def lay(world: int, place: int, rows: Rows, cones: Cones) -> None:
    """Write down what a lone row's cost along the search direction depends on, to be read at every step."""
    row = rows.lone[world, place]
    code = int(EQUALITY)
    equalities = rows.equalities[world]
    if rows.kind[world, row] == ELLIPTIC:
        contact = rows.contact[world, row]
        if is_whole(contact, row, cones):
            lay_cone(world, place, row, contact, rows, cones)
            return
        code = NOTHING
    elif row >= equalities + rows.frictions[world]:
        code = LIMIT
    elif row >= equalities:
        code = DRY
    stiffness = rows.stiffness[world, row]
    rows.line[world, place, 0] = wp.vec4(
        float(code), rows.residual[world, row], rows.slope[world, row], stiffness
    )
    rows.line[world, place, 1] = wp.vec4(rows.loss[world, row], 0.0, 0.0, 0.0)


@wp.func
def lay_cone(world: int, place: int, row: int, contact: int, rows: Rows, cones: Cones) -> None:
    """The same of a whole contact: residual, slope and scale of its normal; friction, and D r r', D r' r' and
    D r r summed over its rows; |u|, u along w, the square of u across w, |w| of `slide`.
    """
    mu = mu_of(world, contact, cones)
    rate = float(0.0)
    curve = float(0.0)
    whole = float(0.0)
    for k in range(cones.dim[contact]):
        residual = rows.residual[world, row + k]
        slope = rows.slope[world, row + k]
        stiffness = rows.stiffness[world, row + k]
        rate += stiffness * residual * slope
        curve += stiffness * slope * slope
        whole += stiffness * residual * residual
    scale = rows.stiffness[world, row] / wp.max(mu * mu * (1.0 + mu * mu), TINY)
    rows.line[world, place, 0] = wp.vec4(
        float(CONE), rows.residual[world, row], rows.slope[world, row], scale
    )
    rows.line[world, place, 1] = wp.vec4(mu, rate, curve, whole)
    parts = slide(world, row, contact, rows, cones)
    rows.line[world, place, 2] = wp.vec4(parts[0], parts[1], parts[2] * parts[2], parts[3])


@wp.func
def along_line(world: int, place: int, step: float, rows: Rows) -> wp.vec3:
    """A lone row's cost along the search direction, once it is laid out: change since step 0, first two
    derivatives; of a whole contact where it is the first of one.
    """
    first = rows.line[world, place, 0]
    second = rows.line[world, place, 1]
    code = int(first[0])
    if code == CONE:
        return cone(step, first, second, rows.line[world, place, 2])
    if code == EQUALITY:
        return quadratic(first[3], first[1], first[2], step)
    if code == DRY:
        return dry(first[3], second[0], first[1], first[2], step)
    if code == LIMIT:
        return limit(first[3], first[1], first[2], step)
    return wp.vec3(0.0)


@wp.func
def bent(world: int, row: int, quad: int, rows: Rows, cones: Cones) -> wp.vec4:
    """Four neighbours of a vector b: the Hessian of the cost is the sum of b b' over all rows."""
    state = rows.state[world, row]
    if state == QUADRATIC:
        return wp.sqrt(rows.stiffness[world, row]) * rows.quads[world, row, quad]
    if state == SLIDING:
        contact = rows.contact[world, row]
        first = cones.row[contact, 0]
        if is_whole(contact, first, cones):
            return bent_cone(world, row - first, first, contact, quad, rows, cones)
    return wp.vec4(0.0)


@wp.func
def bent_cone(world: int, k: int, first: int, contact: int, quad: int, rows: Rows, cones: Cones) -> wp.vec4:
    """The same of row k of a sliding contact, whose rows share a cost.

    With z = dn, u_k = f_k r_k, v_k of the Jacobian's rows alike, and p = sum of u_k v_k / t, its Hessian is
    s ((z - mu p)(z - mu p)' + (mu^2 - mu n / t) (sum of v_k v_k' - p p')). The last bracket is a sum over
    directions across u: a reflection that takes u to the first axis gives one fewer than there are u_k, so
    that row 1 has none.
    """
    if k == 1:
        return wp.vec4(0.0)
    mu = mu_of(world, contact, cones)
    scale = rows.stiffness[world, first] / wp.max(mu * mu * (1.0 + mu * mu), TINY)
    square = float(0.0)
    p = wp.vec4(0.0)
    for other in range(1, cones.dim[contact]):
        friction = cones.friction[contact, other - 1]
        u = friction * rows.residual[world, first + other]
        square += u * u
        p += (u * friction) * rows.quads[world, first + other, quad]
    t = wp.max(wp.sqrt(square), TINY)
    p = p / t
    if k == 0:
        return (wp.sqrt(scale) * mu) * (rows.quads[world, first, quad] - p)
    normal = mu * mu * wp.max(0.0, 1.0 - rows.residual[world, first] / t)
    lead = cones.friction[contact, 0] * rows.residual[world, first + 1] / t
    aside = (
        p
        + (wp.where(lead < 0.0, -1.0, 1.0) * cones.friction[contact, 0]) * rows.quads[world, first + 1, quad]
    )
    friction = cones.friction[contact, k - 1]
    own = friction * rows.residual[world, first + k] / t
    v = friction * rows.quads[world, first + k, quad]
    return wp.sqrt(scale * normal) * (v - (own / (1.0 + wp.abs(lead))) * aside)
