"""An argument parser whose errors are one line, as those of every other command."""

import argparse
from typing import NoReturn, override


class OneLineParser(argparse.ArgumentParser):
    """Raises ValueError where argparse would print its usage and leave; flags must be spelt out."""

    def __init__(self, prog: str, description: str, epilog: str) -> None:
        super().__init__(
            prog=prog,
            description=description,
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )

    @override
    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see {self.prog} --help")
