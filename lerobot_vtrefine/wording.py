"""Words that depend on numbers."""


def plural(count: int, noun: str) -> str:
    """ "1 frame", "2 frames", "2 processes"."""
    ending = "" if count == 1 else "es" if noun.endswith(("s", "x", "ch")) else "s"
    return f"{count} {noun}{ending}"
