"""What a person must know before trusting the frame of a map, and how far off the frame may be for it."""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan

import numpy as np

from docking.guidance.map_methods import MethodSettings, Placed
from docking.guidance.types import Camera, MarkerLayout

_LEAST_SPAN = 0.5
_DOUBTFUL_RMS_MM = 3.0
_STRAIN_SIGMAS, _LEAST_STRAIN_MM = 3.0, 0.4
"""Circles further from the survey than so many sigmas (at least so many mm) strain a map."""
_HIDDEN = {"joint": 10.0, "published": 5.0}
"""How far off places are, against the circles' rms: a joint map bends to a wrong survey and leaves a tenth of the error
at its circles; one as published is held where key-frames were reset, and leaves a fifth."""
_MOST_SIGMAS, _CONTRADICTED_MM = 3.0, 12.0
"""A calibration that the pictures move by more of its sigmas is wrong; then the frame is so uncertain (mm, 1 sigma)."""


@dataclass(frozen=True)
class Doubt:
    """Words for a person; `mm` standard deviation of the frame for that reason, 0 where it has none of its own."""

    words: str
    mm: float = 0.0


def doubts(
    placed: Placed, calibration: Camera, layout: MarkerLayout, settings: MethodSettings, rms_mm: float
) -> tuple[Doubt, ...]:
    """All doubts about a map placed by circles; none about one placed by a single marker's corners.

    `calibration` as it was given, `layout` without the rejected markers, `rms_mm` of the circles in the finished map.
    """
    if placed.registered is None:
        return ()
    found = (
        _strain(layout, placed.method, rms_mm),
        _group(placed.registered.doubt_mm),
        _contradiction(calibration, placed.ar_map.camera, settings),
        _extent(placed, layout),
        _misfit(rms_mm),
    )
    return tuple(doubt for doubt in found if doubt is not None)


def _strain(layout: MarkerLayout, method: str, rms_mm: float) -> Doubt | None:
    allowed_mm = max(_LEAST_STRAIN_MM, _STRAIN_SIGMAS * float(np.sqrt(np.mean(np.sum(layout.sigma_mm**2, axis=2)))))
    if isnan(rms_mm) or rms_mm <= allowed_mm:
        return None
    words = (
        f"the circles lie {rms_mm:.2f} mm rms from their survey, more than its sigmas allow: "
        "some have moved, the survey is worse than it says, or the map drifts"
    )
    return Doubt(words, _HIDDEN[method] * rms_mm)


def _group(apart_mm: float) -> Doubt | None:
    if not apart_mm > 0.0:
        return None
    words = (
        f"markers that agree with each other lie {apart_mm:.0f} mm from where the others put them: moved together, "
        "or the map is bent (calibration?). Scan again, or take the moved ones out of the survey"
    )
    return Doubt(words, apart_mm)


def _contradiction(given: Camera, adjusted: Camera, settings: MethodSettings) -> Doubt | None:
    if settings.camera_sigma is None:
        return None
    change = np.array(
        [
            np.log(adjusted.fx_px / given.fx_px),
            *(getattr(adjusted, key) - getattr(given, key) for key in ("cx_px", "cy_px", "k1", "k2")),
        ]
    )
    sigmas = float(np.max(np.abs(change) / np.array(settings.camera_sigma)))
    if sigmas <= _MOST_SIGMAS:
        return None
    words = (
        f"the pictures contradict the calibration ({sigmas:.0f} times what one leaves open; focal length "
        f"{100.0 * change[0]:+.1f} %): another camera, zoom or focus? Calibrate as it was used, and build again"
    )
    return Doubt(words, _CONTRADICTED_MM)


def _extent(placed: Placed, layout: MarkerLayout) -> Doubt | None:
    used = [layout.circles_mm[k] for k, marker in enumerate(layout.ids) if marker in placed.markers_used]
    known = np.concatenate(used) if used else np.zeros((1, 3))
    cameras = np.array([frame.X_WC.t_mm for frame in placed.ar_map.keyframes])
    span, size = (float(np.linalg.norm(np.ptp(points, axis=0))) for points in (known, cameras))
    if span >= _LEAST_SPAN * size:
        return None
    return Doubt(f"the markers span {span:.0f} mm of a scan of {size:.0f} mm: far from them the frame is a guess")


def _misfit(rms_mm: float) -> Doubt | None:
    if rms_mm <= _DOUBTFUL_RMS_MM:
        return None
    how = "cannot be triangulated" if isnan(rms_mm) else f"lie {rms_mm:.1f} mm rms from their survey"
    return Doubt(f"the circles {how} in the finished map: do not trust it")
