"""Reader of recording sets and the heights of indenters."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_vtrefine.diagnose.pad.indenters import trial_forces, trial_heights
from lerobot_vtrefine.diagnose.recordings import read_recording_set
from lerobot_vtrefine.tactile.layout import PadLayout

LAYOUT = PadLayout(3, 4, 0.002)


def write_set(folder: Path, columns: dict | None = None, drop: tuple[str, ...] = (), **header) -> Path:
    frames = 5
    table = {
        "time_s": np.arange(frames) / 30,
        "x_m": np.full(frames, 0.001),
        "y_m": np.zeros(frames),
        "depth_m": np.linspace(-1e-3, 1e-3, frames),
        "force_n": np.linspace(0, 12, frames),
        "raw": np.arange(frames * 12.0).reshape(frames, 12).tolist(),
    } | (columns or {})
    pq.write_table(pa.table({k: v for k, v in table.items() if k not in drop}), folder / "t.parquet")
    text = {
        "schema": "vtrefine/recording-set@1",
        "kind": "pad",
        "pad": {"rows": 3, "cols": 4, "pitch_m": 0.002},
        "reading": {"unit": "adc_counts", "full_scale": 255.0},
        "object": {"shape": "sphere", "radius_m": 0.01},
        "trials": [{"file": "t.parquet", "condition": "c", "replicate": 0, "order": 0, "start_s": 2.0}],
    } | header
    (folder / "recording.json").write_text(json.dumps(text))
    return folder


def test_a_set_is_read(tmp_path: Path) -> None:
    trial = read_recording_set(write_set(tmp_path)).trials[0]
    assert trial.raw.shape == (5, 12)
    assert trial.raw[2, 3] == 27.0
    assert trial.start_s == 2.0
    assert not trial.tilt_x_rad.any()
    assert trial.temperature_c is None


@pytest.mark.parametrize(
    ("columns", "drop", "header", "message"),
    [
        ({}, ("raw",), {}, r"t\.parquet: trial 0: column raw: is missing"),
        ({"raw": [[1.0, 2.0]] * 5}, (), {}, "column raw: frame 0 has 2 values, expected 12"),
        ({}, ("depth_m", "force_n"), {}, "column depth_m: needs depth_m or force_n"),
        ({"time_s": ["a"] * 5}, (), {}, "column time_s: must hold numbers"),
        ({}, (), {"schema": "x"}, 'recording.json: "schema" must be'),
        ({}, (), {"object": {"shape": "cone"}}, "object.shape must be one of sphere"),
        ({}, (), {"object": {"shape": "flat", "size_m": [0.1]}}, "object.size_m must hold 2 values"),
        ({}, (), {"pad": {"rows": 2.5, "cols": 1, "pitch_m": 0.002}}, "pad.rows must be a whole number"),
        ({}, (), {"trials": []}, "at least one trial"),
    ],
)
def test_what_is_wrong_is_named(
    tmp_path: Path, columns: dict, drop: tuple[str, ...], header: dict, message: str
) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        read_recording_set(write_set(tmp_path, columns, drop, **header))
    assert "\n" not in str(caught.value)


def test_a_broken_file_is_named(tmp_path: Path) -> None:
    write_set(tmp_path)
    (tmp_path / "t.parquet").write_bytes(b"no parquet")
    with pytest.raises(ValueError, match=r"t\.parquet: trial 0: not a readable Parquet file"):
        read_recording_set(tmp_path)


def one(tmp_path: Path, columns: dict | None = None, drop: tuple[str, ...] = (), **header):
    return read_recording_set(write_set(tmp_path, columns, drop, **header)).trials[0]


def test_sphere_heights_are_exact(tmp_path: Path) -> None:
    heights = trial_heights(one(tmp_path), LAYOUT)
    assert heights[-1, 1, 2] == pytest.approx(1e-3)  # the taxel at x = 1 mm lies under the pole
    off = np.hypot(2e-3, 2e-3)
    assert heights[-1, 0, 1] == pytest.approx(1e-3 - (0.01 - np.sqrt(0.01**2 - off**2)))


def test_flat_punch_covers_its_outline_edges_included(tmp_path: Path) -> None:
    heights = trial_heights(one(tmp_path, object={"shape": "flat", "size_m": [0.004, 0.002]}), LAYOUT)
    assert (heights[-1] > -0.5).tolist() == [[False] * 4, [False, True, True, True], [False] * 4]
    assert heights[-1, 1, 3] == pytest.approx(1e-3)


def test_tilted_punch_touches_with_its_lowest_corner(tmp_path: Path) -> None:
    tilt = {"tilt_y_rad": np.full(5, 0.02)}  # about +y: the side of larger x goes down
    heights = trial_heights(one(tmp_path, tilt, object={"shape": "flat", "size_m": [0.004, 0.002]}), LAYOUT)
    assert heights[-1, 1, 3] == pytest.approx(1e-3, abs=2e-8)
    assert heights[-1, 1, 2] == pytest.approx(1e-3 - 0.02 * 2e-3, abs=2e-8)


def test_mesh_of_a_punch_equals_the_punch(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box(extents=(0.0045, 0.0025, 0.01)).export(tmp_path / "box.obj")
    tilt = {"tilt_x_rad": np.full(5, 0.01), "tilt_y_rad": np.full(5, -0.02)}
    mesh = trial_heights(one(tmp_path, tilt, object={"shape": "mesh", "file": "box.obj"}), LAYOUT)
    punch = trial_heights(one(tmp_path, tilt, object={"shape": "flat", "size_m": [0.0045, 0.0025]}), LAYOUT)
    over = punch > -0.5
    assert over[-1].sum() == 3
    assert np.allclose(mesh[over], punch[over], atol=1e-5)  # the mesh turns about its centre, not its end


def test_load_is_shared_by_the_taxels_under_the_indenter(tmp_path: Path) -> None:
    trial = one(tmp_path, drop=("depth_m",), object={"shape": "cylinder", "radius_m": 0.002})
    force = trial_forces(trial, LAYOUT)
    assert force[-1].sum() == pytest.approx(12.0)
    assert (force[-1] > 0).sum() == 5
    assert force[-1, 1, 2] == pytest.approx(12 / 5)
