"""A ring (plug) over a post with a foot (socket), as meshes in millimetres."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

RING_HOLE_M, POST_M, RING_BOTTOM_M, RING_TOP_M, POST_TOP_M = 0.0125, 0.0105, 0.020, 0.035, 0.050


@contextmanager
def folder_with_ring(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with ring_plug.obj and ring_socket.obj; what is made of them is cached there, too."""
    folder = tmp_path_factory.mktemp("meshes")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        _write(folder)
        yield folder


def _write(folder: Path) -> None:
    import trimesh  # of the assets extra

    ring = trimesh.creation.annulus(RING_HOLE_M, 0.022, RING_TOP_M - RING_BOTTOM_M, sections=24)
    ring.apply_translation([0, 0, (RING_TOP_M + RING_BOTTOM_M) / 2])
    ring.apply_scale(1000)
    ring.export(folder / "ring_plug.obj")
    profile = [  # of a post that stands on a wide foot, which stops the ring
        (0, 0),
        (0.02, 0),
        (0.02, RING_BOTTOM_M),
        (POST_M, RING_BOTTOM_M),
        (POST_M, POST_TOP_M),
        (0, POST_TOP_M),
    ]
    trimesh.creation.revolve(1000 * np.array(profile), sections=24).export(folder / "ring_socket.obj")
