"""Stages run once, again when what they depend on changes, and say why they failed."""

import errno
import io
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from tqdm import tqdm

from lerobot_vtrefine.cli.pipeline.progress import ChildProgress, LiveLine, parse_progress, read_tail
from lerobot_vtrefine.cli.pipeline.stages import Stage, StageRunner, find_command, own_sessions, stage_keys

WRITE = (
    "import pathlib, sys; p = pathlib.Path(sys.argv[1]); "
    "p.parent.mkdir(exist_ok=True); p.open('a').write('x')"
)


def stage(folder: Path, name: str, *extra: str, code: str = WRITE, **options) -> Stage:
    product = folder / name / "product"
    return Stage(name, name, ("python", "-c", code, str(product), *extra), product.parent, product, **options)


def run(folder: Path, *stages: Stage) -> str:
    stream = io.StringIO()
    StageRunner(folder, list(stages), LiveLine(stream)).run()
    return stream.getvalue()


def test_finished_stages_are_skipped(tmp_path: Path) -> None:
    chain = (stage(tmp_path, "a"), stage(tmp_path, "b", needs=("a",)))
    assert "done before" not in run(tmp_path, *chain)
    assert run(tmp_path, *chain).count("done before") == 2
    assert (tmp_path / "a" / "product").read_text() == "x"


class Closed(io.StringIO):
    """A terminal that was closed meanwhile, or text that nobody takes."""

    def __init__(self, terminal: bool) -> None:
        super().__init__()
        self.isatty = lambda: terminal

    def write(self, text: str) -> int:
        raise OSError(errno.EIO, "Input/output error")


@pytest.mark.parametrize("terminal", [True, False])
def test_what_cannot_be_shown_ends_no_stage(tmp_path: Path, terminal: bool) -> None:
    slow = stage(tmp_path, "a", code=f"{WRITE}; import time; time.sleep(0.5)")
    StageRunner(tmp_path, [slow], LiveLine(Closed(terminal))).run()
    assert slow.product.read_text() == "x"


def test_changed_command_reruns_it_and_what_needs_it(tmp_path: Path) -> None:
    def chain(option: str) -> tuple[Stage, ...]:
        first = stage(tmp_path, "a", option)
        return first, stage(tmp_path, "b", needs=("a",)), stage(tmp_path, "c")

    run(tmp_path, *chain("1"))
    text = run(tmp_path, *chain("2"))
    assert text.count("done before") == 1
    assert text.splitlines()[2].startswith("[3/3] c")
    assert "done before" in text.splitlines()[2]


def test_missing_product_reruns(tmp_path: Path) -> None:
    only = stage(tmp_path, "a")
    run(tmp_path, only)
    only.product.unlink()
    assert "done before" not in run(tmp_path, only)


def test_repeated_stage_repeats_what_needs_it(tmp_path: Path) -> None:
    """Even if the run that repeats it ends before it reaches them."""
    first, third = stage(tmp_path, "a"), stage(tmp_path, "c", needs=("b",))
    chain = (first, stage(tmp_path, "b", needs=("a",)), third, stage(tmp_path, "d"))
    run(tmp_path, *chain)
    first.product.unlink()
    broken = replace(chain[1], output=tmp_path / "elsewhere", product=tmp_path / "elsewhere" / "product")
    with pytest.raises(ChildProcessError, match="wrote no"):
        run(tmp_path, first, broken, third)
    ends = [line.split(maxsplit=2)[2] for line in run(tmp_path, *chain).splitlines()]
    assert ["done before" in end for end in ends] == [True, False, False, True]


def test_seconds_count_interrupted_runs(tmp_path: Path) -> None:
    flag = tmp_path / "second"
    code = f"import time; time.sleep(0.6); {WRITE}; sys.exit(not pathlib.Path({str(flag)!r}).exists())"
    for name, resumable in (("a", True), ("b", False)):
        flag.unlink(missing_ok=True)
        only = stage(tmp_path, name, code=code, resumable=resumable)
        with pytest.raises(ChildProcessError):
            run(tmp_path, only)
        interrupted = float((tmp_path / "stages" / f"{name}.started").read_text().splitlines()[1])
        assert interrupted >= 0.6
        flag.touch()
        started = time.monotonic()
        (record,) = StageRunner(tmp_path, [only], LiveLine(io.StringIO())).run()
        last = time.monotonic() - started
        assert record.seconds == pytest.approx(last + (interrupted if resumable else 0.0), abs=0.3)


