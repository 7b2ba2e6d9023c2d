"""Finding pads by pressing them, the pads file, and the three commands."""

import io
import os
import signal
import threading
from collections.abc import Callable
from contextlib import ExitStack, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from boards import PAD, emulated, pressable_source, reading, wait_until
from rich.segment import Segment

from lerobot_vtrefine.cli import find_pads as find_pads_module
from lerobot_vtrefine.cli.find_pads import main as find_pads
from lerobot_vtrefine.cli.pad_emulator import Turns, claim
from lerobot_vtrefine.cli.pad_emulator import main as pad_emulator
from lerobot_vtrefine.cli.view_pads import SHADE, chosen_pads, draw
from lerobot_vtrefine.cli.view_pads import main as view_pads
from lerobot_vtrefine.cli.view_pads import make_parser as view_parser
from lerobot_vtrefine.drivers import ports
from lerobot_vtrefine.drivers.board import PadReader
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.discovery import open_board, probe_port, wait_for_press
from lerobot_vtrefine.drivers.frames import FrameShape
from lerobot_vtrefine.drivers.pads_file import load_pads, save_pads
from lerobot_vtrefine.drivers.ports import PortError
from lerobot_vtrefine.drivers.sources import contact_source, noise_source
from lerobot_vtrefine.tactile.picture import colours


class Operator(io.StringIO):
    """Reads what the command asks for, and presses that pad until told to let go."""

    def __init__(self, where: dict[str, str]) -> None:
        super().__init__()
        self.where = where
        self.pressing = ""

    def write(self, text: str) -> int:
        for name, port in self.where.items():
            if f"press {name} " in text:
                self.pressing = port
        if "let go" in text:
            self.pressing = ""
        return super().write(text)


def test_find_pads_writes_what_the_robot_reads(tmp_path: Path) -> None:
    output = tmp_path / "rig" / "pads.yaml"
    operator = Operator({"thumb": "port1", "index": "port0"})
    with ExitStack() as stack:
        opened = []
        for seed, name in enumerate(("port0", "port1")):
            source = pressable_source(PAD, lambda name=name: operator.pressing == name, seed)
            opened.append(stack.enter_context(emulated(tmp_path, name, source=source)).port)
        stack.enter_context(redirect_stdout(operator))
        status = find_pads(["--ports", *opened, "--names", "thumb", "index", "--output", str(output)])
    assert status == 0, operator.getvalue()
    assert {name: Path(pad.port).name for name, pad in load_pads(output).items()} == operator.where


