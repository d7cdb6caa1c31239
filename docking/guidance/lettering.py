"""Words in a picture. OpenCV draws no Chinese: a font of the machine is used through Pillow (part of `guidance`)."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from docking.errors import ExtraMissing, FontMissing
from docking.guidance.types import Image

FONTS = (
    "/usr/share/fonts/opentype/noto/NotoSansCJK-Regular.ttc",
    "/usr/share/fonts/noto-cjk/NotoSansCJK-Regular.ttc",
    "/usr/share/fonts/truetype/wqy/wqy-microhei.ttc",
    "/usr/share/fonts/truetype/wqy/wqy-zenhei.ttc",
    "/usr/share/fonts/truetype/droid/DroidSansFallbackFull.ttf",
    "C:/Windows/Fonts/msyh.ttc",
    "/System/Library/Fonts/PingFang.ttc",
)
_SIMPLIFIED = 2
"""The face of the Noto collection with Simplified Chinese shapes."""

Colour = tuple[int, int, int]
"""Blue, green, red."""


@cache
def font(size_px: int, *, chinese: bool) -> Any:
    """A Pillow font. Raises FontMissing when Chinese is asked for and no font on the machine has it, ExtraMissing."""
    try:
        from PIL import ImageFont
    except ImportError as error:
        raise ExtraMissing("guidance", str(error), value="Pillow", limit="pip install '.[guidance]'") from error
    named = os.environ.get("DOCKING_FONT")
    for path in (named, *FONTS) if named else FONTS:
        if Path(path).is_file():
            index = _SIMPLIFIED if "NotoSansCJK" in path else 0
            return ImageFont.truetype(path, size_px, index=index)
    if chinese:
        raise FontMissing("overlay", f"looked for {', '.join(FONTS[:3])} and others", value="Chinese")
    return ImageFont.load_default(size_px)


def is_chinese(text: str) -> bool:
    """Whether a text has characters of CJK."""
    return any("\u2e80" <= character <= "\u9fff" or "\uff00" <= character <= "\uffef" for character in text)


Box = tuple[float, float, float, float]
"""Left, top, right, bottom px."""
_PLACES = (0, 1, -1, 2, -2, 3, -3)


def _free(box: Box, taken: list[Box], line_px: int) -> float:
    """How far down (px, whole lines) a box covers no other; 0 where there is no such place near by."""
    for lines in _PLACES:
        top, bottom = box[1] + lines * line_px, box[3] + lines * line_px
        if not any(box[0] < b[2] and b[0] < box[2] and top < b[3] and b[1] < bottom for b in taken):
            return float(lines * line_px)
    return 0.0


class Letters:
    """Collects words and puts them all into a picture at once: converting the picture costs more than the words."""

    def __init__(self, size_px: int) -> None:
        self.size_px = size_px
        self._words: list[tuple[float, float, str, Colour]] = []
        self._fixed: list[tuple[float, float, str, Colour]] = []

    def put(self, x: float, y: float, text: str, colour: Colour, *, fixed: bool = False) -> None:
        """Words with their top left at (x, y) px; those that are not fixed give way to others, by whole lines."""
        if text:
            (self._fixed if fixed else self._words).append((x, y, text, colour))

    def drawn(self, image: Image) -> Image:
        """The picture (h, w, 3) with the words on a dark ground. Raises FontMissing, ExtraMissing."""
        words = [*self._fixed, *self._words]
        if not words:
            return image
        face = font(self.size_px, chinese=any(is_chinese(text) for _, _, text, _ in words))
        from PIL import Image as PillowImage
        from PIL import ImageDraw

        picture = PillowImage.fromarray(image[:, :, ::-1].copy())
        canvas = ImageDraw.Draw(picture, "RGBA")
        taken: list[Box] = []
        for k, (x, y, text, (blue, green, red)) in enumerate(words):
            left, top, right, bottom = canvas.textbbox((x, y), text, font=face)
            box = (left - 3, top - 2, right + 3, bottom + 2)
            down = 0.0 if k < len(self._fixed) else _free(box, taken, self.size_px + 8)
            box = (box[0], box[1] + down, box[2], box[3] + down)
            taken.append(box)
            canvas.rectangle(box, fill=(0, 0, 0, 150))
            canvas.text((x, y + down), text, font=face, fill=(red, green, blue, 255))
        result: Image = np.ascontiguousarray(np.asarray(picture)[:, :, ::-1])
        return result
