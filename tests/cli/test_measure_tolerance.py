"""How precisely one must know where things are: a row for each task, also of pairs from meshes."""

from pathlib import Path

import measure_tolerance as script
import numpy as np
import pytest

from lerobot_vtrefine.cli.results.rows import read_rows
from lerobot_vtrefine.information.tolerance import LATERAL, TILT, Tolerated


def test_a_task_of_meshes_becomes_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def tolerance(config, episodes, envs, told):
        asked.append((config.scene_config.pair, config.scene_config.mesh_dir, config.backend, episodes, envs))
        return [Tolerated(LATERAL, 0.0015, (3, 4)), Tolerated(TILT, float(np.radians(2.0)), (4, 4))]

    monkeypatch.setattr(script, "tolerance", tolerance)
    flags = ["--mesh_dir", tmp_path, "--episodes=4", "--num_envs=2", "--results", tmp_path / "rows.json"]
    monkeypatch.setattr("sys.argv", ["measure_tolerance.py", "automate_00186", *map(str, flags)])
    assert not script.main()
    assert asked == [("automate/00186", tmp_path, "batch", 4, 2)]
    (row,) = read_rows(tmp_path / "rows.json")
    assert row.cells["expert's error, per axis"] == "automate_00186"
    assert row.cells["1.5 mm"].startswith("75 [")
    assert row.cells["2°"].startswith("100 [")
