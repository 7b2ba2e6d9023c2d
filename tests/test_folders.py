"""Folders that change as a whole, killed at every file operation."""

import errno
import os
import stat
from pathlib import Path

import pytest
from file_faults import contents, in_fork, killed_at_each

from lerobot_vtrefine import folders
from lerobot_vtrefine.cli.outputs import staged
from lerobot_vtrefine.folders import beside, put_in_place
from lerobot_vtrefine.whole_files import whole_file

NAMES = ("model.json", "sub/frames.txt", "verdict.json")
FOREIGN = {"notes.txt": b"mine", "predicted/trial.txt": b"also mine"}


def write(output: Path, version: str, overwrite: bool = True) -> None:
    with staged(output, NAMES, overwrite=overwrite) as folder:
        for name in NAMES:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(version)


def listed(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def files(version: str) -> dict[str, bytes]:
    return {name: version.encode() for name in NAMES}


def add_foreign(output: Path) -> None:
    for name, text in FOREIGN.items():
        (output / name).parent.mkdir(exist_ok=True)
        (output / name).write_bytes(text)


@pytest.mark.parametrize("exchanging", [True, False], ids=["exchange", "two_renames"])
def test_a_kill_leaves_the_old_results_or_the_new_ones(tmp_path, monkeypatch, exchanging) -> None:
    output, kept, points = tmp_path / "out", [], 0
    if not exchanging:
        monkeypatch.setattr(folders, "_exchange", lambda one, other: False)

    def prepare() -> None:
        write(output, "old")
        add_foreign(output)

    for at in killed_at_each(prepare, lambda: write(output, "new")):
        points += 1
        found = contents(output)
        if exchanging or found:
            assert found in (files("old") | FOREIGN, files("new") | FOREIGN), at
            kept.append("new" if found["model.json"] == b"new" else "old")
        else:  # between two renames: brought back by the next run of anything that writes there
            with beside(output):
                pass
            assert contents(output) == files("old") | FOREIGN, at
            kept.append("aside")
        write(output, "new")
        assert contents(output) == files("new") | FOREIGN
        assert listed(tmp_path) == ["out"]
    assert points > 15
    wanted = ["old", "new"] if exchanging else ["old", "aside", "new"]
    assert list(dict.fromkeys(kept)) == wanted


def test_a_kill_while_writing_the_first_results_leaves_none_or_all(tmp_path) -> None:
    output = tmp_path / "a" / "out"
    seen = set()

    def prepare() -> None:
        folders.shutil.rmtree(tmp_path / "a", ignore_errors=True)

    for _ in killed_at_each(prepare, lambda: write(output, "new", overwrite=False)):
        assert contents(output) in ({}, files("new"))
        seen.add(len(contents(output)))
        write(output, "new")
        assert listed(tmp_path / "a") == ["out"]
    assert seen == {0, len(NAMES)}


def test_a_failure_leaves_the_old_results_and_nothing_else(tmp_path) -> None:
    write(tmp_path / "out", "old")

    def fail() -> None:
        with staged(tmp_path / "out", NAMES, overwrite=True) as folder:
            (folder / NAMES[0]).write_text("new")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert contents(tmp_path / "out") == files("old")
    assert listed(tmp_path) == ["out"]


def test_names_with_special_characters_and_other_runs_are_left_alone(tmp_path) -> None:
    live, dead = tmp_path / f".o[u]t.partial-{os.getppid()}", tmp_path / ".o[u]t.partial-2147483646"
    for folder in (live, dead, tmp_path / ".out.partial-2147483646"):
        folder.mkdir()
    write(tmp_path / "o[u]t", "new")
    assert listed(tmp_path) == sorted([live.name, ".out.partial-2147483646", "o[u]t"])


def test_a_link_to_a_folder_stays_a_link(tmp_path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk")
    write(tmp_path / "out", "old")
    write(tmp_path / "out", "new")
    assert (tmp_path / "out").is_symlink()
    assert contents(tmp_path / "disk") == files("new")


def test_folders_that_cannot_change_places_are_refused_before_any_work(tmp_path, monkeypatch) -> None:
    inside = tmp_path / "out" / "inside"
    inside.mkdir(parents=True)

    def refused(output: Path, reason: str) -> None:
        with pytest.raises(ValueError, match=f"{reason}; name a folder inside of it"), beside(output):
            pytest.fail("refused too late")

    refused(Path("/proc"), "something is mounted there")
    with monkeypatch.context() as patch:
        patch.chdir(inside)
        refused(tmp_path / "out", "this command runs in it")
    monkeypatch.setattr(folders.os, "access", lambda *_: False)
    for output in (tmp_path / "out", tmp_path / "new" / "folder"):
        with pytest.raises(PermissionError, match=f"{tmp_path} is read-only; choose another"), beside(output):
            pytest.fail("refused too late")


def test_where_no_folder_can_be_made_the_one_that_was_asked_for_is_named() -> None:
    with pytest.raises(OSError, match="no folder can be made in /proc") as told, beside(Path("/proc/pads")):
        pytest.fail("refused too late")
    assert told.value.filename == "/proc/pads"


def test_the_root_of_all_folders_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^/ cannot be written as a whole"), beside(Path("/")):
        pytest.fail("refused too late")


def test_a_folder_within_a_file_is_refused(tmp_path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(NotADirectoryError, match=f"{tmp_path / 'file'} is a file"):
        folders.check_replaceable(tmp_path / "file" / "new" / "folder")


def test_files_that_cannot_be_linked_are_copied(tmp_path, monkeypatch) -> None:
    write(tmp_path / "out", "old")
    add_foreign(tmp_path / "out")

    def no_links(*args: object, **kwargs: object) -> None:
        raise PermissionError(folders.errno.EPERM, "no links here")

    monkeypatch.setattr(folders.os, "link", no_links)
    write(tmp_path / "out", "new")
    assert contents(tmp_path / "out") == files("new") | FOREIGN


def test_a_new_folder_is_whole_or_absent(tmp_path) -> None:
    def build() -> None:
        with beside(tmp_path / "new") as staging:
            (staging / "new").mkdir()
            (staging / "new" / "a").write_text("a")
            put_in_place(staging / "new", tmp_path / "new")

    for _ in killed_at_each(lambda: folders.shutil.rmtree(tmp_path / "new", ignore_errors=True), build):
        assert contents(tmp_path / "new") in ({}, {"a": b"a"})
    assert in_fork(build) == 0
    assert listed(tmp_path) == ["new"]


def test_folders_that_cannot_be_synced_are_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on vboxsf or 9p; a file that cannot be is still an error."""
    fsync, refused = os.fsync, [stat.S_ISDIR]

    def picky(descriptor: int) -> None:
        if any(kind(os.fstat(descriptor).st_mode) for kind in refused):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", picky)
    with whole_file(tmp_path / "new" / "file") as part:
        part.write_text("whole")
    assert (tmp_path / "new" / "file").read_text() == "whole"
    refused.append(stat.S_ISREG)
    with pytest.raises(OSError, match="Invalid argument"), whole_file(tmp_path / "new" / "other") as part:
        part.write_text("lost")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["file"]
