"""One check, and one line, for values that must come from a list, for network ports and for seeds."""

from collections.abc import Iterable
from difflib import get_close_matches

LARGEST_PORT = 65535
LARGEST_SEED = 2**53 - 1
"""Seeds are counted up in arrays of 64 bits, and noted in JSON, whose whole numbers are exact up to here."""


def check_choice(name: str, value: object, choices: Iterable[str], others: str = "") -> None:
    """Raise ValueError with the choices unless ``value`` is one of them.

    ``name`` is what a user calls the setting, such as ``--view``; ``others`` says what else may be given.
    """
    known = list(choices)
    if value not in known:
        raise ValueError(f"{name}={str(value)[:60]} is unknown; choose from {', '.join(known)}{others}")


def did_you_mean(value: str, known: Iterable[str]) -> str:
    """The end of a message about a name that is not known; empty where none is like it."""
    return "".join(f"; did you mean {name}?" for name in get_close_matches(value, list(known), 1))


def check_port(name: str, port: int) -> None:
    """Raise ValueError unless a network port has this number."""
    if not 1 <= port <= LARGEST_PORT:
        raise ValueError(f"{name} must lie between 1 and {LARGEST_PORT}, got {port}")


def check_seed(name: str, seed: int) -> None:
    """Raise ValueError unless episodes can be counted up from this seed."""
    if not 0 <= seed <= LARGEST_SEED:
        raise ValueError(f"{name} must lie between 0 and {LARGEST_SEED}, got {seed}")
