"""Pad lattices: frames, the paper's placement on a mesh, and meshes that cannot carry one."""

import numpy as np
import pytest

from lerobot_vtrefine.tactile import PadLayout, layout_from_mesh

BOX_FACES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
)


def box_vertices(size: tuple[float, float, float]) -> np.ndarray:
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return corners * size


def test_positions_are_row_major_and_centred() -> None:
    layout = PadLayout(3, 4, 0.002)
    grid = layout.positions().reshape(3, 4, 3)
    assert np.allclose(grid[1, 2] - grid[1, 1], [0.002, 0, 0])
    assert np.allclose(grid[2, 1] - grid[1, 1], [0, 0.002, 0])
    assert np.allclose(grid.mean(axis=(0, 1)), 0)


def test_lattice_on_the_real_pads_size_has_the_papers_margins() -> None:
    vertices = box_vertices((0.026, 0.003, 0.06665))
    layout = layout_from_mesh(vertices, BOX_FACES, PadLayout(), outward=np.array([0, -1, 0]))
    points = layout.mesh_positions()
    assert np.allclose(points[:, 1], -0.0015)
    assert np.allclose(np.ptp(points[:, 0]), 0.022)
    assert np.allclose(np.ptp(points[:, 2]), 0.062)
    axes = np.array(layout.mesh_axes)
    assert np.allclose(axes.T @ axes, np.eye(3))
    assert np.isclose(np.linalg.det(axes), 1)
    assert np.allclose(axes[:, 2], [0, -1, 0])


def test_flat_side_is_found_when_the_other_is_not_flat() -> None:
    vertices = np.vstack([box_vertices((0.068, 0.026, 0.003)), [[0, 0, 0.004]]])
    roof = [face for face in BOX_FACES.tolist() if not {1, 3, 5, 7}.issuperset(face)]
    roof += [[1, 5, 8], [5, 7, 8], [7, 3, 8], [3, 1, 8]]
    assert np.allclose(
        np.array(layout_from_mesh(vertices, np.array(roof), PadLayout()).mesh_axes)[:, 2], [0, 0, -1]
    )
    with pytest.raises(ValueError, match=r"no flat face"):
        layout_from_mesh(vertices, np.array(roof), PadLayout(), outward=np.array([0, 0, 1]))


def test_too_small_and_malformed_meshes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"need 64.0 x 24.0 mm"):
        layout_from_mesh(box_vertices((0.06, 0.026, 0.003)), BOX_FACES, PadLayout())
    with pytest.raises(ValueError, match=r"triangles"):
        layout_from_mesh(box_vertices((0.07, 0.026, 0.003)), np.zeros((0, 3), int), PadLayout())
    with pytest.raises(ValueError, match=r"pitch_m"):
        PadLayout(pitch_m=-1.0)
