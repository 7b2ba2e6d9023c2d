"""Why a configuration refuses its values, as the last line of LeRobot's own commands, too."""

import functools
from collections.abc import Callable

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
