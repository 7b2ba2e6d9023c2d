"""``vtrefine-pad-emulator``: emulate FlexiTac boards and ALOHA arms, to try everything without hardware."""

import argparse
import fcntl
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from lerobot_vtrefine.cli.arguments import CommandParser, ListAction
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import check_folder
from lerobot_vtrefine.drivers.diagnostic_emulator import DiagnosticEmulator
from lerobot_vtrefine.drivers.emulator import ENCODERS, LONGEST_S, Faults, PadEmulator
from lerobot_vtrefine.drivers.frames import FrameShape
from lerobot_vtrefine.drivers.sources import (
    Source,
    contact_source,
    noise_source,
    pattern_source,
    press_in_turn_source,
    recording_source,
    with_markers,
)
from lerobot_vtrefine.embodiments import DEFAULT_BODY, get_embodiment
from lerobot_vtrefine.files import decode, limits

NAMES = get_embodiment(DEFAULT_BODY).pad_names
"""Of boards, if there are no more than this."""

TURN_S = 4.0
"""With --source=press each pad is pressed for half of this time, one after the other [s]."""

MAX_BOARDS = 64
"""Each is a pseudo-terminal and a thread; a system lends some hundreds to a user."""
EPILOG = """\
examples:
  vtrefine-pad-emulator --source=press            # then, elsewhere: vtrefine-find-pads --ports outputs/pads/*
  vtrefine-pad-emulator --arms=outputs/arms       # four emulated arms beside the pads"""
SOURCES = ("contact", "noise", "press", "pattern", "recording")


def make_parser() -> CommandParser:
    """Command line of `vtrefine-pad-emulator`."""
    parser = CommandParser(
        "vtrefine-pad-emulator",
        "Emulate FlexiTac boards on pseudo-terminals. Prints their ports; runs until Ctrl-C.",
        EPILOG,
    )
    add = parser.add_argument
    add(
        "--folder",
        type=Path,
        default=Path("outputs/pads"),
        help="where the ports appear (default: %(default)s)",
    )
    add("--boards", type=int, default=len(NAMES), help="number of boards (default: %(default)s)")
    add("--shape", default="12x32", help="rows x columns that the boards send (default: %(default)s)")
    add(
        "--protocol",
        choices=(*ENCODERS, "diagnostic"),
        default="binary",
        help="firmware variant (default: %(default)s)",
    )
    add("--rate", type=float, default=100.0, help="frames per second (default: %(default)s)")
    add(
        "--source",
        choices=SOURCES,
        default="contact",
        help="what the pads feel: contact = a wandering fingertip; press = one pad after another is pressed "
        "for 2 s while all are read; pattern = frames with a checksum; recording = a file "
        "(default: %(default)s)",
    )
    add(
        "--recording",
        type=Path,
        help="uint8 frames, .npy or .npz, (T, R, C) or (T, R*C); implies --source recording",
    )
    add(
        "--arms",
        type=Path,
        metavar="FOLDER",
        help="also emulate ALOHA's four arms there; the leaders wave, and LeRobot's flags are printed",
    )
    add("--seconds", type=float, default=0.0, help="0: until Ctrl-C (default: %(default)s)")
    add("--seed", type=int, default=0, help="seed of noise and faults (default: %(default)s)")
    faults = parser.add_argument_group("faults, none by default")
    add = faults.add_argument
    add("--loss", type=float, default=0.0, help="probability that a byte is lost")
    add(
        "--burst_loss",
        type=float,
        default=0.0,
        help="probability per frame that 2..62 bytes in a row are lost",
    )
    add("--stall_every", type=float, default=0.0, help="seconds between stalls")
    add("--stall", type=float, default=1.0, help="length of a stall in seconds (default: %(default)s)")
    add("--unplug_at", type=float, default=0.0, help="seconds after the start at which the ports vanish")
    add("--replug_after", type=float, default=1.0, help="seconds until they are back (default: %(default)s)")
    add("--markers", action=ListAction, kind=int, default=[], metavar="TAXEL", help="these read AA 55")
    return parser


@dataclass(frozen=True)
class Numbers:
    """Limits of the flags that are numbers, faults apart."""

    boards: int = limits(1, MAX_BOARDS)
    rate: float = limits(0.01, 10_000.0)
    seconds: float = limits(0.0, LONGEST_S)
    seed: int = limits(0, 2**53 - MAX_BOARDS)


def parse_faults(options: argparse.Namespace) -> Faults:
    """The faults of the flags, all of whose numbers are checked.

    Raises:
        ValueError: names the flag.
    """
    decode(Numbers, vars(options), "flags", "--", others=True)
    faults = {
        "loss": options.loss,
        "burst_loss": options.burst_loss,
        "stall_every_s": options.stall_every,
        "stall_s": options.stall,
        "unplug_at_s": options.unplug_at,
        "replug_after_s": options.replug_after,
    }
    found = decode(Faults, faults, "faults", "fault ")
    if options.protocol == "diagnostic" and found != Faults(stall_s=found.stall_s):
        raise ValueError("--protocol=diagnostic has no faults: leave out --loss and what is listed with it")
    return found


