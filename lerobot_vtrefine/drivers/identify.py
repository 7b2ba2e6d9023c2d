"""What kind of stream a sample of bytes is, so that an error can name the fix."""

from dataclasses import dataclass

from lerobot_vtrefine.drivers.ascii import AsciiFramer, LineBuffer, parse_diagnostic
from lerobot_vtrefine.drivers.frames import DIAGNOSTIC_BAUD, KNOWN_SHAPES, MARKER, STREAM_BAUD, FrameShape
from lerobot_vtrefine.drivers.framing import BinaryFramer

SAMPLE_BYTES = 16_384
"""Enough for several frames of every known shape, as ASCII too."""


@dataclass(frozen=True)
class StreamKind:
    """A recognised stream: protocol "binary", "ascii" or "diagnostic", and its frame shape where it has
    one."""

    protocol: str
    shape: FrameShape | None

    def __str__(self) -> str:
        return f"{self.protocol} {self.shape}" if self.shape else self.protocol


def identify_stream(sample: bytes) -> StreamKind | None:
    """The kind of stream that these bytes are part of; None where nothing is recognised."""
    for shape in KNOWN_SHAPES:
        framer = BinaryFramer(shape)
        framer.feed(sample)
        if framer.stats.frames_out >= 2:
            return StreamKind("binary", shape)
    lines = LineBuffer().feed(sample)
    if any(parse_diagnostic(line) for line in lines):
        return StreamKind("diagnostic", None)
    for shape in KNOWN_SHAPES:
        ascii_framer = AsciiFramer(shape)
        ascii_framer.feed(sample)
        if ascii_framer.stats.frames_out:
            return StreamKind("ascii", shape)
    return None


def explain_diagnostic(sample: bytes, port: str) -> str:
    """Why no reading of the diagnostic firmware came out of these bytes of a port, and what to do.

    Streaming firmware sends at another baud rate, so its bytes arrive here as any others.
    """
    if not sample:
        return (
            f"no data at {DIAGNOSTIC_BAUD} baud: is the board powered, and flashed with diagnostic firmware?"
        )
    kind = identify_stream(sample)
    what = f"the board sends {kind} frames" if kind else f"{len(sample)} bytes came that are no text"
    shown = "vtrefine-find-pads finds out how to show it"
    if kind is not None and kind.protocol == "binary" and kind.shape is not None:
        shown = (
            f"vtrefine-view-pads --ports {port} --rows {kind.shape.rows} --cols {kind.shape.cols} shows it"
        )
    return f"{what}, as of streaming firmware: {shown}; single taxels need the diagnostic firmware"


def explain_stream(sample: bytes, wanted: StreamKind, baud: int) -> str:
    """Why no frame came out of these bytes, and what to do; `wanted` is what was configured."""
    if not sample:
        return (
            f"no data at {baud} baud: is the board powered, and flashed with streaming firmware? "
            "(the diagnostic firmware is silent at this baud rate or answers at 115200)"
        )
    kind = identify_stream(sample)
    if kind == wanted:
        return "the stream breaks all the time: bytes are being lost; check the cable and the hub"
    if kind is not None and kind.protocol == "diagnostic":
        return "the board runs the diagnostic text firmware; flash the streaming firmware"
    if kind is not None and kind.shape is not None:
        return (
            f"wrong shape: the board sends {kind} frames, not {wanted}; "
            f"set rows: {kind.shape.rows}, cols: {kind.shape.cols}, protocol: {kind.protocol}"
        )
    if sample.count(MARKER) >= len(sample) // (2 * KNOWN_SHAPES[0].period):
        apart = f"{wanted.shape.period} bytes apart" if wanted.shape else "as any known frame has them"
        return (
            f"frame markers come, but not {apart} and alone: bytes are being lost, or a "
            "motionless pattern imitates the marker; touch the pad, then check the cable"
        )
    other = STREAM_BAUD if baud != STREAM_BAUD else DIAGNOSTIC_BAUD
    return (
        f"{len(sample)} bytes came that are not FlexiTac frames: wrong baud rate ({baud}; try {other}), "
        "or another device"
    )