def test_pads_file_names_usb_sockets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Found as /dev/ttyUSB0, written as the path of the socket, which survives replugging and rebooting."""
    dev = tmp_path / "dev"
    by_path = dev / "serial" / "by-path"
    by_path.mkdir(parents=True)
    monkeypatch.setattr(find_pads_module, "stable_ports", lambda: ports.stable_ports(dev))
    monkeypatch.setattr(find_pads_module, "stable_path", lambda port: ports.stable_path(port, dev))
    operator, output = Operator({"thumb": "ttyUSB0"}), tmp_path / "pads.yaml"
    source = pressable_source(PAD, lambda: operator.pressing == "ttyUSB0")
    with emulated(dev, "ttyUSB0", source=source) as board, redirect_stdout(operator):
        (by_path / "pci-usb-0:2:1.0").symlink_to(board.port)
        for chosen in ([], ["--ports", board.port]):
            command = [*chosen, "--names", "thumb", "--output", str(output), "--overwrite"]
            assert find_pads(command) == 0, operator.getvalue()
            assert load_pads(output) == {"thumb": PadConfig(str(by_path / "pci-usb-0:2:1.0"))}


def test_pad_touched_while_its_idle_counts_were_taken_is_still_found(tmp_path: Path) -> None:
    touched = [True]
    source = pressable_source(PAD, lambda: touched[0])
    with emulated(tmp_path, source=source) as board:
        found = open_board(board.port, probe_port(board.port))
        try:
            touched[0] = False
            assert wait_for_press([found], timeout_s=0.5) is None
            touched[0] = True
            assert wait_for_press([found], timeout_s=10.0) is found
        finally:
            found.reader.stop()


@pytest.mark.parametrize("shift", [0, 5])
def test_rows_that_arrive_shifted_are_put_in_order(
    tmp_path: Path, shift: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(find_pads_module, "SLIDE_S", 2.0)
    operator = Operator({"thumb": "port0"})
    idle, sliding = noise_source(PAD, seed=0), contact_source(PAD, seed=0, period_frames=100)

    def source(number: int) -> np.ndarray:
        slides = "slide one finger" in operator.getvalue()
        return np.roll((sliding if slides else pressed)(number), shift, axis=0)

    def pressed(number: int) -> np.ndarray:
        return idle(number) + np.uint8(100 * (operator.pressing == "port0"))

    output = tmp_path / "pads.yaml"
    with emulated(tmp_path, "port0", source=source) as board, redirect_stdout(operator):
        arguments = ["--ports", board.port, "--names", "thumb", "--check_rows", "--output", str(output)]
        assert find_pads(arguments) == 0
    assert load_pads(output)["thumb"].row_offset == shift


def test_pad_on_sixteen_row_firmware_gets_its_offset(tmp_path: Path) -> None:
    shape = FrameShape(16, 32)
    idle = noise_source(shape, seed=3)

    def source(number: int) -> object:
        counts = idle(number)
        counts[:4] = 0
        return counts

    with emulated(tmp_path, shape=shape, source=source) as board:
        found = open_board(board.port, probe_port(board.port))
        found.reader.stop()
    assert found.config == PadConfig(board.port, rows=16, pad_rows=12, row_offset=4)
    assert found.idle.shape == (12, 32)


def test_board_that_stalls_while_it_is_opened_is_let_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = set(threading.enumerate())
    with emulated(tmp_path) as board:
        running = set(threading.enumerate())
        kind = probe_port(board.port)

        def stalled(reader: PadReader, *_: object, **__: object) -> None:
            raise PortError(f"{reader.port}: frames stopped coming")

        monkeypatch.setattr(PadReader, "idle_frames", stalled)
        with pytest.raises(PortError, match="frames stopped coming"):
            open_board(board.port, kind)
        assert set(threading.enumerate()) == running
    assert set(threading.enumerate()) == before


def test_two_pads_pressed_together_are_no_answer(tmp_path: Path) -> None:
    with ExitStack() as stack:
        held = False
        boards = []
        for seed in (0, 1):
            source = pressable_source(PAD, lambda: held, seed)
            port = stack.enter_context(emulated(tmp_path, f"p{seed}", source=source)).port
            boards.append(open_board(port, probe_port(port)))
            stack.callback(boards[-1].reader.stop)
        held = True
        assert wait_for_press(boards, timeout_s=1.0) is None


def test_probe_explains_silent_and_foreign_ports(tmp_path: Path) -> None:
    board = emulated(tmp_path, "silent")
    board.stall(60.0)
    with board, pytest.raises(PortError, match="no data"):
        probe_port(board.port, timeout_s=0.5)


def test_pads_file_round_trip_keeps_only_what_differs(tmp_path: Path) -> None:
    path = tmp_path / "pads.yaml"
    pads = {"a": PadConfig("/dev/x"), "b": PadConfig("/dev/y", rows=16, pad_rows=12, row_offset=4)}
    save_pads(pads, path)
    assert load_pads(path) == pads
    assert "baud" not in path.read_text()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no 'pads:' section"),
        ("pads: {a: {rows: 12}}", "'a' needs a port"),
        ("pads: {a: {port: x, row: 12}}", "'a': it has no 'row'; valid: port, rows"),
        ("pads: {a: {port: x, row_offset: 40}}", "'a': row_offset=40"),
        ("pads: {a: {port: x}, b: {port: x}}", "'a' and 'b' are both on x"),
        ("pads: [", "not valid YAML"),
    ],
)
def test_bad_pads_files_are_explained(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "pads.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        load_pads(path)
    with pytest.raises(FileNotFoundError, match="vtrefine-find-pads"):
        load_pads(tmp_path / "other.yaml")


@pytest.mark.parametrize("terminal", ["truecolor", "linux", ""])
def test_view_pads_draws_and_names_the_rate(
    terminal: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With every colour, with the few of a console, and in a pipe, where no code belongs."""
    for name in ("NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    if terminal:
        monkeypatch.setenv("FORCE_COLOR", "1")
        monkeypatch.setenv("TERM", terminal)
        monkeypatch.setenv("COLORTERM", terminal)
    with emulated(tmp_path, "thumb") as board:
        assert view_pads(["--ports", board.port, "--seconds", "0.5"]) == 0
    shown = capsys.readouterr().out
    assert "thumb: " in shown
    assert "frames/s" in shown
    assert (shown.count("▀") >= 6 * 32) == bool(terminal)
    assert ("\x1b[38;2;" in shown) == (terminal == "truecolor")
    assert ("\x1b" in shown) == bool(terminal)
    assert ("counts above idle (row" in shown) == (not terminal)


def test_ports_that_end_alike_are_all_shown() -> None:
    options = view_parser().parse_args(["--ports", "/dev/one/pad", "/dev/two/pad"])
    assert [pad.port for pad in chosen_pads(options).values()] == ["/dev/one/pad", "/dev/two/pad"]


def test_pads_in_a_terminal_are_what_was_read() -> None:
    """Every taxel is half a block of its own colour; alike neighbours share a code."""
    idle = np.full((3, 4), 20, np.uint8)
    counts = idle + np.array([[0, 0, 120, 0], [0, 60, 0, 0], [120, 0, 0, 0]], np.uint8)
    lines = list(Segment.split_lines(draw(counts, idle, stale=False).segments))
    assert [line.text for line in lines[0]] == ["▀", "▀", "▀", "▀"]
    assert [line.text for line in lines[1]] == ["▀", "▀▀▀"]
    wanted = colours(counts, idle)
    for row, line in enumerate(lines):
        styles = [segment.style for segment in line for _ in segment.text]
        for half, colour in ((0, "color"), (1, "bgcolor")):
            if 2 * row + half < len(wanted):
                shown = [tuple(getattr(style, colour).triplet) for style in styles]
                assert np.abs(np.array(shown) - wanted[2 * row + half]).max() < SHADE
    grey = draw(counts, idle, stale=True).segments[0].style.color.triplet
    assert grey.red == grey.green == grey.blue


def test_emulator_command_prints_its_ports(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "boards"
    assert pad_emulator(["--folder", str(folder), "--boards", "2", "--seconds", "0.2", "--loss", "0.01"]) == 0
    assert capsys.readouterr().out.split() == [
        str(folder / "left_arm_left_finger"),
        str(folder / "left_arm_right_finger"),
    ]
    assert not list(folder.iterdir())


def test_presses_begin_when_all_boards_are_read(tmp_path: Path) -> None:
    turns = Turns()
    with emulated(tmp_path, "a") as first, emulated(tmp_path, "b") as second:
        turns.boards += [first, second]
        with reading(PadConfig(first.port)):
            wait_until(lambda: not second.is_read)
            assert first.is_read
            assert turns() == 0
            with reading(PadConfig(second.port)):
                wait_until(lambda: turns() > 0.05)
        wait_until(lambda: turns() == 0)


@pytest.mark.parametrize("flags", [["--folder=boards"], ["--folder=others", "--arms=boards"]])
def test_a_second_emulator_leaves_the_ports_of_the_first(tmp_path: Path, monkeypatch, capsys, flags) -> None:
    monkeypatch.chdir(tmp_path)
    with ExitStack() as first:
        claim(Path("boards"), first)
        assert pad_emulator([*flags, "--boards=1", "--seconds=0.1"]) == 2
        told = capsys.readouterr()
        assert "an emulator runs in boards already: end it, or choose another folder" in told.err
        assert told.out == ""
    assert pad_emulator(["--folder=boards", "--boards=1", "--seconds=0.1"]) == 0


def test_terminated_emulator_removes_its_ports(tmp_path: Path) -> None:
    folder = tmp_path / "boards"
    killer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGTERM))
    killer.start()
    assert pad_emulator(["--folder", str(folder), "--boards", "1", "--seconds", "30"]) == 130
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        (pad_emulator, ["--shape", "12"], "--shape=12 is not rows x columns"),
        (pad_emulator, ["--recording", "nowhere.npy"], "nowhere.npy does not exist"),
        (pad_emulator, ["--markers", "999"], "taxel 999"),
        (pad_emulator, ["--loss", "2"], "loss must be at most 1, got 2.0"),
        (find_pads, ["--ports", "/nowhere/pty"], "/nowhere/pty does not exist"),
        (find_pads, ["--ports", "x", "--names", "a", "a"], "must differ"),
        (view_pads, [], "give either --pads_file"),
        (view_pads, ["--ports=[/nowhere/a, /nowhere/b]"], "/nowhere/a does not exist"),
        (view_pads, ["--ports=x", "--hz=nan"], "--hz must be a finite number, got nan"),
        (view_pads, ["--ports=x", "--hz=1e-12"], "--hz must be at least 0.001, got 1e-12"),
        (view_pads, ["--ports=x", "--seconds=-1"], "--seconds must not be negative, got -1"),
        (view_pads, ["--ports=x", "--save=/"], "--save=/ is a folder; name a file in it"),
        (view_pads, ["--ports=x", "--save=/proc/x.rrd"], "--save=/proc/x.rrd"),
        (view_pads, ["--ports=[/nowhere/a"], "argument --ports: give a list such as"),
        (find_pads, ["--ports", "x", "--names=[a, a]"], "--names must differ"),
        (find_pads, ["--ports", "x", "--names", "left pad"], "--names: 'left pad' cannot name a pad"),
        (find_pads, ["--ports", "x", "--timeout=-2"], "--timeout must be positive, got -2"),
        (find_pads, ["--ports", "x", "--output=/"], "--output=/ is a folder; name a file"),
        (find_pads, ["--ports", "x", "--output=/proc/nowhere/pads.yaml"], "--output=/proc/nowhere/pads.yaml"),
        (view_pads, ["--ports", "/nowhere/a", "/nowhere/a"], "--ports must differ from each other"),
        (pad_emulator, ["--markers=[999]"], "taxel 999"),
        (pad_emulator, ["--markers", "1", "x"], "argument --markers: invalid literal"),
    ],
)
def test_bad_usage_is_one_line_and_status_2(
    command: object, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(arguments) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error


@pytest.mark.parametrize(
    ("command", "flag", "way_out"),
    [(find_pads, "--output", " or add --overwrite to replace it"), (view_pads, "--save", "")],
)
def test_what_was_made_at_the_robot_is_not_replaced_unasked(
    command: Callable[[list[str]], int], flag: str, way_out: str, tmp_path: Path, capsys
) -> None:
    """Told before a pad is pressed: a pads file may have been edited by hand, a live recording comes once."""
    there = tmp_path / "there"
    there.write_text("an hour's work")
    assert command(["--ports", "/nowhere/pty", f"{flag}={there}"]) == 2
    assert capsys.readouterr().err == f"error: {there} exists; choose another {flag}{way_out}\n"
    if way_out:
        assert command(["--ports", "/nowhere/pty", f"{flag}={there}", "--overwrite"]) == 2
        assert "/nowhere/pty does not exist" in capsys.readouterr().err
    assert there.read_text() == "an hour's work"