def parse_shape(text: str) -> FrameShape:
    """`12x32` as a shape."""
    rows, _, cols = text.partition("x")
    if not re.fullmatch(r"[0-9]{1,3}x[0-9]{1,3}", text):
        raise ValueError(f"--shape={text[:40]} is not rows x columns, such as 12x32 or 16x32")
    return FrameShape(int(rows), int(cols))


class Turns:
    """Whose turn it is to be pressed: turns of `TURN_S` since all boards are being read, 0 before."""

    def __init__(self) -> None:
        self.boards: list[PadEmulator] = []
        self._started_s: float | None = None

    def __call__(self) -> float:
        """Turns since the start."""
        now = time.monotonic()
        if not all(board.is_read for board in self.boards):
            self._started_s = None
            return 0.0
        self._started_s = now if self._started_s is None else self._started_s
        return (now - self._started_s) / TURN_S


def make_source(
    options: argparse.Namespace, shape: FrameShape, board: int, turn: Callable[[], float]
) -> Source:
    """What board number `board` feels; `turn` tells whose turn it is where pads are pressed in turn."""
    seed = options.seed + board
    if options.recording is not None or options.source == "recording":
        if options.recording is None:
            raise ValueError("--source=recording needs --recording=FILE")
        source = recording_source(options.recording, shape)
    elif options.source == "pattern":
        source = pattern_source(shape, time.monotonic_ns, seed)
    elif options.source == "press":
        source = press_in_turn_source(shape, board, options.boards, turn, seed)
    else:
        source = (contact_source if options.source == "contact" else noise_source)(shape, seed)
    for taxel in options.markers:
        if not 0 <= taxel < shape.taxels - 1:
            raise ValueError(f"--markers: taxel {taxel} is not within 0 .. {shape.taxels - 2}")
    return with_markers(source, tuple(options.markers)) if options.markers else source


def make_board(
    options: argparse.Namespace, shape: FrameShape, faults: Faults, board: int, name: str, turns: Turns
) -> PadEmulator | DiagnosticEmulator:
    """Board number `board`, not started."""
    source, link = make_source(options, shape, board, turns), options.folder / name
    if options.protocol == "diagnostic":
        return DiagnosticEmulator(source, link)
    emulator = PadEmulator(
        source,
        shape,
        link,
        rate_hz=options.rate,
        protocol=options.protocol,
        faults=faults,
        seed=options.seed + board,
    )
    turns.boards.append(emulator)
    return emulator


def start_arms(folder: Path, stack: ExitStack) -> Callable[[float], None]:
    """Start ALOHA's arms and print their flags; return what moves the leaders, given the time [s]."""
    from lerobot_vtrefine.drivers.aloha_emulator import AlohaEmulator  # imports LeRobot's motors

    arms = stack.enter_context(AlohaEmulator(folder))
    print(*arms.flags(), sep="\n", flush=True)
    return arms.wave


def claim(folder: Path, stack: ExitStack) -> None:
    """Keep other emulators out of a folder, whose ports they would take away, as long as this one runs.

    Raises:
        ValueError: another one is there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    stack.callback(os.close, descriptor)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ValueError(f"an emulator runs in {folder} already: end it, or choose another folder") from None


@run_cli
def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `vtrefine-pad-emulator`."""
    options = make_parser().parse_args(arguments)
    shape = parse_shape(options.shape)
    faults = parse_faults(options)
    names = NAMES if options.boards <= len(NAMES) else tuple(f"pad_{i}" for i in range(options.boards))
    turns = Turns()
    given = {"--arms": options.arms, "--folder": options.folder}
    places = {path.resolve(): (flag, path) for flag, path in given.items() if path}
    with ExitStack() as stack:
        if threading.current_thread() is threading.main_thread():  # a killed emulator removes its ports, too
            before = signal.signal(signal.SIGTERM, signal.default_int_handler)
            stack.callback(signal.signal, signal.SIGTERM, before)
        boards = [
            make_board(options, shape, faults, board, name, turns)
            for board, name in enumerate(names[: options.boards])
        ]
        for flag, folder in places.values():
            check_folder(flag, folder)
            claim(folder, stack)
        for emulator in boards:
            print(stack.enter_context(emulator).port, flush=True)
        wave = start_arms(options.arms, stack) if options.arms else None
        started = time.monotonic()
        while not options.seconds or time.monotonic() - started < options.seconds:
            time.sleep(0.02 if wave else 0.1)
            if wave is not None:
                wave(time.monotonic() - started)


if __name__ == "__main__":
    raise SystemExit(main())
