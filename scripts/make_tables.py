"""Write every table of results/*.json into the blocks ``<!-- table: NAME -->`` of README.md and docs/.

python scripts/make_tables.py
"""

from pathlib import Path

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.rows import read_all
from lerobot_vtrefine.cli.results.tables import fill

ROOT = Path(__file__).parents[1]


def documents() -> list[Path]:
    """The files that may hold tables."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@run_cli
def main() -> None:
    """Rewrite what changed."""
    CommandParser(description=__doc__).parse_args()
    rows = read_all(ROOT / "results")
    for path in documents():
        old = path.read_text(encoding="utf-8")
        new = fill(old, rows)
        if new != old:
            path.write_text(new, encoding="utf-8")
            print(f"{path.relative_to(ROOT)} rewritten")


if __name__ == "__main__":
    raise SystemExit(main())
