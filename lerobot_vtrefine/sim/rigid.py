"""What is rigid is as stiff in a long physics step as in a short one.

MuJoCo's contacts are springs with a time constant tau and an impedance d. The time constant may not be below two
physics steps, which would make contacts softer the longer the step. At rest a contact of effective mass m bears
F at a depth of F (1 - d) tau^2 / m, nearly (MuJoCo's documentation, "Computation", solver parameters; where d is
close to 1): a larger d makes up for a longer tau.
"""

_SOFTEST, _STIFFEST = 0.1, 0.05
"""1 - d of MuJoCo's default impedance, at the touch and from `_WIDTH_M` on."""
_WIDTH_M, _MIDPOINT, _POWER = 0.001, 0.5, 2.0


def rigid_contact(time_constant_s: float, timestep_s: float) -> tuple[list[float], list[float]]:
    """MuJoCo's solref and solimp for a time constant [s] of its default impedance, in steps of `timestep_s`."""
    allowed = max(time_constant_s, 2 * timestep_s)
    softness = (time_constant_s / allowed) ** 2
    impedance = [1.0 - softness * _SOFTEST, 1.0 - softness * _STIFFEST, _WIDTH_M, _MIDPOINT, _POWER]
    return [allowed, 1.0], impedance
