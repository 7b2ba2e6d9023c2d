"""Pictures and videos as data URIs, so that the page needs no other file."""

from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as pq
from PIL import Image

from lerobot_vtrefine.datasets.features import BASELINE_PREFIX, TACTILE_PREFIX, Array
from lerobot_vtrefine.embodiments import pad_layout_of
from lerobot_vtrefine.pages.pads import encode

MIME = {".mp4": "video/mp4", ".webm": "video/webm", ".png": "image/png", ".gif": "image/gif"}


def data_uri(path: Path) -> str:
    """The file at ``path`` as a ``data:`` URI.

    Raises:
        ValueError: the suffix is not one that a browser shows.
    """
    if path.suffix not in MIME:
        raise ValueError(f"cannot embed {path}: suffix is not one of {', '.join(MIME)}")
    return encode(path.read_bytes(), MIME[path.suffix])


def strongest_contact(dataset_root: Path) -> dict[str, Array]:
    """Counts above the baseline of the frame with the strongest contact in a dataset's first data file.

    Returns:
        Pad name -> int array (rows, columns), in the order of the dataset's columns.

    Raises:
        FileNotFoundError: there is no data file below ``dataset_root``.
    """
    files = sorted((dataset_root / "data").rglob("*.parquet"))
    if not files:
        raise FileNotFoundError(f"no recorded frames below {dataset_root / 'data'}")
    names = pq.read_schema(files[0]).names
    pads = [name.removeprefix(TACTILE_PREFIX) for name in names if name.startswith(TACTILE_PREFIX)]
    keys = [f"{prefix}{pad}" for pad in pads for prefix in (TACTILE_PREFIX, BASELINE_PREFIX)]
    table = pq.read_table(files[0], columns=keys)
    counts = [np.stack(table[key].to_numpy(zero_copy_only=False)).astype(int) for key in keys]
    pressed = [np.abs(now - idle) for now, idle in zip(counts[::2], counts[1::2], strict=True)]
    frame = int(np.argmax(sum(values.sum(axis=1) for values in pressed)))
    layouts = [pad_layout_of(pad) for pad in pads]
    return {
        pad: values[frame].reshape(layout.rows, layout.cols)
        for pad, values, layout in zip(pads, pressed, layouts, strict=True)
    }


def shortened(video: Path, width: int, every: int) -> tuple[list[Image.Image], int]:
    """Every ``every``-th frame of a video and its last one, ``width`` pixels wide; milliseconds of each."""
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        rate = float(stream.average_rate or 10)
        frames = [frame.to_image() for frame in container.decode(stream)][::-every][::-1]
    height = round(frames[0].height * width / frames[0].width)
    small = [frame.resize((width, height), Image.Resampling.LANCZOS) for frame in frames]
    return small, round(1000 * every / rate)
