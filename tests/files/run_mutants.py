"""Counts and endings as text: ``python tests/files/run_mutants.py FOLDER [PER_SHARE] [KIND ...]``."""

import sys
import tempfile
from pathlib import Path

from mutant_kinds import KINDS
from test_mutants import THOROUGH, attempts, report


def main() -> None:
    out, per_share, names = Path(sys.argv[1]), int((sys.argv[2:3] or [THOROUGH])[0]), sys.argv[3:]
    out.mkdir(parents=True, exist_ok=True)
    for kind in KINDS:
        if names and kind.name not in names:
            continue
        with tempfile.TemporaryDirectory() as folder:
            found = attempts(kind, Path(folder), per_share * kind.share)
        print(report(kind, found), flush=True)
        rows = [
            f"{end.ending}\t{damage}\t{' | '.join(end.text.splitlines()[-2:])[:300]}" for damage, end in found
        ]
        (out / f"{kind.name}.tsv").write_text("\n".join(sorted(rows)) + "\n", errors="backslashreplace")


if __name__ == "__main__":
    main()
