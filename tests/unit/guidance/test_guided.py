"""Guided search: a projected point takes the feature that looks like it, near by, on its level, and alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from docking.guidance import guided
from docking.guidance.features import Features
from docking.guidance.guided import Visible
from docking.guidance.localiser import LocaliseSettings
from docking.guidance.types import ArMap
from tests.support.marked_wall import marked_wall


@pytest.fixture(scope="module")
def ar_map() -> ArMap:
    return marked_wall(2, 40).free


def looked_for(ar_map: ArMap, shift_px: float, octaves: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Ten points whose features lie `shift_px` beside their projections, far from each other."""
    points = np.arange(10)
    pixels = np.column_stack([80.0 * points + 40.0, np.full(10, 200.0)])
    features = Features(pixels + np.array([0.0, shift_px]), np.full(10, octaves, np.int32), ar_map.descriptors[points])
    return guided.search(ar_map, Visible(points, pixels, np.zeros(10)), features, LocaliseSettings().radius_px)


def test_a_feature_is_found_within_eight_pixels_and_not_beyond(ar_map: ArMap) -> None:
    rows, points = looked_for(ar_map, 7.5)
    assert rows.tolist() == points.tolist() == list(range(10))
    assert len(looked_for(ar_map, 8.5)[0]) == 0


def test_a_feature_on_another_level_of_the_pyramid_is_another(ar_map: ArMap) -> None:
    assert len(looked_for(ar_map, 1.0, octaves=1)[0]) == 10
    assert len(looked_for(ar_map, 1.0, octaves=2)[0]) == 0


def test_of_two_points_that_want_a_feature_the_one_that_looks_like_it_has_it(ar_map: ArMap) -> None:
    alike = ar_map.descriptors.copy()
    alike[1] = alike[0] ^ np.eye(32, dtype=np.uint8)[0]
    twins = replace(ar_map, descriptors=alike)
    wanted = Visible(np.array([1, 0]), np.array([[100.0, 100.0], [103.0, 100.0]]), np.zeros(2))
    features = Features(np.array([[101.0, 100.0]]), np.zeros(1, np.int32), alike[:1])
    rows, points = guided.search(twins, wanted, features, 8.0)
    assert (rows.tolist(), points.tolist()) == ([0], [0])
