"""Convex pieces: they leave the counterpart its room, cover the part, and fill only what nobody reaches."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mesh_room import play_m, slack_m
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from lerobot_vtrefine.sim.mesh_pairs import load_mesh_parts
from lerobot_vtrefine.sim.mesh_pieces import Cut, cut_into_pieces
from lerobot_vtrefine.sim.mesh_skin import Surface

trimesh = pytest.importorskip("trimesh", reason="needs the assets extra")
pytest.importorskip("manifold3d", reason="needs the assets extra")

Array = NDArray[np.float64]
BORE_M, PIN_M, CAVITY_M, CAP_M, WALL_M = 0.0125, 0.0115, 0.007, 0.022, 0.017
LENGTH_M, CAP_HEIGHT_M = 0.08, 0.01
CUT = Cut()


def revolved(*profile: tuple[float, float]) -> Surface:
    mesh = trimesh.creation.revolve(np.array([*profile, profile[0]]), sections=28)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


TUBE = revolved((BORE_M, 0.0), (WALL_M, 0.0), (WALL_M, LENGTH_M), (BORE_M, LENGTH_M))
PIN = revolved(
    (CAVITY_M, 0.0),
    (PIN_M, 0.0),
    (PIN_M, LENGTH_M),
    (CAP_M, LENGTH_M),
    (CAP_M, LENGTH_M + CAP_HEIGHT_M),
    (CAVITY_M, LENGTH_M + CAP_HEIGHT_M),
)
"""Hollow, with a cap that rests on the tube: like 00446."""


@pytest.fixture(scope="module")
def tube() -> list[Array]:
    return cut_into_pieces(TUBE, PIN, CUT).fitting


@pytest.fixture(scope="module")
def pin() -> list[Array]:
    return cut_into_pieces(PIN, TUBE, CUT).fitting


def held(pieces: list[Array], points: Array) -> NDArray[np.bool_]:
    """Which points (N, 3) lie in some piece."""
    inside = np.zeros(len(points), bool)
    for piece in pieces:
        planes = ConvexHull(piece).equations
        inside |= np.all(points @ planes[:, :3].T + planes[:, 3] <= 1e-7, axis=1)
    return inside


def ring_of_points(radius_m: float) -> Array:
    """All around and along the tube."""
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 360), np.linspace(0.001, LENGTH_M - 0.001, 20))
    across = radius_m * np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate([across, height[..., None]], -1).reshape(-1, 3)


def below_the_cap() -> Array:
    """Where the tube is, around the pin."""
    beside = ring_of_points((PIN_M + CAP_M) / 2)
    return beside[beside[:, 2] < LENGTH_M - 0.005]


def test_play_is_that_of_the_surfaces(tube: list[Array], pin: list[Array]) -> None:
    assert play_m(pin, tube) == pytest.approx(
        BORE_M - PIN_M, abs=4e-4
    )  # overlap that is no contact, and the step
    assert slack_m(pin, tube) < 1e-3


def test_pieces_do_not_narrow_the_bore(tube: list[Array]) -> None:
    edge = BORE_M * np.cos(np.pi / 28)  # the drawn bore is a polygon
    assert not held(tube, ring_of_points(edge - CUT.skin.touched_m)).any()


def test_pieces_cover_the_part(tube: list[Array], pin: list[Array]) -> None:
    assert held(tube, ring_of_points((BORE_M + WALL_M) / 2)).all()
    assert held(pin, ring_of_points((CAVITY_M + PIN_M) / 2)).all()


def test_a_cavity_that_nobody_reaches_fills_up(pin: list[Array]) -> None:
    assert held(pin, ring_of_points(CAVITY_M / 2)).all()
    assert len(pin) < 20
    assert not held(pin, below_the_cap()).any()


def test_a_limit_on_pieces_is_kept() -> None:
    assert len(cut_into_pieces(TUBE, PIN, replace(CUT, most=6)).fitting) <= 6


def test_a_convex_part_stays_whole() -> None:
    rod = revolved((0.0, 0.0), (PIN_M, 0.0), (PIN_M, LENGTH_M), (0.0, LENGTH_M))
    pieces = cut_into_pieces(rod, TUBE, CUT)
    assert (len(pieces.fitting), len(pieces.sides)) == (1, 1)


def test_hands_meet_few_pieces_that_follow_the_outside() -> None:
    assert len(cut_into_pieces(TUBE, PIN, CUT).sides) == 1  # with its bore filled
    pieces = cut_into_pieces(PIN, TUBE, CUT)
    cap_and_stem = pieces.sides
    assert 2 <= len(cap_and_stem) <= len(pieces.fitting) / 2
    assert held(cap_and_stem, ring_of_points(PIN_M - 1e-3)).all()
    assert not held(cap_and_stem, below_the_cap()).any()


def test_a_cap_is_gripped_at_its_edge_and_a_bar_in_the_middle_of_its_free_end(tmp_path: Path) -> None:
    solids = {"plug": PIN, "socket": TUBE}
    bar = revolved((0.0, 0.0), (PIN_M, 0.0), (PIN_M, 1.5 * LENGTH_M), (0.0, 1.5 * LENGTH_M))
    for name, surfaces in (("cap", solids), ("bar", solids | {"plug": bar})):
        for role, surface in surfaces.items():
            trimesh.Trimesh(*surface).export(tmp_path / f"{name}_{role}.obj")
    cap, bar_pair = (load_mesh_parts(f"automate/{name}", tmp_path, "unit") for name in ("cap", "bar"))
    assert cap.plug.grip.centre_m[2] == pytest.approx(LENGTH_M + CAP_HEIGHT_M / 2, abs=1e-3)
    assert cap.plug.grip.half_size_m[0] == pytest.approx(CAP_M, abs=5e-4)
    assert bar_pair.plug.grip.centre_m[2] == pytest.approx(1.5 * LENGTH_M - 0.020, abs=1e-3)
    assert bar_pair.plug.grip.half_size_m[0] == pytest.approx(PIN_M, abs=5e-4)


def test_what_is_wide_within_the_socket_is_not_gripped(tmp_path: Path) -> None:
    collar, stem, top = 0.015, 0.0115, LENGTH_M + 0.022
    plug = revolved((0, 0.01), (collar, 0.01), (collar, 0.079), (stem, 0.079), (stem, top), (0, top))
    socket = revolved((0.016, 0.0), (0.02, 0.0), (0.02, LENGTH_M), (0.016, LENGTH_M))
    for role, surface in (("plug", plug), ("socket", socket)):
        trimesh.Trimesh(*surface).export(tmp_path / f"collar_{role}.obj")
    grip = load_mesh_parts("automate/collar", tmp_path, "unit").plug.grip
    assert grip.centre_m[2] == pytest.approx((LENGTH_M + top) / 2, abs=1e-3)
    assert grip.half_size_m[0] == pytest.approx(stem, abs=5e-4)
