"""``vtrefine-view-pads``: show FlexiTac pads live, in the terminal or in rerun."""

import argparse
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.color import Color
from rich.console import Console, Group
from rich.live import Live
from rich.segment import Segment, Segments
from rich.style import Style
from rich.text import Text

from lerobot_vtrefine import extras
from lerobot_vtrefine.cli.arguments import CommandParser, ListAction
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import check_new_file
from lerobot_vtrefine.drivers.board import PadReader, Status
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.diagnostic import DiagnosticReader
from lerobot_vtrefine.drivers.idle import idle_counts, touch_problem
from lerobot_vtrefine.drivers.pads_file import check_distinct_ports, load_pads
from lerobot_vtrefine.drivers.ports import PortError
from lerobot_vtrefine.drivers.serial_reader import RETRY_S
from lerobot_vtrefine.files import decode, limits
from lerobot_vtrefine.tactile.picture import colours
from lerobot_vtrefine.view.rerun_viewer import import_rerun

DESCRIPTION = "Show FlexiTac pads live, row 0 at the top, column 0 at the left."
EPILOG = """\
examples:
  vtrefine-view-pads --pads_file=pads.yaml
  vtrefine-view-pads --ports='[/dev/ttyUSB0, /dev/ttyUSB1]' --rerun"""
SHADE = 16
"""Colours this close are drawn alike: idle taxels, whose counts flicker, then cost a slow terminal little."""
PLAIN_S = 1.0
"""Without colours, pads are told this often."""


@dataclass(frozen=True)
class Rates:
    """Limits of the flags about time."""

    hz: float = limits(0.001, 1000.0)
    seconds: float = limits(0.0, 1e9)


def make_parser() -> CommandParser:
    """Command line of `vtrefine-view-pads`."""
    parser = CommandParser("vtrefine-view-pads", DESCRIPTION, EPILOG)
    add = parser.add_argument
    add("--pads_file", type=Path, help="file written by vtrefine-find-pads")
    add(
        "--ports",
        action=ListAction,
        default=[],
        metavar="PORT",
        help="ports to show instead of a pads file: '[PORT, PORT]', or in a row",
    )
    add("--rows", type=int, default=12, help="rows that the boards on --ports send (default: %(default)s)")
    add("--cols", type=int, default=32, help="columns that the boards on --ports send (default: %(default)s)")
    add("--hz", type=float, default=15.0, help="pictures per second (default: %(default)s)")
    add(
        "--seconds",
        type=float,
        default=0.0,
        help="stop after this time; 0: Ctrl-C ends it (default: %(default)s)",
    )
    add("--rerun", action="store_true", help="show in the rerun viewer instead of the terminal")
    add("--save", type=Path, metavar="FILE", help="write a rerun file (.rrd) instead of showing anything")
    group = parser.add_argument_group("a board with the diagnostic text firmware")
    group.add_argument("--diagnostic", metavar="PORT", help="show readings of one taxel, once a second")
    group.add_argument(
        "--channel", type=int, default=4, help="multiplexer channel, 0 to 15 (default: %(default)s)"
    )
    group.add_argument("--column", type=int, default=0, help="column, 0 to 31 (default: %(default)s)")
    return parser


def draw(counts: NDArray[np.uint8], idle: NDArray[np.uint8], *, stale: bool) -> Segments:
    """One pad in half blocks, two rows a line; grey while its frame is stale."""
    rgb = colours(counts, idle, stale=stale) // SHADE * SHADE
    if len(rgb) % 2:
        rgb = np.concatenate([rgb, np.zeros_like(rgb[:1])])
    segments: list[Segment] = []
    for cells in np.concatenate([rgb[::2], rgb[1::2]], axis=-1):
        changes = np.flatnonzero((cells[1:] != cells[:-1]).any(axis=-1)) + 1
        starts = [0, *changes.tolist()]
        for start, stop in zip(starts, [*starts[1:], len(cells)], strict=True):
            segments.append(Segment("▀" * (stop - start), _style(cells[start].tobytes())))
        segments.append(Segment.line())
    return Segments(segments)


@lru_cache(maxsize=4096)
def _style(cell: bytes) -> Style:
    """Red, green and blue of the upper half, then of the lower one."""
    return Style(color=Color.from_rgb(*cell[:3]), bgcolor=Color.from_rgb(*cell[3:]))


def status_line(reader: PadReader) -> str:
    """Name, frame rate and age, or what is wrong."""
    health = reader.health()
    if health.status is not Status.STREAMING:
        return f"{reader.name}: {health.status.value.upper()}: {health.advice}"
    lost = f", {health.locks_lost} breaks in the stream" if health.locks_lost else ""
    return f"{reader.name}: {health.rate_hz:.0f} frames/s, {1000 * health.age_s:.0f} ms old{lost}"


def chosen_pads(options: argparse.Namespace) -> dict[str, PadConfig]:
    """The pads to show.

    Raises:
        ValueError: neither or both of --pads_file and --ports are given.
    """
    if bool(options.ports) == (options.pads_file is not None):
        raise ValueError("give either --pads_file=FILE (vtrefine-find-pads writes it) or --ports PORT ...")
    if options.pads_file is not None:
        return load_pads(options.pads_file)
    ends = [Path(port).name for port in options.ports]
    names = ends if len(set(ends)) == len(ends) else options.ports
    if len(set(names)) < len(names):
        raise ValueError(f"--ports must differ from each other, got {' '.join(names)}")
    pads = {
        name: PadConfig(port, options.rows, options.cols)
        for name, port in zip(names, options.ports, strict=True)
    }
    check_distinct_ports(pads, "--ports")
    return pads


