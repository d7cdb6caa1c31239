"""A folder, a video or one image localised from beginning to end, and what came of it as text, JSON and trajectory."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from docking.errors import NotLocalised
from docking.guidance.guide import answer, refusal
from docking.guidance.images import Picture, pictures
from docking.guidance.localiser import Localised
from docking.guidance.tracking import TrackCounts, Tracker
from docking.guidance.trajectory import Trajectory
from docking.guidance.types import ArMap


@dataclass(frozen=True, eq=False)
class Outcome:
    """One image: its name, its time and its pose, or why there is none."""

    name: str
    t_s: float
    found: Localised | NotLocalised


@dataclass(frozen=True, eq=False)
class Batch:
    """All images in their order; `cpu_s` of processor for all of them, reading included; the map they left."""

    outcomes: tuple[Outcome, ...]
    counts: TrackCounts
    cpu_s: float
    ar_map: ArMap

    def trajectory(self) -> Trajectory:
        """The poses that were found."""
        return Trajectory.of([(o.t_s, o.found.X_WC) for o in self.outcomes if isinstance(o.found, Localised)])


def localise_all(tracker: Tracker, source: Path) -> Batch:
    """Every image of a source. Raises NotLocalised (of the first image) when none was localised, FileUnreadable."""
    start = time.process_time()
    outcomes = tuple(Outcome(p.name, p.t_s, _found(tracker, p)) for p in pictures(source))
    batch = Batch(outcomes, tracker.counts, time.process_time() - start, tracker.localiser.ar_map)
    first = outcomes[0].found
    if batch.counts.localised == 0 and isinstance(first, NotLocalised):
        raise NotLocalised(str(source), first.cause, value=first.value, limit=first.limit)
    return batch


def _found(tracker: Tracker, picture: Picture) -> Localised | NotLocalised:
    try:
        return tracker.step(picture.name, picture.t_s, picture.image)
    except NotLocalised as error:
        return error


def batch_json(batch: Batch) -> dict[str, Any]:
    """The batch as one JSON object."""
    poses = [
        {"name": o.name, "t_s": o.t_s, **(answer(o.found) if isinstance(o.found, Localised) else refusal(o.found))}
        for o in batch.outcomes
    ]
    sources = Counter(o.found.source for o in batch.outcomes if isinstance(o.found, Localised))
    return {
        **asdict(batch.counts),
        "sources": {"map": sources["map"], "marker": sources["marker"]},
        "cpu_s_per_frame": batch.cpu_s / len(batch.outcomes),
        "poses": poses,
    }


def batch_text(batch: Batch) -> str:
    """The batch for a person: a line an image, then the counts."""
    lines = [_line(o) for o in batch.outcomes]
    c = batch.counts
    lines.append(
        f"{c.localised} of {c.frames} images localised; lost {c.losses} times, found again {c.relocalised} times; "
        f"{1e3 * batch.cpu_s / c.frames:.0f} ms of processor an image"
    )
    if c.keyframes_added:
        lines.append(f"the map grew by {c.keyframes_added} key-frames and {c.points_added} points")
    return "\n".join(lines)


def _line(outcome: Outcome) -> str:
    found = outcome.found
    if isinstance(found, NotLocalised):
        return f"{outcome.name}: not localised: {found.cause} ({found.value}, {found.limit} are needed)"
    x, y, z = found.X_WC.t_mm
    return (
        f"{outcome.name}: {x:.1f} {y:.1f} {z:.1f} mm from the {found.source}, {found.points} points, "
        f"rms {found.rms_px:.2f} px, predicted error {found.predicted_error_mm():.1f} mm at {found.depth_mm:.0f} mm"
    )
