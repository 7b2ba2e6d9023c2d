"""Files and flags that are not what they should be end in one line and a status: seeded, by the thousand."""

import os
import random
import shutil
from collections import Counter
from pathlib import Path

import pytest
from mutant_kind import Kind
from mutant_kinds import KINDS
from mutant_runner import Outcome, run_limited

QUICK = 3
"""Mutants per share of a kind in the default suite; the slow test runs ten times as many."""
THOROUGH = 34


def attempts(kind: Kind, folder: Path, count: int) -> list[tuple[str, Outcome]]:
    """What was done to a kind's file, and how its command ended, for `count` mutants."""
    if kind.prepare is not None:
        kind.prepare()
    sound = folder / "sound"
    sound.mkdir()
    if kind.sound is not None:
        kind.sound(sound)
    found = []
    for number in range(count):
        mutant = folder / f"mutant_{number}"
        shutil.copytree(sound, mutant)
        damage = kind.mutate(mutant, random.Random(f"{kind.name} {number}"))

        def action(mutant: Path = mutant) -> int | None:
            os.chdir(mutant)
            return kind.command(mutant)

        found.append((damage, run_limited(action, mutant)))
        shutil.rmtree(mutant)
    return found


def report(kind: Kind, found: list[tuple[str, Outcome]]) -> str:
    counts = Counter(outcome.ending for _, outcome in found)
    worst = max(outcome.grown_bytes for _, outcome in found) / 2**20
    slowest = max(outcome.seconds for _, outcome in found)
    ends = ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
    return f"{kind.name}: {len(found)} tried, {ends}; {slowest:.1f} s, {worst:.0f} MB"


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.sound], ids=lambda kind: kind.name)
def test_the_sound_file_is_accepted(kind: Kind, tmp_path: Path) -> None:
    assert kind.sound is not None
    kind.sound(tmp_path)
    outcome = run_limited(lambda: kind.command(tmp_path), tmp_path, 60)
    assert outcome.ending == "accepted", outcome.text


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_mutants_end_in_one_line(kind: Kind, tmp_path: Path) -> None:
    found = attempts(kind, tmp_path, QUICK * kind.share)
    assert [(damage, end.ending, end.text) for damage, end in found if not end.sound] == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_many_mutants_end_in_one_line(kind: Kind, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = attempts(kind, tmp_path, THOROUGH * kind.share)
    with capsys.disabled():
        print(f"\n{report(kind, found)}")
    assert [(damage, end.ending, end.text) for damage, end in found if not end.sound] == []