def test_failure_names_the_log_and_the_last_line(tmp_path: Path) -> None:
    broken = stage(tmp_path, "a", code="import sys; print('start'); sys.exit('no such pair')")
    with pytest.raises(ChildProcessError, match=r"stage a failed with status 1: no such pair .*a\.log"):
        run(tmp_path, broken)
    silent = stage(tmp_path, "b", code="pass")
    with pytest.raises(ChildProcessError, match="wrote no"):
        run(tmp_path, silent)


def test_a_command_that_outlived_an_earlier_run_does_not_write_into_the_log(tmp_path: Path) -> None:
    only = stage(tmp_path, "a", code="raise SystemExit('no such pair')")
    log = tmp_path / "logs" / "a.log"
    log.parent.mkdir()
    with log.open("w") as earlier:
        with pytest.raises(ChildProcessError, match="no such pair"):
            run(tmp_path, only)
        earlier.write("all is well " * 20)
    assert "all is well" not in log.read_text()


@pytest.mark.parametrize(("resumable", "left"), [(True, "xx"), (False, "x")])
def test_interrupted_stage_continues_only_if_it_can(tmp_path: Path, resumable: bool, left: str) -> None:
    """The first run writes part of its output and fails; the second has the same command."""
    flag = tmp_path / "second"
    code = f"{WRITE}; p.parent.joinpath('done').touch(); sys.exit(not pathlib.Path({str(flag)!r}).exists())"
    only = stage(tmp_path, "a", code=code, resumable=resumable)
    with pytest.raises(ChildProcessError):
        run(tmp_path, only)
    flag.touch()
    run(tmp_path, only)
    assert only.product.read_text() == left


def test_keys_follow_commands_and_needs(tmp_path: Path) -> None:
    one = stage_keys([stage(tmp_path, "a", "1"), stage(tmp_path, "b", needs=("a",)), stage(tmp_path, "c")])
    two = stage_keys([stage(tmp_path, "a", "2"), stage(tmp_path, "b", needs=("a",)), stage(tmp_path, "c")])
    assert one["a"] != two["a"]
    assert one["b"] != two["b"]
    assert one["c"] == two["c"]


def test_nothing_is_ended_where_all_have_ended() -> None:
    ended: list[tuple] = []
    with own_sessions(lambda *children: ended.append(children)) as start:
        start(["true"]).wait()
    assert ended == []


def test_unknown_command_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="vtrefine-nothing not found"):
        find_command("vtrefine-nothing")
    assert Path(find_command("python")).parent == Path(sys.executable).parent


def test_progress_of_a_real_bar() -> None:
    stream = io.StringIO()
    with tqdm(total=200, desc="Training", file=stream, mininterval=0, miniters=1) as bar:
        bar.set_postfix(loss=0.25)
        bar.update(50)
        text = stream.getvalue()
    assert parse_progress(text) == ChildProgress(50, 200, "loss=0.25")
    assert parse_progress("loading [1/2] weights") is None


def test_tail_reads_only_the_end(tmp_path: Path) -> None:
    path = tmp_path / "log"
    assert read_tail(path) == ""
    path.write_bytes(b"a" * 100 + "é".encode())
    assert read_tail(path, 4) == "aaé"


def test_a_log_file_gets_a_line_a_minute() -> None:
    stream = io.StringIO()
    line = LiveLine(stream)
    line.show("train", ChildProgress(1, 4, "loss=1"), 59.0)
    assert stream.getvalue() == ""
    line.show("train", ChildProgress(1, 4, "loss=[1]"), 61.0)
    assert "1:01  1/4  25 %  loss=[1]" in stream.getvalue()
    line.finish("train", "61 s, " + "a long note " * 9)
    assert len(stream.getvalue().splitlines()) == 2


def test_a_terminal_gets_a_bar_that_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    stream = io.StringIO()
    stream.isatty = lambda: True
    line = LiveLine(stream)
    line.show("train", None, 0.2)
    line.show("train", ChildProgress(1, 4, "loss=1"), 1.0)
    line.finish("train", "2 s")
    drawn = stream.getvalue()
    assert "1/4  25 %" in drawn
    assert drawn.count("\x1b[?25l") == drawn.count("\x1b[?25h") == 1  # the cursor is back
    assert drawn.splitlines()[-1].endswith("train" + " " * 38 + "2 s")
