"""COLMAP's own program reads what is exported, writes what is imported, and adjusts to the same cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="the extra colmap is not installed")

import pycolmap

from docking.guidance.bundle import adjust
from docking.guidance.colmap_files import read_model, write_model
from tests.bench.bundle_adjustment import bundle_of, peer_of, start_map
from tests.support.marked_wall import marked_wall


def test_the_adjustment_ends_where_colmap_ends() -> None:
    ar_map = start_map(12, 900, 4000)
    held = np.zeros(12, bool)
    held[[0, 6]] = True
    done = adjust(bundle_of(ar_map, held), 50, 1e-10)
    peer = peer_of(ar_map, held, 1)
    assert peer is not None
    peer.options.ceres.solver_options.function_tolerance = 1e-10
    model = peer.solve()
    mine = np.array([-R.T @ t for R, t in zip(done.R, done.t, strict=True)])
    theirs = np.array([model.images[k + 1].projection_center() for k in range(12)])
    start = np.array([frame.X_WC.t_mm for frame in ar_map.keyframes])
    assert np.abs(mine - theirs).max() < 0.05
    assert np.abs(mine - start).max() > 1.0


def test_models_go_both_ways(tmp_path: Path) -> None:
    ar_map = marked_wall(4, 200).free
    write_model(ar_map, tmp_path)
    model = pycolmap.Reconstruction()
    model.read_text(tmp_path)
    assert model.num_points3D() == len(np.unique(ar_map.observations()[1]))
    assert model.compute_num_observations() == len(ar_map.observations()[0])
    # The pixel that COLMAP's camera projects to is half a pixel further right and down than ours.
    frame, feature = ar_map.keyframes[1], int(np.flatnonzero(ar_map.keyframes[1].landmarks >= 0)[0])
    image = model.images[2]
    point = ar_map.points_mm[frame.landmarks[feature]]
    seen = model.cameras[1].img_from_cam(image.cam_from_world() * point)
    assert np.allclose(np.asarray(seen).ravel(), frame.keypoints_px[feature] + 0.5, atol=2.0)
    (tmp_path / "binary").mkdir()
    model.write_binary(tmp_path / "binary")
    again = read_model(tmp_path / "binary")
    assert again.camera == ar_map.camera
    for frame in ar_map.keyframes:
        assert np.allclose(again.poses[frame.name].matrix(), frame.X_WC.matrix(), atol=1e-8)
