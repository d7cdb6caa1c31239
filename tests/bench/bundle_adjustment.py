"""P17: the bundle adjustment of a map with held key-frames against pycolmap's on one thread, same start and loss.

The size is that of a 15 s scan: 68 key-frames, 13,000 points, 58,000 observations, 7 key-frames held.
"""

from __future__ import annotations

import copy
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from docking.guidance.bundle import Bundle, adjust
from docking.guidance.colmap_files import write_model
from docking.guidance.types import ArMap
from tests.bench.metric import Metric, Sizes, median_ratio, side_by_side
from tests.support.marked_wall import drifted, marked_wall

FRAMES, POINTS, OBSERVATIONS = 68, 24_000, 58_000
"""Of the points 13,000 are seen twice or more."""
HUBER_PX = 2.0
SAME_STOP = 1e-3
"""Both end when the cost falls by less than this share."""
SOLVE_TARGET_S = 0.6


def measure(sizes: Sizes) -> list[Metric]:
    tiny = sizes.repeats == 1
    ar_map = start_map(12, 600, 2_500) if tiny else start_map(FRAMES, POINTS, OBSERVATIONS)
    held = np.zeros(len(ar_map.keyframes), bool)
    held[:: max(1, len(held) // 6)] = True
    bundle = bundle_of(ar_map, held)
    works: dict[str, Any] = {"product": lambda: adjust(bundle, 50, SAME_STOP)}
    peer = peer_of(ar_map, held, sizes.repeats)
    if peer is not None:
        works["peer"] = peer.solve
    times = side_by_side(works, sizes.repeats)
    mine = float(np.median(times["product"]))
    what = f"bundle adjustment, {len(held)} key-frames, {len(bundle.pixels)} observations"
    metrics = [Metric("P17", what, f"{mine:.2f} s", "0.6 s", mine / SOLVE_TARGET_S, 1.0, at_least=False)]
    if peer is not None:
        theirs = f"{float(np.median(times['peer'])):.2f} s pycolmap"
        ratio = median_ratio(times["product"], times["peer"])
        metrics.append(Metric("P17", what, f"{mine:.2f} s", theirs, ratio, 2.5, at_least=False))
    return metrics


def start_map(frames: int, points: int, observations: int) -> ArMap:
    """A map that has drifted, thinned to so many observations; every point is seen twice or more."""
    wall = drifted(marked_wall(frames, points, 0.5), 0.01)
    owner, point, _ = wall.free.observations()
    rng = np.random.default_rng(0)
    keep = rng.random(len(owner)) < observations / len(owner)
    keep &= (np.bincount(point[keep], minlength=points) >= 2)[point]
    thinned, at = [], 0
    for frame in wall.free.keyframes:
        seen = frame.landmarks >= 0
        landmarks = np.where(seen, frame.landmarks, -1)
        mine = keep[at : at + int(seen.sum())]
        landmarks[np.flatnonzero(seen)[~mine]] = -1
        at += int(seen.sum())
        thinned.append(replace(frame, landmarks=landmarks.astype(np.int32)))
    return replace(wall.free, keyframes=tuple(thinned))


def bundle_of(ar_map: ArMap, held: np.ndarray) -> Bundle:
    """The adjustment of a map with held key-frames, every observation worth one pixel."""
    owner, point, pixels = ar_map.observations()
    X = [frame.X_WC.inverse() for frame in ar_map.keyframes]
    R, t, ones = np.array([x.R for x in X]), np.array([x.t_mm for x in X]), np.ones(len(owner))
    return Bundle(ar_map.camera, R, t, ar_map.points_mm, owner, point, pixels, ones, HUBER_PX * ones, held)


class _Peer:
    """The same adjustment by pycolmap; its model comes in through the exporter."""

    def __init__(self, pycolmap: Any, ar_map: ArMap, held: np.ndarray, turns: int) -> None:
        self.pycolmap, self.held = pycolmap, held
        with tempfile.TemporaryDirectory() as folder:
            write_model(ar_map, Path(folder))
            model = pycolmap.Reconstruction()
            model.read_text(folder)
        # It adjusts in place: a copy for every turn, made before the clock runs.
        self.models = [copy.deepcopy(model) for _ in range(turns)]
        self.options = pycolmap.BundleAdjustmentOptions()
        self.options.refine_focal_length = self.options.refine_extra_params = False
        self.options.print_summary = False
        ceres = self.options.ceres
        ceres.loss_function_type, ceres.loss_function_scale = pycolmap.LossFunctionType.HUBER, HUBER_PX
        ceres.solver_options.num_threads = 1
        ceres.solver_options.function_tolerance = SAME_STOP

    def solve(self) -> Any:
        """Build and solve, from the same start every time; the adjusted model. Once for every turn."""
        model = self.models.pop()
        config = self.pycolmap.BundleAdjustmentConfig()
        for image_id in model.images:
            config.add_image(image_id)
        for k in np.flatnonzero(self.held):
            config.set_constant_rig_from_world_pose(model.images[int(k) + 1].frame_id)
        adjuster = self.pycolmap.create_default_bundle_adjuster(self.options, config, model)
        adjuster.solve()
        return model


def peer_of(ar_map: ArMap, held: np.ndarray, turns: int) -> _Peer | None:
    """None where the extra is not installed."""
    try:
        import pycolmap
    except ImportError:
        return None
    return _Peer(pycolmap, ar_map, held, turns)
