"""ORB features, the same for the map and for the images that are localised in it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from docking.guidance.opencv import opencv
from docking.guidance.types import Bytes, Image, Integers
from docking.types import Array

COUNT = 2000
LEVELS = 8
SCALE = 1.2


class Features(NamedTuple):
    """`keypoints_px` (n, 2) where they are in the image, `octaves` (n,), `descriptors` (n, 32)."""

    keypoints_px: Array
    octaves: Integers
    descriptors: Bytes


def grey(image: Image) -> Image:
    """A grey image (h, w) of a grey or BGR one."""
    if image.ndim == 2:
        return image
    converted: Image = opencv().cvtColor(image, opencv().COLOR_BGR2GRAY)
    return converted


def extract(image: Image, count: int = COUNT) -> Features:
    """The `count` strongest ORB features of an image. Raises ExtraMissing."""
    cv2 = opencv()
    orb = cv2.ORB_create(nfeatures=count, scaleFactor=SCALE, nlevels=LEVELS, fastThreshold=12)
    keypoints, descriptors = orb.detectAndCompute(grey(image), None)
    if not keypoints:
        return Features(np.zeros((0, 2)), np.zeros(0, np.int32), np.zeros((0, 32), np.uint8))
    pixels = np.array([point.pt for point in keypoints], dtype=np.float64)
    return Features(pixels, np.array([point.octave for point in keypoints], dtype=np.int32), descriptors)
