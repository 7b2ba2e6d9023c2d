"""Success in simulation as VT-Refine reports it (Huang et al., CoRL 2025), to stand beside our own.

Of its two tables in simulation, on the table-top robot: one policy a number, how many episodes is not said.
"""

from typing import Final

from lerobot_vtrefine.cli.results.rows import IMITATION, SCRATCH, TUNED

KINDS: Final = {
    IMITATION: IMITATION,
    SCRATCH: "DPPO without pre-training",
    TUNED: "DPPO after imitation",
}

DEMONSTRATIONS = 30
"""Behind every policy of `PAIRS`."""
PAIRS: Final[dict[str, dict[str, dict[str, float]]]] = {
    "automate/00081": {
        "visual": {IMITATION: 0.28, SCRATCH: 0.0, TUNED: 0.57},
        "visuo_tactile": {IMITATION: 0.45, SCRATCH: 0.0, TUNED: 0.82},
    },
    "automate/00186": {
        "visual": {IMITATION: 0.32, SCRATCH: 0.0, TUNED: 0.72},
        "visuo_tactile": {IMITATION: 0.48, SCRATCH: 0.0, TUNED: 0.94},
    },
    "automate/00007": {
        "visual": {IMITATION: 0.42, SCRATCH: 0.0, TUNED: 0.84},
        "visuo_tactile": {IMITATION: 0.54, SCRATCH: 0.0, TUNED: 0.98},
    },
    "automate/00446": {
        "visual": {IMITATION: 0.12, SCRATCH: 0.0, TUNED: 0.36},
        "visuo_tactile": {IMITATION: 0.34, SCRATCH: 0.0, TUNED: 0.76},
    },
    "automate/00581": {
        "visual": {IMITATION: 0.18, SCRATCH: 0.0, TUNED: 0.52},
        "visuo_tactile": {IMITATION: 0.31, SCRATCH: 0.0, TUNED: 0.78},
    },
}
"""By pair, senses and variant."""
BY_DEMONSTRATIONS: Final[dict[int, dict[str, dict[str, float]]]] = {
    10: {
        "visual": {IMITATION: 0.08, TUNED: 0.21},
        "visuo_tactile": {IMITATION: 0.02, TUNED: 0.34},
    },
    30: {
        "visual": {IMITATION: 0.40, TUNED: 0.65},
        "visuo_tactile": {IMITATION: 0.48, TUNED: 0.94},
    },
    50: {
        "visual": {IMITATION: 0.37, TUNED: 0.67},
        "visuo_tactile": {IMITATION: 0.57, TUNED: 0.92},
    },
}
"""By number of demonstrations, on one pair, which is not named."""


def with_demonstrations(count: int, variant: str) -> str:
    """The variant of a row of the table by number of demonstrations."""
    return ", ".join(filter(None, (f"{count} demonstrations", variant)))
