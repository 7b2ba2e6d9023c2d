"""Where pictures go, and their colours."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "img"
BLUE, ORANGE, GREY = "#2f6fb2", "#d9762b", "#8a8f98"
