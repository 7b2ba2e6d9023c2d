"""The driver against the PyPI package `flexitac`, on the same emulated boards: losses, age, processor time.

The emulator runs in its own process and sends test-pattern frames, which carry their number, send time and
checksum: every frame received is checked for itself. `python -m lerobot_vtrefine.drivers.benchmark 60`
measures each part for a minute and says how busy the machine was.
"""

import importlib
import importlib.util
import logging
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.drivers.board import PadReader
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.frames import MARKER, STREAM_BAUD, FrameShape
from lerobot_vtrefine.drivers.framing import BinaryFramer
from lerobot_vtrefine.drivers.sources import check_pattern

logger = logging.getLogger(__name__)

Row = tuple[str, float, str]

SHORT_S = 4.0
"""Default length of each measurement [s]."""

SAMPLE_S = 0.0073
"""Time between looks at the latest frame; no divisor of the frame period, so that all ages are met."""

CONTROL_S = 1 / 30
"""Time between looks in the processor-time measurement: a robot's control period."""

START_TIMEOUT_S = 60.0
"""Starting Python takes long on a busy machine."""

_EMULATOR = """
import sys, types
package = types.ModuleType("lerobot_vtrefine")  # the real one would import LeRobot and PyTorch first
package.__path__ = [sys.argv.pop(1)]
sys.modules["lerobot_vtrefine"] = package
from lerobot_vtrefine.cli.pad_emulator import main
sys.exit(main())
"""


@dataclass(frozen=True)
class Tally:
    """What one reader made of a stream.

    Attributes:
        frames: Frames received.
        corrupt: Of these, frames whose checksum fails.
        missing: Frame numbers skipped between the first and the last.
        ages_ms: Age of the latest frame at every look, by the send time in the frame [ms].
        cpu_share: Processor time of this process per second.
    """

    frames: int
    corrupt: int
    missing: int
    ages_ms: np.ndarray
    cpu_share: float

    def age(self) -> str:
        """Median and 99th percentile as text."""
        if not len(self.ages_ms):
            return "no frame"
        return f"{np.median(self.ages_ms):.1f} ms (p99 {np.percentile(self.ages_ms, 99):.1f} ms)"


