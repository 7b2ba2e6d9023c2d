"""``scripts/soak_worlds.py`` goes on where its rows end, and tells what failed."""

import json
from collections import Counter

import pytest
import soak_worlds as script

COMBINATIONS = 2 * 2


@pytest.fixture
def soak(tmp_path, monkeypatch):
    """Runs the script with players that yield ten control steps at a time; returns status, rows and sums."""
    rows = tmp_path / "rows.jsonl"
    seeds = []

    def run(capsys, *flags, news=None):
        def player(_, *rest):
            seeds.append(rest[-1])
            while True:
                yield Counter(control_steps=10, **(news or {}))
                if news == {}:
                    raise RuntimeError("no room")

        practice = type("Practice", (), {"env": type("Env", (), {"episodes": None})})
        monkeypatch.setattr(script, "prepare", lambda *_: practice)
        monkeypatch.setattr(script, "play", player)
        monkeypatch.setattr(script, "play_policy", player)
        flags = ["--pairs=round,key", "--starts=grasped", f"--rows={rows}", *flags]
        monkeypatch.setattr("sys.argv", ["soak_worlds.py", *flags])
        status = script.main()
        lines = [json.loads(line) for line in rows.read_text().splitlines()] if rows.is_file() else []
        return status, lines, json.loads(capsys.readouterr().out)

    run.seeds = seeds
    return run


def test_every_pair_and_kind_gets_its_share_and_a_second_call_only_what_is_missing(soak, capsys):
    status, rows, sums = soak(capsys, "--control_steps=40")
    assert status == 0
    assert [(row["pair"], row["actions"], row["control_steps"]) for row in rows] == [
        (pair, actions, 20) for pair in ("round", "key") for actions in ("random", "trained")
    ]
    assert sums["random"]["control_steps"] == sums["trained"]["control_steps"] == 40
    assert len(soak(capsys, "--control_steps=40")[1]) == COMBINATIONS
    status, rows, _ = soak(capsys, "--control_steps=60")
    assert status == 0
    assert [row["control_steps"] for row in rows[COMBINATIONS:]] == [10] * COMBINATIONS
    assert len(set(soak.seeds)) > 1, "episodes of its own in every call"


def test_a_call_whose_time_is_over_says_so(soak, capsys):
    status, rows, sums = soak(capsys, "--control_steps=40", "--minutes=0")
    assert (status, rows) == (3, [])
    assert sums["random"]["control_steps"] == 0


def test_an_exception_is_counted_and_quoted_and_the_rest_goes_on(soak, capsys):
    status, rows, sums = soak(capsys, "--control_steps=40", news={})
    assert status == 1
    assert [row["exception"] for row in rows] == ["RuntimeError: no room"] * COMBINATIONS
    assert sums["trained"]["exceptions_rate"] == pytest.approx(2 / 20)


def test_what_is_no_number_is_a_failure_and_an_overflow_a_rate(soak, capsys):
    status, _, sums = soak(capsys, "--control_steps=40", news={"overflow": 1})
    assert status == 0
    assert sums["random"]["overflow_rate"] == pytest.approx(0.1)
    assert soak(capsys, "--control_steps=80", news={"not_finite": 1})[0] == 1
