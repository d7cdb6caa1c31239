"""Images of a scan: a folder of pictures or a video, grey, with names and times."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from docking.errors import FileUnreadable
from docking.guidance.features import grey
from docking.guidance.opencv import opencv
from docking.guidance.types import Image

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"})
FOLDER_FPS = 10.0
_WHOLE = 0.9
"""Of the pictures that a video states must be there; many containers only estimate their number."""


class Picture(NamedTuple):
    """One image: `name`, time in the scan `t_s`, grey `image` (h, w)."""

    name: str
    t_s: float
    image: Image


def pictures(source: Path, fps: float = FOLDER_FPS, *, colour: bool = False) -> Iterator[Picture]:
    """The images of a folder in the order of their names (`fps` gives their times), of one image file, or of a video.

    Grey (h, w), or with `colour` BGR (h, w, 3). Raises FileUnreadable, ExtraMissing.
    """
    if not source.exists():
        raise FileUnreadable(str(source), "no such file or folder")
    if source.is_dir():
        files = sorted(path for path in source.iterdir() if path.suffix.lower() in SUFFIXES)
        if not files:
            raise FileUnreadable(str(source), "no image in this folder")
        for i, path in enumerate(files):
            yield Picture(path.name, i / fps, read_image(path, colour=colour))
    elif source.suffix.lower() in SUFFIXES:
        yield Picture(source.name, 0.0, read_image(source, colour=colour))
    else:
        yield from _video(source, colour=colour)


def read_image(path: Path, *, colour: bool = False) -> Image:
    """An image file, grey or BGR. Raises FileUnreadable."""
    cv2 = opencv()
    image: Image | None = cv2.imread(str(path), cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise FileUnreadable(str(path), "not an image that OpenCV can read")
    return image


def rate(source: Path, fps: float = FOLDER_FPS) -> float:
    """Pictures a second: `fps` of a folder, its own of a video."""
    if source.is_dir() or source.suffix.lower() in SUFFIXES:
        return fps
    capture = opencv().VideoCapture(str(source))
    try:
        return _rate(capture)
    finally:
        capture.release()


def _rate(capture: Any) -> float:
    return float(capture.get(opencv().CAP_PROP_FPS)) or FOLDER_FPS


def _video(path: Path, *, colour: bool) -> Iterator[Picture]:
    cv2 = opencv()
    capture = cv2.VideoCapture(str(path))
    try:
        fps = _rate(capture)
        number = 0
        while True:
            there, image = capture.read()
            if not there:
                break
            yield Picture(f"{path.stem}-{number:05d}", number / fps, image if colour else grey(image))
            number += 1
        if number == 0:
            raise FileUnreadable(str(path), "not a video that OpenCV can read")
        stated = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        if number < _WHOLE * stated:
            cause = f"it ends after {number} of {stated:.0f} pictures: cut off when it was recorded or copied"
            raise FileUnreadable(str(path), cause)
    finally:
        capture.release()
