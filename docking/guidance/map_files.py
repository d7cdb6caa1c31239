"""A map on disk: MAPDIR/map.json (all that a person may want to read) and MAPDIR/map.npz (the arrays, no pickle)."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.spatial.transform import Rotation

from docking.errors import ConfigInvalid, FileUnreadable, FileUnwritable
from docking.guidance.types import ArMap, Camera, KeyFrame, MapFrame, MapQuality, MarkerLayout
from docking.types import Pose

FORMAT = 1
_JSON, _ARRAYS = "map.json", "map.npz"


def save_map(ar_map: ArMap, folder: Path) -> None:
    """Write a map into `folder` (made if absent; an earlier map in it is replaced). Raises FileUnwritable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _JSON).write_text(json.dumps(_head(ar_map), indent=1, ensure_ascii=False) + "\n", "utf-8")
        np.savez_compressed(folder / _ARRAYS, **_arrays(ar_map))
    except OSError as error:
        raise FileUnwritable(str(folder), error.strerror or str(error)) from error


def _head(ar_map: ArMap) -> dict[str, Any]:
    layout = ar_map.layout
    return {
        "format": FORMAT,
        "frame": ar_map.frame,
        "camera": asdict(ar_map.camera),
        "keyframes": [{"name": frame.name, "t_s": frame.t_s} for frame in ar_map.keyframes],
        "quality": asdict(ar_map.quality),
        "layout": None
        if layout is None
        else {
            "ids": list(layout.ids),
            "circles_mm": layout.circles_mm.tolist(),
            "sigma_mm": layout.sigma_mm.tolist(),
            "dictionary": layout.dictionary,
            "side_mm": layout.side_mm,
            "circle_radius_mm": layout.circle_radius_mm,
            "circle_offset_mm": layout.circle_offset_mm,
        },
    }


def _arrays(ar_map: ArMap) -> dict[str, Any]:
    frames = ar_map.keyframes
    return {
        "R": np.array([frame.X_WC.R for frame in frames]),
        "t_mm": np.array([frame.X_WC.t_mm for frame in frames]),
        "sizes": np.array([len(frame.landmarks) for frame in frames]),
        "keypoints_px": np.concatenate([frame.keypoints_px for frame in frames]),
        "octaves": np.concatenate([frame.octaves for frame in frames]),
        "frame_descriptors": np.concatenate([frame.descriptors for frame in frames]),
        "landmarks": np.concatenate([frame.landmarks for frame in frames]),
        "points_mm": ar_map.points_mm,
        "descriptors": ar_map.descriptors,
    }


def load_map(folder: Path) -> ArMap:
    """Read a map that `save_map` wrote. Raises FileUnreadable, ConfigInvalid when it is not a whole map."""
    try:
        head = json.loads((folder / _JSON).read_text("utf-8"))
        with np.load(io.BytesIO((folder / _ARRAYS).read_bytes()), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except OSError as error:
        raise FileUnreadable(str(error.filename or folder), error.strerror or str(error)) from error
    except (ValueError, zipfile.BadZipFile) as error:
        raise ConfigInvalid(str(folder), (f"not a map: {error}",)) from error
    if head.get("format") != FORMAT:
        raise ConfigInvalid(str(folder), (f"format {head.get('format')!r}: this program reads {FORMAT}",))
    try:
        return _map(head, arrays)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ConfigInvalid(str(folder), (f"not a whole map: {type(error).__name__}: {error}",)) from error


def _map(head: dict[str, Any], arrays: dict[str, Any]) -> ArMap:
    ends = np.cumsum(arrays["sizes"])[:-1]
    split = [np.split(arrays[name], ends) for name in ("keypoints_px", "octaves", "frame_descriptors", "landmarks")]
    if not (int(max((part.max(initial=-1) for part in split[3]), default=-1)) < len(arrays["points_mm"])):
        raise ValueError("an observation of a point that is not there")
    # A rotation from a file is made orthonormal again: nothing downstream checks it.
    rotations = Rotation.from_matrix(arrays["R"]).as_matrix()
    frames = tuple(
        KeyFrame(item["name"], float(item["t_s"]), Pose(R, t), *(part[i] for part in split))
        for i, (item, R, t) in enumerate(zip(head["keyframes"], rotations, arrays["t_mm"], strict=True))
    )
    return ArMap(
        cast(MapFrame, head["frame"]),
        Camera(**head["camera"]),
        frames,
        arrays["points_mm"],
        arrays["descriptors"],
        _layout(head["layout"]),
        _quality(head["quality"]),
    )


def _layout(table: dict[str, Any] | None) -> MarkerLayout | None:
    if table is None:
        return None
    fixed = {**table, "ids": tuple(table["ids"])}
    return MarkerLayout(**{**fixed, **{key: np.array(table[key]) for key in ("circles_mm", "sigma_mm")}})


def _quality(table: dict[str, Any]) -> MapQuality:
    lists = {key: tuple(value) for key, value in table.items() if isinstance(value, list)}
    rejected = {int(marker): why for marker, why in table["markers_rejected"].items()}
    return MapQuality(**{**table, **lists, "markers_rejected": rejected})
