"""``vtrefine-find-pads``: find out which pad is on which serial port, by pressing one after the other."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from lerobot_vtrefine import extras
from lerobot_vtrefine.cli.arguments import CommandParser, ListAction
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import check_new_file
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.discovery import (
    FoundBoard,
    first_row,
    open_board,
    probe_port,
    wait_for_press,
    wait_for_release,
)
from lerobot_vtrefine.drivers.pads_file import check_name, save_pads
from lerobot_vtrefine.drivers.ports import PortError, stable_path, stable_ports
from lerobot_vtrefine.embodiments import DEFAULT_BODY, get_embodiment
from lerobot_vtrefine.wording import plural

DESCRIPTION = """\
Find out which FlexiTac pad is on which serial port: the command asks for one pad after the other, you press
it, and the answer is written with stable USB paths."""
EPILOG = """\
examples:
  vtrefine-find-pads --output=pads.yaml
  vtrefine-pad-emulator --source=press &          # without hardware
  vtrefine-find-pads --ports outputs/pads/* --output=pads.yaml"""
SLIDE_S = 5.0
"""How long a finger slides over a pad [s]."""


def make_parser() -> CommandParser:
    """Command line of `vtrefine-find-pads`."""
    parser = CommandParser("vtrefine-find-pads", DESCRIPTION, EPILOG)
    parser.add_argument(
        "--output", type=Path, default=Path("pads.yaml"), help="file to write (default: %(default)s)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a pads file that is there already")
    parser.add_argument(
        "--names",
        action=ListAction,
        default=list(get_embodiment(DEFAULT_BODY).pad_names),
        metavar="NAME",
        help="pads to ask for, in this order: '[NAME, NAME]'",
    )
    parser.add_argument(
        "--ports",
        action=ListAction,
        metavar="PORT",
        help="ports to look at: '[PORT, PORT]', or in a row (default: every USB serial port of this machine)",
    )
    parser.add_argument(
        "--timeout", type=float, default=60.0, help="seconds to wait for each press (default: %(default)s)"
    )
    parser.add_argument(
        "--check_rows",
        action="store_true",
        help="after each press, slide a finger over the pad's rows: tells rows that arrive shifted",
    )
    parser.add_argument("--list", action="store_true", help="only list the ports and what they send")
    return parser


@run_cli
def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `vtrefine-find-pads`."""
    options = make_parser().parse_args(arguments)
    extras.require("vtrefine-find-pads", extras.PADS)
    if len(set(options.names)) < len(options.names):
        raise ValueError(f"--names must differ from each other, got {' '.join(options.names)}")
    for name in options.names:  # before anybody presses pads for a file that cannot be read
        check_name(name, "--names")
    if not options.timeout > 0:
        raise ValueError(f"--timeout must be positive, got {options.timeout:g}")
    ports = options.ports or stable_ports()
    if not ports:
        raise PortError("no serial port found; plug in the boards, or name ports with --ports")
    if not options.list:
        check_new_file("--output", options.output, overwrite=options.overwrite, how="--overwrite")
    with ExitStack() as stack:
        boards = find_boards(ports, stack, only_list=options.list)
        if options.list:
            return
        pads = ask(boards, options.names, options.timeout, check_rows=options.check_rows)
    save_pads(pads, options.output)
    print(f"wrote {options.output}: use it with --robot.pads_file={options.output}")


def find_boards(ports: Sequence[str], stack: ExitStack, *, only_list: bool) -> list[FoundBoard]:
    """Probe ports and start readers on those that stream."""
    boards: list[FoundBoard] = []
    failures: list[str] = []
    print("leave every pad untouched for a moment")
    for port in ports:
        try:
            kind = probe_port(port)
        except PortError as error:
            failures.append(str(error))
            print(f"  {error}")
            continue
        print(f"  {port}: {kind}")
        if only_list:
            continue
        board = open_board(stable_path(port), kind)
        stack.callback(board.reader.stop)
        boards.append(board)
        for problem in board.problems:
            print(f"  {port}: {problem}")
    if not boards and not only_list:
        raise PortError(
            failures[0] if len(failures) == 1 else f"no board streams on {', '.join(ports)}; see above"
        )
    return boards


def ask(
    boards: list[FoundBoard], names: Sequence[str], timeout_s: float, *, check_rows: bool = False
) -> dict[str, PadConfig]:
    """Ask for one press per name; return the configuration of each named pad.

    Raises:
        PortError: too few boards, or no press in time.
    """
    if len(names) > len(boards):
        raise PortError(
            f"{plural(len(names), 'pad')} asked for ({', '.join(names)}), but only"
            f" {plural(len(boards), 'streaming board')} found; "
            "plug in the others, or name fewer with --names"
        )
    named: dict[str, PadConfig] = {}
    free = list(boards)
    for name in names:
        print(f"press {name} ... ", end="", flush=True)
        board = wait_for_press(free, timeout_s)
        if board is None:
            raise PortError(f"no press seen for {name} within {timeout_s:g} s; press one pad alone, firmly")
        print(f"{board.config.port}; let go")
        wait_for_release(boards, timeout_s)
        named[name] = board.config
        free.remove(board)
        if check_rows:
            check_first_row(name, board)
    return named


def check_first_row(name: str, board: FoundBoard) -> None:
    """Ask for a finger to slide over all rows, and correct the pad's row offset where rows are shifted."""
    print(f"slide one finger over all rows of {name}, slowly, for {SLIDE_S:g} s ... ", end="", flush=True)
    first = first_row(board, SLIDE_S)
    if first is None:
        print("not enough rows were touched to tell; row order is not checked")
    elif first == 0:
        print("rows are in order")
    elif board.config.pad_shape[0] < board.config.rows:
        print(f"rows arrive shifted by {first}, though dead rows told where the pad begins: check the cable")
    else:
        board.config.row_offset = first
        print(f"rows arrive shifted by {first}: row_offset is {first}")


if __name__ == "__main__":
    raise SystemExit(main())
