"""P18: the published transform and optimisation from triangulation to adjustment; pictures localised a second.

Sizes are those of a 15 s scan: 65 key-frames, 13,000 points, 58,000 observations; pictures of 960 x 720 as a stream,
with the processor's time, since several services share one machine.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from docking.guidance.images import Picture
from docking.guidance.localiser import Localiser, LocaliseSettings
from docking.guidance.map_build import Scanned, place
from docking.guidance.map_builder import BuilderSettings
from docking.guidance.map_methods import MethodSettings
from docking.guidance.posed_map import build_from_poses
from docking.guidance.tracking import Tracker
from docking.guidance.types import ArMap, Camera
from sim.camera import Lens, SimulatedCamera
from sim.scenery import wall_scenery
from tests.bench.bundle_adjustment import start_map
from tests.bench.metric import Metric, Sizes
from tests.support.guided_cell import WALL, X_WP, layout_of, view
from tests.support.marked_wall import drifted, marked_wall

FRAMES, POINTS, OBSERVATIONS = 65, 24_000, 58_000
OPTIMISE_TARGET_S, PICTURES_A_S = 0.6, 8.0
MOST_FEATURES = 1500


def measure(sizes: Sizes) -> list[Metric]:
    tiny = sizes.repeats == 1
    seconds = optimise_s(12, 900, 4_000, 1) if tiny else optimise_s(FRAMES, POINTS, OBSERVATIONS, sizes.repeats)
    rate = 1.0 / picture_s(3 if tiny else 30)
    return [
        Metric(
            "P18",
            f"published transform and optimisation, {FRAMES} key-frames",
            f"{seconds:.2f} s",
            "0.6 s",
            seconds / OPTIMISE_TARGET_S,
            1.0,
            at_least=False,
        ),
        Metric("P18", "pictures of 960 x 720 localised", f"{rate:.1f} /s", "8 /s", rate / PICTURES_A_S, 1.0),
    ]


def optimise_s(frames: int, points: int, observations: int, repeats: int) -> float:
    """Median time of the published method on a drifted map."""
    wall = drifted(marked_wall(frames, points, 0.5), 0.01)
    scanned = Scanned(start_map(frames, points, observations), wall.sightings, 0.0)
    placed = [place(scanned, wall.layout, "published", MethodSettings()) for _ in range(repeats)]
    assert all(ar_map.quality.reset_keyframes for ar_map in placed)
    return float(np.median([ar_map.quality.optimise_s for ar_map in placed]))


def picture_s(count: int) -> float:
    """Time of the processor that one picture of a stream takes; every one must be localised by the map."""
    ar_map, eye = _map(3 if count < 10 else 12)
    tracker = Tracker(Localiser(ar_map, settings=LocaliseSettings(by_markers=False)))
    walk = [eye.picture(view(200.0 + 10.0 * k, 1000.0, 800.0)) for k in range(count)]
    begun = time.process_time()
    for k, image in enumerate(walk):
        tracker.step(f"{k}", 0.1 * k, image)
    return (time.process_time() - begun) / count


def _map(frames: int) -> tuple[ArMap, SimulatedCamera]:
    """A map with the true poses, and the camera it was taken with."""
    scenery, lens = wall_scenery(3, WALL, X_WP), Lens()
    eye = SimulatedCamera(scenery.patches, lens, 4)
    camera = Camera(lens.width_px, lens.height_px, lens.f_px, lens.f_px, lens.cx_px, lens.cy_px)
    poses = [view(150.0 + 500.0 * k / frames, 1000.0, 850.0 - 40.0 * (k % 2)) for k in range(frames)]
    taken = [(Picture(f"{k}", 0.1 * k, eye.picture(X)), X) for k, X in enumerate(poses)]
    free = build_from_poses(camera, taken, BuilderSettings(features=MOST_FEATURES), lambda picture: None)
    return replace(free, frame="cell", layout=layout_of(scenery)), eye
