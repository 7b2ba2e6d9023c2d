"""Port names, error messages, FTDI latency: on a fake /dev and /sys."""

import errno
from pathlib import Path

import pytest
import serial

from lerobot_vtrefine.drivers.ports import explain_open_error, latency_advice, stable_path, stable_ports


@pytest.fixture
def dev(tmp_path: Path) -> Path:
    for name in ("ttyUSB0", "ttyUSB1", "ttyACM0"):
        (tmp_path / name).touch()
    for folder, link, target in (
        ("by-path", "pci-usb-0:2:1.0", "ttyUSB0"),
        ("by-id", "usb-FTDI_A1", "ttyUSB0"),
        ("by-id", "usb-Arduino_B2", "ttyACM0"),
    ):
        (tmp_path / "serial" / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / "serial" / folder / link).symlink_to(tmp_path / target)
    return tmp_path


def test_every_device_is_listed_once_by_its_most_stable_name(dev: Path) -> None:
    serial_dir = dev / "serial"
    expected = [serial_dir / "by-path/pci-usb-0:2:1.0", serial_dir / "by-id/usb-Arduino_B2", dev / "ttyUSB1"]
    assert stable_ports(dev) == [str(path) for path in expected]


def test_stable_path_of_a_plain_name(dev: Path) -> None:
    assert stable_path(str(dev / "ttyUSB0"), dev) == str(dev / "serial/by-path/pci-usb-0:2:1.0")
    assert stable_path(str(dev / "ttyUSB1"), dev) == str(dev / "ttyUSB1")
    assert stable_path("/nowhere/pty", dev) == "/nowhere/pty"


def test_latency_advice_only_where_it_helps(tmp_path: Path) -> None:
    timer = tmp_path / "bus/usb-serial/devices/ttyUSB7/latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    advice = latency_advice("/dev/ttyUSB7", tmp_path)
    assert advice is not None
    assert "16 ms" in advice
    assert str(timer) in advice
    timer.write_text("1\n")
    assert latency_advice("/dev/ttyUSB7", tmp_path) is None
    assert latency_advice("/dev/ttyACM0", tmp_path) is None


@pytest.mark.parametrize(
    ("code", "text", "fix"),
    [
        (errno.EACCES, "could not open port: Permission denied", "usermod -aG"),
        (errno.EBUSY, "Device or resource busy", "fuser -v"),
        (None, "Could not exclusively lock port: [Errno 11]", "fuser -v"),
        (errno.ENOTTY, "Inappropriate ioctl for device", "cannot be opened as a serial port"),
    ],
)
def test_open_errors_name_port_and_fix(tmp_path: Path, code: int | None, text: str, fix: str) -> None:
    port = tmp_path / "ttyUSB3"
    port.touch()
    error = serial.SerialException(code, text) if code else serial.SerialException(text)
    message = explain_open_error(str(port), 2_000_000, error)
    assert message.startswith(str(port)) or str(port) in message
    assert fix in message


def test_missing_port_lists_what_is_there(tmp_path: Path) -> None:
    gone = str(tmp_path / "ttyUSB9")
    assert f"{gone} does not exist" in explain_open_error(gone, 2_000_000, OSError(errno.ENOENT, "none"))
