"""Where one more target may stand: sides that the station sees, not the docking face, nothing behind an obstacle."""

import numpy as np

from docking.candidates import EDGE_POINTS, Box, hidden, places
from docking.geometry import euler_to_matrix
from docking.types import Pose

AT = Pose(euler_to_matrix(0.0, 0.0, 0.5), np.array([1000.0, 2000.0, 500.0]))
BOX = Box(AT, np.array([-400.0, -250.0, -170.0]), np.array([450.0, 250.0, 170.0]))
FORWARD = np.array([1.0, 0.0, 0.0])


def seen_from(x: float, y: float, z: float, *obstacles: Box) -> set[tuple[int, ...]]:
    """The sides that carry places when the station stands there, in the frame of the box."""
    found = places(BOX, AT.apply([x, y, z]), FORWARD, obstacles)
    assert np.all((found.xyz_mm >= BOX.low_mm - 1e-9) & (found.xyz_mm <= BOX.high_mm + 1e-9))
    return {tuple(int(v) for v in normal) for normal in found.normal}


def test_only_sides_towards_the_station_are_seen() -> None:
    assert seen_from(0, -3000, 0) == {(0, -1, 0)}
    assert seen_from(0, 3000, 2000) == {(0, 1, 0), (0, 0, 1)}
    assert seen_from(-3000, -3000, 0) == {(-1, 0, 0), (0, -1, 0)}
    assert len(places(BOX, AT.apply([0, -3000, 0]), FORWARD, ()).xyz_mm) == EDGE_POINTS**2


def test_the_docking_face_is_never_a_place() -> None:
    assert seen_from(3000, -10, 0) == set()
    assert seen_from(3000, -3000, 0) == {(0, -1, 0)}


def test_a_side_seen_too_flat_is_not_a_place() -> None:
    assert seen_from(-200, -5000, 170 + 500) == {(0, -1, 0)}


def test_what_stands_behind_an_obstacle_is_hidden() -> None:
    wall = Box(AT, np.array([0.0, -1500.0, -2000.0]), np.array([3000.0, -1400.0, 2000.0]))
    all_ = places(BOX, AT.apply([0, -3000, 0]), FORWARD, ())
    free = places(BOX, AT.apply([0, -3000, 0]), FORWARD, [wall])
    assert 0 < len(free.xyz_mm) < len(all_.xyz_mm)
    assert np.max(free.xyz_mm[:, 0]) < 5.0
    points = AT.apply([[100.0, -1600.0, 0.0], [100.0, -1300.0, 0.0], [100.0, -1450.0, 0.0], [-900.0, 0.0, 0.0]])
    assert hidden(wall, AT.apply([0, -3000, 0]), points).tolist() == [False, True, True, False]
