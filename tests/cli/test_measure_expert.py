"""The expert's table: measured setting by setting, and gone on with where it was stopped."""

from pathlib import Path

import measure_expert as script
import pytest

from lerobot_vtrefine.cli.results.rows import Run, read_rows


def run(patch: pytest.MonkeyPatch, *arguments: object) -> int:
    with patch.context() as argv:
        argv.setattr("sys.argv", ["measure_expert.py", *map(str, arguments)])
        return script.main()


def test_it_measures_what_is_missing_and_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[tuple[str, str, str]] = []

    def measure(setting: object, episodes: int, _mesh_dir: object) -> Run:
        if len(measured) == 3:
            raise KeyboardInterrupt
        measured.append((setting.body, setting.task, setting.start))
        row = {"table": "expert", "iterations": None, "env_steps": None, "seed": None, "success": 1.0}
        known = {"task": setting.task, "policy": setting.body, "variant": setting.start}
        return Run(**row, **known, episodes=episodes, commit=None, command=None, machine=None)

    monkeypatch.setattr(script, "measure", measure)
    asked = ("--pairs", "round", "--starts", "grasped", "--results", tmp_path / "expert.json")
    assert run(monkeypatch, *asked, "--episodes=4") == 130
    assert len(read_rows(tmp_path / "expert.json")) == 3
    measured[1:] = []
    assert run(monkeypatch, *asked, "--episodes=4") == 0
    assert measured[1:] == [("kinova", "round, 1 mm", "grasped")]
    measured.clear()
    run(monkeypatch, *asked, "--bodies", "kinova", "--episodes=5")  # more than the rows hold
    assert len(measured) == 2
    assert [row.episodes for row in read_rows(tmp_path / "expert.json")] == [4, 4, 5, 5]


def test_a_row_says_how_the_episodes_went() -> None:
    row = script.measure(script.Setting("aloha", "round", 0.002, "grasped"), 2, None)
    assert (row.task, row.policy, row.variant, row.successes) == ("round, 2 mm", "aloha", "grasped", 2)
    assert 2.0 < row.extra["time_to_success_s"] < 3.5
    assert "failures" not in row.extra


def test_bad_flags_are_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for flags, words in ((("--episodes=0",), "--episodes"), (("--bodies", "nao"), "nao")):
        assert run(monkeypatch, *flags) == 2
        assert words in capsys.readouterr().err
