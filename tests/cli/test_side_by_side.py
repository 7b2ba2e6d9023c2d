"""Commands that wait for others."""

import subprocess
import sys
from pathlib import Path

import pytest
from runs.side_by_side import run_all

WRITE = """
import sys
from pathlib import Path
Path(sys.argv[1]).write_text(str([path.name for path in Path().glob("*.done")]))
"""


def commands(folder: Path, **failing: int) -> dict[Path, list[str]]:
    """Each leaves NAME.done with the names of those that were there before, or fails."""
    return {
        folder / name: [sys.executable, "-c", f"{WRITE}\nsys.exit({failing.get(name, 0)})", f"{name}.done"]
        for name in ("policy_a", "encoder_a", "policy_b", "encoder_b", "report_b")
    }


def needs(folder: Path) -> dict[Path, list[Path]]:
    names = {"policy_a": ["encoder_a"], "policy_b": ["encoder_b"], "report_b": ["policy_b", "encoder_b"]}
    return {folder / name: [folder / other for other in others] for name, others in names.items()}


@pytest.mark.parametrize("jobs", [1, 4])
def test_a_command_starts_once_what_it_needs_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jobs: int
) -> None:
    monkeypatch.chdir(tmp_path)
    run_all(commands(tmp_path), jobs, needs(tmp_path))
    for name, others in needs(tmp_path).items():
        before = (tmp_path / f"{name.name}.done").read_text()
        assert all(f"{other.name}.done" in before for other in others)


@pytest.mark.parametrize("jobs", [1, 4])
def test_a_failure_stops_those_alone_that_need_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], jobs: int
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(subprocess.CalledProcessError, match="status 3"):
        run_all(commands(tmp_path, encoder_b=3), jobs, needs(tmp_path))
    assert {path.stem for path in tmp_path.glob("*.done")} == {"encoder_a", "encoder_b", "policy_a"}
    told = capfd.readouterr().out
    assert "== policy_b: left out for want of encoder_b" in told
    assert "== report_b: left out for want of policy_b" in told
