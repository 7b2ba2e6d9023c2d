"""The LeRobot versions whose internals this package may extend: every seam asks here."""

from importlib.metadata import version

FIRST_SUPPORTED = (0, 6, 1)
FIRST_UNSUPPORTED = (0, 7)


def lerobot_version() -> tuple[int, ...]:
    """Leading numbers of the installed LeRobot version, such as (0, 6, 1)."""
    numbers = []
    for part in version("lerobot").split("."):
        if not part.isdigit():
            break
        numbers.append(int(part))
    return tuple(numbers)


def is_supported() -> bool:
    """Whether the installed LeRobot is one that the seams were tested with."""
    return FIRST_SUPPORTED <= lerobot_version() < FIRST_UNSUPPORTED
