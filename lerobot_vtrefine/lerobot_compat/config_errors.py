"""Why a configuration refuses its values: the last line of LeRobot's own commands, the only one of ours."""

import contextlib
import functools
from collections.abc import Callable, Generator, Sequence
from typing import Any

from draccus.parsers import decoding
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


def install() -> None:
    """Let the parser tell why a dataclass of this package refuses its values, also deep in a configuration.

    These raise ValueError and know nothing of LeRobot: the simulation works without it. Idempotent.
    """
    if decoding.decode_dataclass is not _decode_telling:
        decoding.decode_dataclass = _decode_telling  # ty: ignore[invalid-assignment]
        decoding.get_decoding_fn.cache_clear()  # it holds the function of before


_decode_stock = decoding.decode_dataclass


def _decode_telling[Config](kind: type[Config], values: Any, path: Sequence[str] = ()) -> Config:
    try:
        return _decode_stock(kind, values, path)
    except ParsingError as error:
        ours = getattr(kind, "__module__", "").startswith(__name__.partition(".")[0])
        if ours and isinstance(error.__cause__, ValueError) and "Couldn't instantiate class" in str(error):
            raise ParsingError(str(error.__cause__)) from error.__cause__
        raise


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
