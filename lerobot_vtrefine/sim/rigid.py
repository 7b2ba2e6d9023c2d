"""What is rigid is as stiff in a long physics step as in a short one.

MuJoCo's contacts are springs with a time constant tau and an impedance d. The time constant may not be below
two physics steps, which alone would make contacts softer the longer the step. At rest a contact of effective
mass m that bears F is F (1 - d) tau^2 / m deep, where d is close to 1 (MuJoCo's documentation, "Computation",
solver parameters): a larger d makes up for a longer tau.
"""

_TOUCH, _DEEP = 0.9, 0.95
"""MuJoCo's default impedance at the touch, and from `_WIDTH_M` on."""
_WIDTH_M, _MIDPOINT, _POWER = 0.001, 0.5, 2.0


def rigid_contact(time_constant_s: float, timestep_s: float) -> tuple[list[float], list[float]]:
    """MuJoCo's solref and solimp in steps of `timestep_s`, as stiff as its default impedance with a time
    constant [s].
    """
    allowed_s = max(time_constant_s, 2 * timestep_s)
    softer = (time_constant_s / allowed_s) ** 2
    impedance = [1.0 - softer * (1.0 - d) for d in (_TOUCH, _DEEP)]
    return [allowed_s, 1.0], [*impedance, _WIDTH_M, _MIDPOINT, _POWER]
