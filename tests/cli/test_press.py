"""``vtrefine-press``: a recording set is there as a whole or not at all."""

import shlex
from pathlib import Path

import pytest

from lerobot_vtrefine.cli import press
from lerobot_vtrefine.diagnose.pad import stand_in_rig


def test_an_interrupted_rig_leaves_no_half_set(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def stopped(_: object, folder: Path, *__: int) -> None:
        (folder / "trial_0000.parquet").write_text("a press")
        raise KeyboardInterrupt

    monkeypatch.setattr(stand_in_rig, "record", stopped)
    assert press.main([f"--output_dir={tmp_path / 'presses'}"]) == 130
    assert list(tmp_path.iterdir()) == []


def test_a_set_is_replaced_only_when_asked_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "presses"
    arguments = [f"--output_dir={folder}", "--trials=2"]
    assert press.main(arguments) == 0
    first = (folder / "trial_0000.parquet").read_bytes()
    assert press.main([*arguments, "--seed=1"]) == 2
    assert "recording.json exists; choose another --output_dir or add --overwrite" in capsys.readouterr().err
    assert (folder / "trial_0000.parquet").read_bytes() == first
    assert press.main([*arguments, "--seed=1", "--overwrite"]) == 0
    assert (folder / "trial_0000.parquet").read_bytes() != first


def test_the_next_command_can_be_copied_where_paths_have_spaces(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "my presses"
    assert press.main([f"--output_dir={folder}", "--trials=2"]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("next: ")]
    assert f"--recording={folder}" in shlex.split(line)


@pytest.mark.parametrize(
    ("flag", "told"),
    [
        ("--trials=0", "--trials must be an even number of at least 2, got 0"),
        ("--trials=1000000000", "--trials must be at most 10000, got 1000000000"),
        ("--output_dir=/", "/ cannot be written as a whole; name a folder inside of it"),
    ],
)
def test_bad_flags_are_one_line(
    flag: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert press.main([f"--output_dir={tmp_path / 'presses'}", flag]) == 2
    assert capsys.readouterr().err == f"error: {told}\n"
    assert list(tmp_path.iterdir()) == []
