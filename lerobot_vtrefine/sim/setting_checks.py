"""What numbers of settings must satisfy, told in one line that names the setting."""

import math
from collections.abc import Collection
from dataclasses import fields
from typing import Any


def check_numbers(
    config: Any,
    prefix: str = "",
    above_0: Collection[str] = (),
    not_below_0: Collection[str] = (),
    may_be_infinite: Collection[str] = (),
) -> None:
    """Check the numbers of a dataclass, also those within tuples; what is None or no number is left alone.

    Args:
        config: the settings.
        prefix: goes before a field's name in messages, such as ``"limits."``.
        above_0: fields whose numbers must be above 0.
        not_below_0: fields whose numbers must not be negative.
        may_be_infinite: fields that may be ``inf``, which switches a limit off.

    Raises:
        ValueError: a number is NaN, infinite or of the wrong sign.
    """
    for item in fields(config):
        value = getattr(config, item.name)
        name = prefix + item.name
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            if math.isnan(number) or (math.isinf(number) and item.name not in may_be_infinite):
                raise ValueError(f"{name} must be a finite number, got {value}")
            if item.name in above_0 and not number > 0.0:
                raise ValueError(f"{name} must be above 0, got {value}")
            if item.name in not_below_0 and number < 0.0:
                raise ValueError(f"{name} must not be negative, got {value}")
