"""Serial ports: opening with errors that name the port and the fix, stable paths, FTDI latency."""

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import serial

try:
    from termios import error as _TerminalError  # noqa: N812
except ImportError:  # Windows has no termios, and so no such errors
    _TerminalError = OSError

from lerobot_vtrefine.extras import PADS, require

FTDI_LATENCY_MS = 1
"""What the latency timer of an FTDI adapter should be; its default of 16 ms delays the last bytes of every
frame."""

STABLE_FOLDERS = ("by-path", "by-id")
"""Under /dev/serial. By path first: it tells which socket, also for adapters that lack a serial number
(CH340)."""

FALLBACK_PATTERNS = ("ttyUSB*", "ttyACM*", "tty.usbserial*", "tty.usbmodem*")

GONE: tuple[type[Exception], ...] = (OSError, _TerminalError)
"""What a port raises whose device goes away (pyserial's errors are OSErrors); flushing raises termios errors,
which are none."""

LOST: tuple[type[Exception], ...] = (*GONE, TypeError)
"""The same of pyserial alone: TypeError in the middle of a read."""


class PortError(ConnectionError):
    """A serial port cannot be used; the message names the port and the fix."""


def open_port(port: str, baud: int, timeout_s: float) -> "serial.Serial":
    """Open a port exclusively, with input flushed.

    Raises:
        PortError: missing, not permitted, busy, or not a serial port.
        MissingExtraError: pyserial is not installed.
    """
    require(f"reading {port}", PADS)
    import serial

    try:
        device = serial.Serial(port, baud, timeout=timeout_s, exclusive=True)
    except (OSError, ValueError) as error:
        raise PortError(explain_open_error(port, baud, error)) from error
    try:
        ask_for_low_latency(device)
        device.reset_input_buffer()
    except LOST as error:
        device.close()
        raise PortError(explain_open_error(port, baud, error)) from error
    return device


def ask_for_low_latency(device: "serial.Serial") -> None:
    """Set an FTDI adapter's timer to 1 ms where the driver allows it (else see `latency_advice`)."""
    try:
        device.set_low_latency_mode(True)
    except (AttributeError, NotImplementedError, ValueError, OSError):
        return


def explain_open_error(port: str, baud: int, error: Exception) -> str:
    """One line that names the port and what to do."""
    code = getattr(error, "errno", None)
    text = str(error)
    if code == errno.ENOENT or not Path(port).exists():
        listed = ", ".join(stable_ports()) or "none: is a board plugged in and powered?"
        return f"{port} does not exist; ports here: {listed}"
    if code == errno.EACCES or "Permission" in text:
        return f"no permission for {port}; run: sudo usermod -aG {_group_of(port)} $USER, then log in again"
    if code in (errno.EBUSY, errno.EAGAIN) or "lock port" in text:
        return f"{port} is busy: another program has it open; see: fuser -v {port}"
    if isinstance(error, ValueError) or "baud" in text.lower():
        return f"{port} does not accept {baud} baud: {text}"
    return f"{port} cannot be opened as a serial port: {text}"


def _group_of(port: str) -> str:
    try:
        return Path(port).group()
    except (OSError, KeyError, NotImplementedError):
        return "dialout"


def stable_ports(dev: Path = Path("/dev")) -> list[str]:
    """Ports by names that survive replugging and rebooting, one name per device; plain names where there is
    none."""
    names: dict[Path, str] = {}
    for folder in STABLE_FOLDERS:
        for link in sorted((dev / "serial" / folder).glob("*")):
            names.setdefault(link.resolve(), str(link))
    for pattern in FALLBACK_PATTERNS:
        for device in sorted(dev.glob(pattern)):
            names.setdefault(device.resolve(), str(device))
    return list(names.values())


def stable_path(port: str, dev: Path = Path("/dev")) -> str:
    """The stable name of a port, or the port itself where it has none."""
    target = Path(port).resolve()
    if port.startswith(str(dev / "serial")):
        return port
    return next((name for name in stable_ports(dev) if Path(name).resolve() == target), port)


def latency_advice(port: str, sys: Path = Path("/sys")) -> str | None:
    """What to do about an FTDI latency timer above 1 ms; None where there is nothing to do."""
    device = os.path.realpath(port).rsplit("/", 1)[-1]
    timer = sys / "bus" / "usb-serial" / "devices" / device / "latency_timer"
    try:
        current_ms = int(timer.read_text())
    except (OSError, ValueError):
        return None
    if current_ms <= FTDI_LATENCY_MS:
        return None
    rule = 'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"'
    return (
        f"{port}: FTDI latency timer is {current_ms} ms, which delays frames; now: "
        f"echo 1 | sudo tee {timer}; for good, in /etc/udev/rules.d/99-flexitac.rules: {rule}"
    )
