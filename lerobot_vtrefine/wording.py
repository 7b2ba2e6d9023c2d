"""Words that depend on numbers, and what several commands tell alike."""

from pathlib import Path


def plural(count: int, noun: str) -> str:
    """ "1 frame", "2 frames", "2 processes"."""
    ending = "" if count == 1 else "es" if noun.endswith(("s", "x", "ch")) else "s"
    return f"{count} {noun}{ending}"


def full_disk(root: Path, episodes: int, advice: str) -> str:
    """What a recording tells that finds no more room; ``advice`` is what to do once there is some."""
    return f"the disk is full: {root} keeps {plural(episodes, 'episode')}; free some space and {advice}"