@run_cli
def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `vtrefine-view-pads`."""
    options = make_parser().parse_args(arguments)
    extras.require("vtrefine-view-pads", extras.PADS)
    decode(Rates, vars(options), "flags", "--", others=True)
    if options.save is not None:
        check_new_file("--save", options.save)
    if options.diagnostic:
        view_taxel(options.diagnostic, options.channel, options.column, options.seconds)
        return
    in_rerun = options.rerun or options.save is not None
    rr = import_rerun("vtrefine-view-pads with --rerun or --save", options.save) if in_rerun else None
    with ExitStack() as stack:
        readers = [PadReader(config, name) for name, config in chosen_pads(options).items()]
        for reader in readers:
            reader.connect()
            stack.callback(reader.stop)
        print("leave the pads untouched for a moment", file=sys.stderr)
        idle = {reader.name: take_idle_counts(reader) for reader in readers}
        show = terminal_view(stack) if rr is None else rerun_view(rr, options.save, stack)
        if options.save is not None:
            print(f"writing {options.save}; Ctrl-C ends it", file=sys.stderr)
        started = time.monotonic()
        while not options.seconds or time.monotonic() - started < options.seconds:
            show(readers, idle)
            time.sleep(1.0 / options.hz)


def take_idle_counts(reader: PadReader) -> NDArray[np.uint8]:
    """Idle counts, uint8 (rows, cols); a touch while they are taken is told."""
    frames = reader.idle_frames()
    if problem := touch_problem(frames):
        print(f"{reader.name}: {problem}", file=sys.stderr)
    return idle_counts(frames)


def view_taxel(port: str, channel: int, column: int, seconds: float) -> None:
    """Print readings of one taxel of a board with the diagnostic firmware; 0 seconds: until Ctrl-C."""
    with DiagnosticReader(port) as board:
        started = time.monotonic()
        trouble = ""
        while True:
            try:
                sample = board.measure(channel, column)
                trouble = ""
                print(
                    f"channel {sample.mux}, column {sample.col}: {sample.raw8} counts "
                    f"(10-bit {sample.raw10_mean}, {sample.raw10_min} to {sample.raw10_max})",
                    flush=True,
                )
            except PortError as error:  # unplugged, say: it is read again when it is back
                if str(error) != trouble:
                    trouble = str(error)
                    print(trouble, file=sys.stderr, flush=True)
                time.sleep(RETRY_S)
            if seconds and time.monotonic() - started >= seconds:
                return


def terminal_view(stack: ExitStack) -> Any:
    """A function that draws all pads in place, in the colours that the terminal has; a line a pad and second
    where there are none, as in a pipe.
    """
    console = Console()
    if console.color_system is None or console.no_color:
        return plain_view()
    _style.cache_clear()  # a style remembers the codes of the terminal that it was first written to
    live = stack.enter_context(Live(console=console, auto_refresh=False, vertical_overflow="crop"))

    def show(readers: list[PadReader], idle: dict[str, NDArray[np.uint8]]) -> None:
        shown: list[Text | Segments] = []
        for reader in readers:
            shown.append(Text(status_line(reader)))
            frame = reader.latest()
            stale = reader.health().status is not Status.STREAMING
            shown += [draw(frame.counts, idle[reader.name], stale=stale)] if frame is not None else []
        live.update(Group(*shown), refresh=True)

    return show


def plain_view() -> Any:
    """A function that tells every pad's health and strongest reading, once a second."""
    told_s = -np.inf

    def show(readers: list[PadReader], idle: dict[str, NDArray[np.uint8]]) -> None:
        nonlocal told_s
        if time.monotonic() - told_s < PLAIN_S:
            return
        told_s = time.monotonic()
        for reader in readers:
            frame = reader.latest()
            strongest = "" if frame is None else f", {_strongest(frame.counts, idle[reader.name])}"
            print(f"{status_line(reader)}{strongest}", flush=True)

    return show


def _strongest(counts: NDArray[np.uint8], idle: NDArray[np.uint8]) -> str:
    above = counts.astype(int) - idle
    row, column = np.unravel_index(above.argmax(), above.shape)
    return f"at most {above.max()} counts above idle (row {row}, column {column})"


def rerun_view(rr: Any, save: Path | None, stack: ExitStack) -> Any:
    """A function that sends all pads to the rerun viewer, or to a file."""
    rr.init("vtrefine-view-pads", spawn=save is None)
    if save is not None:
        rr.save(save)
    stack.callback(rr.rerun_shutdown)

    def show(readers: list[PadReader], idle: dict[str, NDArray[np.uint8]]) -> None:
        for reader in readers:
            frame = reader.latest()
            if frame is not None:
                stale = reader.health().status is not Status.STREAMING
                picture = colours(frame.counts, idle[reader.name], stale=stale)
                rr.log(f"pads/{reader.name}", rr.Image(picture))
            rr.log(f"health/{reader.name}", rr.TextLog(status_line(reader)))

    return show


if __name__ == "__main__":
    raise SystemExit(main())
