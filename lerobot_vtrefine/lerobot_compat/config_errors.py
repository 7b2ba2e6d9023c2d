"""Why a configuration refuses its values: the last line of LeRobot's own commands, the only one of ours."""

import contextlib
import functools
from collections.abc import Callable, Generator

from draccus.utils import ParsingError

from lerobot_vtrefine.extras import MissingExtraError


def told_by_lerobot[Config](check: Callable[[Config], None]) -> Callable[[Config], None]:
    """Decorate ``__post_init__``: its refusal becomes a ParsingError with the same words.

    LeRobot's parser replaces a ValueError by "Couldn't instantiate class ...", which hides the reason.
    """

    @functools.wraps(check)
    def wrapper(config: Config) -> None:
        try:
            check(config)
        except (ValueError, MissingExtraError) as error:
            raise ParsingError(str(error)) from error

    return wrapper


@contextlib.contextmanager
def undecoded_values_raise() -> Generator[None]:
    """draccus' DecodingError passes through LeRobot's parser, which prints several lines of it and leaves."""
    from lerobot.configs import parser

    stock = parser.DecodingError
    parser.DecodingError = ()  # ty: ignore[invalid-assignment]
    try:
        yield
    finally:
        parser.DecodingError = stock
