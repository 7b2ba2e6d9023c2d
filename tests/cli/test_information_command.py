"""``vtrefine-information`` as a command: it replaces nothing unasked."""

from pathlib import Path

import pytest

from lerobot_vtrefine.cli.information import main


def test_another_commands_report_is_not_replaced_unasked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "report.html").write_text("a diagnosis")
    monkeypatch.setattr("sys.argv", ["vtrefine-information", f"--output_dir={tmp_path}"])
    assert main() == 2
    told = "report.html exists; choose another --output_dir or add --overwrite=true"
    assert told in capsys.readouterr().err
    assert (tmp_path / "report.html").read_text() == "a diagnosis"


def test_flags_are_named_as_they_are_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [f"--output_dir={tmp_path}", "--effort.episodes=4", "--effort.num_envs=4"]
    monkeypatch.setattr("sys.argv", ["vtrefine-information", *flags])
    assert main() == 2
    told = "--effort.episodes=4 must be at least twice --effort.num_envs=4"
    assert told in capsys.readouterr().err


def test_an_unknown_device_is_told_before_the_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [f"--output_dir={tmp_path / 'out'}", "--effort.device=tpu"]
    monkeypatch.setattr("sys.argv", ["vtrefine-information", *flags])
    assert main() == 2
    assert "error: --effort.device=tpu is unknown; give cpu or cuda" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