@contextmanager
def emulator(boards: int, loss: float = 0.0) -> Generator[list[str]]:
    """Ports of boards emulated by another process at 100 frames/s.

    Raises:
        RuntimeError: the process ended early; the message holds what it said.
    """
    with tempfile.TemporaryDirectory() as folder:
        flags = ["--folder", folder, "--boards", str(boards), "--source", "pattern", "--loss", str(loss)]
        process = subprocess.Popen(
            [sys.executable, "-c", _EMULATOR, str(Path(__file__).parents[1]), *flags],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            yield _ports(process, Path(folder), boards)
        finally:
            process.terminate()
            process.communicate()


def _ports(process: "subprocess.Popen[str]", folder: Path, boards: int) -> list[str]:
    deadline = time.monotonic() + START_TIMEOUT_S
    while len(ports := sorted(map(str, folder.iterdir()))) < boards:
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            raise RuntimeError(f"the pad emulator did not start: {process.communicate()[1][-500:]}")
        time.sleep(0.05)
    return ports


def read_ours(ports: list[str], seconds: float, look_s: float) -> list[Tally]:
    """Read boards for a while, looking at the latest frames every `look_s`."""
    with ExitStack() as stack:
        readers = [PadReader(PadConfig(port), Path(port).name) for port in ports]
        for reader in readers:
            reader.connect(timeout_s=30.0)
            stack.callback(reader.stop)
        seen = [-1] * len(readers)
        checks: list[list[tuple[int, int] | None]] = [[] for _ in readers]
        ages: list[list[float]] = [[] for _ in readers]
        started, cpu = time.monotonic(), time.process_time()
        while time.monotonic() - started < seconds:
            time.sleep(look_s)
            for index, reader in enumerate(readers):
                latest = reader.latest()
                sent = check_pattern(latest.raw) if latest is not None else None
                if sent is not None:
                    ages[index].append((time.monotonic_ns() - sent[1]) / 1e6)
                new = reader.frames_after(seen[index])
                checks[index] += [check_pattern(frame.raw) for frame in new]
                seen[index] = new[-1].seq if new else seen[index]
        share = (time.process_time() - cpu) / (time.monotonic() - started)
    return [tally(found, age, share) for found, age in zip(checks, ages, strict=True)]


def read_reference(port: str, seconds: float, method: str) -> Tally:
    """Read one board with `flexitac`, by its method "read" (every frame) or "read_latest"."""
    flexitac: Any = importlib.import_module("flexitac")

    sensor: Any = flexitac.FlexiTacSensor(port, baseline=20.0)
    with sensor:
        step: Callable[[], Any] = getattr(sensor, method)
        checks: list[tuple[int, int] | None] = []
        ages: list[float] = []
        started, cpu = time.monotonic(), time.process_time()
        while time.monotonic() - started < seconds:
            if method == "read_latest":
                time.sleep(SAMPLE_S)
            sent = check_pattern(step().raw)
            checks.append(sent)
            ages += [(time.monotonic_ns() - sent[1]) / 1e6] if sent is not None else []
        share = (time.process_time() - cpu) / (time.monotonic() - started)
    return tally(checks, ages, share)


def tally(checks: list[tuple[int, int] | None], ages_ms: list[float], share: float) -> Tally:
    """Counts what came out."""
    numbers = sorted({check[0] for check in checks if check is not None})
    missing = numbers[-1] - numbers[0] + 1 - len(numbers) if numbers else 0
    return Tally(len(checks), checks.count(None), missing, np.array(ages_ms), share)


def run(seconds: float = SHORT_S) -> list[Row]:
    """Rows (what, ratio, explanation) for `vtrefine-bench`; ratios are ours to flexitac's unless they say
    otherwise.

    Args:
        seconds: Length of each of the six measurements [s].
    """
    reference = importlib.util.find_spec("flexitac") is not None
    if not reference:
        logger.warning("the package flexitac is not installed: pads are measured without comparison")
    rows: list[Row] = []
    with emulator(1) as (port,):
        rows += clean_rows(port, seconds, reference)
    with emulator(1, loss=0.001) as (port,):
        rows.append(lossy_row(port, seconds, reference, "0.1 %"))
    with emulator(1, loss=0.01) as (port,):
        rows.append(lossy_row(port, seconds, reference, "1 %"))
    with emulator(4) as ports:
        four = read_ours(ports, seconds, CONTROL_S)
    bad = sum(one.missing + one.corrupt for one in four)
    text = f"of one core, every frame of four boards, 30 looks/s; {bad} frames lost or corrupt"
    return [*rows, ("pads: processor share, four boards", four[0].cpu_share, text), parser_row()]


def clean_rows(port: str, seconds: float, reference: bool) -> list[Row]:
    """Completeness and age on a stream without losses."""
    (ours,) = read_ours([port], seconds, SAMPLE_S)
    text = f"{ours.frames} frames, {ours.missing} lost, {ours.corrupt} corrupt"
    age = f"ours {ours.age()}"
    ratio = float("nan")
    if reference:
        every, newest = read_reference(port, seconds, "read"), read_reference(port, seconds, "read_latest")
        text += f"; flexitac.read: {every.frames} frames, {every.age()} old"
        age += f", flexitac.read_latest {newest.age()}"
        ratio = float(np.median(newest.ages_ms) / np.median(ours.ages_ms))
    complete = ours.frames / max(1, ours.frames + ours.missing + ours.corrupt)
    return [
        ("pads: share of frames received intact, 100 frames/s", complete, text),
        ("pads: age of the latest frame, flexitac to ours", ratio, age),
    ]


def lossy_row(port: str, seconds: float, reference: bool, loss: str) -> Row:
    """Corrupt frames under lost bytes."""
    (ours,) = read_ours([port], seconds, SAMPLE_S)
    text = f"{ours.frames} frames handed out, {ours.corrupt} corrupt"
    if reference:
        theirs = read_reference(port, seconds, "read_latest")
        text += f"; flexitac.read_latest: {theirs.frames} frames, {theirs.corrupt} corrupt"
    return f"pads: corrupt frames, {loss} of bytes lost", float(ours.corrupt), text


def hard_streams(shape: FrameShape, frames: int) -> dict[str, bytes]:
    """Streams without a pause, from the middle of a frame on, that may keep a parser busy."""
    rng = np.random.default_rng(0)
    size = (frames, shape.taxels)
    marker = np.frombuffer(MARKER, np.uint8)
    idle = rng.integers(10, 40, size, dtype=np.uint8)
    half = idle.copy()
    half[:, shape.taxels // 2 - 1 : shape.taxels // 2 + 1] = marker
    payloads = {
        "idle": idle,
        "random bytes": rng.integers(0, 256, size, dtype=np.uint8),
        "many markers": rng.choice(np.array([*marker, 0, 1], np.uint8), size),
        "markers only": np.resize(marker, size),
        "frames at another alignment": half,
    }
    header = np.broadcast_to(marker, (frames, 2))
    streams = {name: np.hstack([header, body]).tobytes()[99:] for name, body in payloads.items()}
    return {**streams, "no frames": rng.integers(0, 256, size, dtype=np.uint8).tobytes()}


def parser_row() -> Row:
    """Processor time of the parser per second of the worst stream, in packets as USB brings them."""
    shape, packet, bytes_per_s = FrameShape(12, 32), 62, STREAM_BAUD / 10
    shares: dict[str, float] = {}
    for name, data in hard_streams(shape, frames=200).items():
        framer, started = BinaryFramer(shape), time.process_time()
        for at in range(0, len(data), packet):
            framer.feed(data[at : at + packet])
        shares[name] = (time.process_time() - started) / (len(data) / bytes_per_s)
    text = ", ".join(f"{name} {share:.2f}" for name, share in shares.items())
    return "pads: processor share of the parser, worst stream at 2 Mbaud", max(shares.values()), text


def main(seconds: float) -> None:
    """Write the rows and the machine's load to standard output."""
    before = os.getloadavg()[0]
    for name, value, explanation in run(seconds):
        sys.stdout.write(f"{name}: {value:.3g} ({explanation})\n")
    load = f"{before:.1f} before, {os.getloadavg()[0]:.1f} after"
    sys.stdout.write(f"load average of {os.cpu_count()} processors: {load}\n")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else SHORT_S)
