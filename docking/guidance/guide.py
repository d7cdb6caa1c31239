"""What a service calls: one image, a stream of images, a device that tracks itself, a map exchanged for a fresh one."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from docking.errors import FileUnreadable, MapFrameDiffers, NotLocalised
from docking.guidance.localiser import Localised, Localiser, LocaliseSettings, indexed
from docking.guidance.map_files import load_map
from docking.guidance.opencv import opencv
from docking.guidance.registration import DevicePair, Registration, register
from docking.guidance.tracking import Tracker, check_same_frame
from docking.guidance.types import Camera, Image
from docking.types import Pose


class Guide:
    """One map of one cell, opened once; streams taken from it go on in the fresh map after `swap`."""

    def __init__(self, folder: Path, camera: Camera | None = None, settings: LocaliseSettings | None = None) -> None:
        """Raises FileUnreadable, ConfigInvalid, MapFrameDiffers for a map that is not in the frame of the cell."""
        ar_map = load_map(folder)
        if ar_map.frame != "cell":
            cause = "it is in a frame of its own, not in that of the cell"
            raise MapFrameDiffers(str(folder), cause, value=ar_map.frame, limit="cell")
        self.localiser = Localiser(ar_map, camera, settings)
        self._streams: list[Tracker] = []

    def localise(self, image: Image) -> Localised:
        """The pose of one image, grey (h, w) or BGR (h, w, 3). Raises NotLocalised, BadArgument."""
        return self.localiser.localise(image)

    def stream(self, *, read_only: bool = True) -> Tracker:
        """A stream of images; each has its own memory of where it was, and its own extension of the map."""
        tracker = Tracker(self.localiser, read_only=read_only)
        self._streams.append(tracker)
        return tracker

    def close(self, stream: Tracker) -> None:
        """The stream has ended."""
        self._streams.remove(stream)

    def register(self, pairs: Iterable[tuple[Image, Pose]]) -> Registration:
        """X_WD of a device from images and its own poses X_DK of them (camera axes x right, y down, z forward).

        Images that cannot be localised are left out. Raises DevicePairsDisagree.
        """
        found = []
        for image, X_DK in pairs:
            try:
                at = self.localise(image)
            except NotLocalised:
                continue
            sigma_rad = float(np.sqrt(np.linalg.eigvalsh(at.cov[:3, :3])[-1])) + at.map_sigma_mm / at.depth_mm
            found.append(DevicePair(at.X_WC, X_DK, at.sigma_mm, sigma_rad))
        return register(found)

    def swap(self, folder: Path) -> None:
        """Exchange the map for one built again; all streams go on in it. Raises MapFrameDiffers and stays as it was."""
        index = indexed(load_map(folder))
        check_same_frame(self.localiser.ar_map, index.ar_map)
        self.localiser = self.localiser.on(index)
        for stream in self._streams:
            stream.swap(index)


def decoded(picture: bytes) -> Image:
    """The grey image of an encoded picture (JPEG, PNG). Raises FileUnreadable."""
    cv2 = opencv()
    image: Image | None = None
    if picture:
        image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise FileUnreadable("picture", "neither JPEG nor PNG")
    return image


def answer(found: Localised) -> dict[str, Any]:
    """A pose as JSON: `X_WC` (4 x 4, mm), where it is from, how good it is."""
    return {
        "localised": True,
        "source": found.source,
        "X_WC": found.X_WC.matrix().tolist(),
        "cov": found.cov.tolist(),
        "points": found.points,
        "expected": found.expected,
        "rms_px": found.rms_px,
        "depth_mm": found.depth_mm,
        "sigma_mm": found.sigma_mm,
        "predicted_error_mm": found.predicted_error_mm(),
        "generation": found.generation,
    }


def refusal(error: NotLocalised) -> dict[str, Any]:
    """A refusal as JSON."""
    return {"localised": False, "code": error.code, "cause": error.cause, "points": error.value, "limit": error.limit}
