"""Numbers for people: three digits, and millimetres or milliseconds where SI units are unwieldy."""

from collections.abc import Sequence
from typing import Any

from lerobot_vtrefine.pages.charts import digits

SCALES = {
    "m": ((1e3, "mm"), (1e6, "µm")),
    "m/s": ((1e3, "mm/s"),),
    "s": ((1.0, "s"), (1e3, "ms")),
    "rad": ((1e3, "mrad"),),
    "rad/s": ((1.0, "rad/s"), (1e3, "mrad/s")),
    "counts/s": ((1.0, "counts/s"), (60.0, "counts/min")),
    "m/N": ((1e3, "mm/N"),),
    "Nm": ((1.0, "N·m"),),
    "N*m": ((1.0, "N·m"),),
    "N*s/m": ((1.0, "N·s/m"),),
    "N*m/rad": ((1.0, "N·m/rad"),),
    "N*m*s/rad": ((1.0, "N·m·s/rad"),),
    "1": ((1.0, ""),),
}
"""Unit -> factors and names to choose from, the first one that makes the number at least 0.1."""


def scale_of(size: float, unit: str) -> tuple[float, str]:
    """Factor and name of the unit in which a number of this size is easy to read."""
    options = SCALES.get(unit, ((1.0, unit),))
    for factor, name in options:
        if abs(size) * factor >= 0.1:
            return factor, name
    return options[0] if size == 0 else options[-1]


def quantity(value: float, unit: str) -> str:
    """For example "2.3 mm"."""
    factor, name = scale_of(value, unit)
    return f"{digits(value * factor)} {name}".strip()


def interval(value: float, ci95: Sequence[float] | None, unit: str) -> tuple[str, str]:
    """A value and its interval in one common unit, for example ("50 ms", "45 to 56 ms")."""
    factor, name = scale_of(value, unit)
    low_high = (
        "" if ci95 is None else f"{digits(ci95[0] * factor)} to {digits(ci95[1] * factor)} {name}".strip()
    )
    return f"{digits(value * factor)} {name}".strip(), low_high


def percent(part: float) -> str:
    """For example "66 %"; one digit more below ten."""
    number = round(100.0 * part, 1) + 0.0  # no minus before a zero
    text = f"{number:.1f}" if abs(number) < 10 else f"{number:.0f}"
    return text.replace("-", "−") + " %"


def p_text(value: float | None) -> str:
    """A p-value with its significant digits."""
    if value is None:
        return "–"
    return "< 0.0001" if value < 1e-4 else f"{value:.2g}"


def nested(value: Any) -> str:
    """Lists of numbers in brackets, for example "(0, 1), (3, 4)"."""
    if isinstance(value, (list, tuple)):
        inner = [nested(item) for item in value]
        deep = any(isinstance(item, (list, tuple)) for item in value)
        return ", ".join(inner) if deep else f"({', '.join(inner)})"
    return digits(float(value)) if isinstance(value, (int, float)) else str(value)
