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


class Letters:
    """Collects words and puts them all into a picture at once: converting the picture costs more than the words."""

    def __init__(self, size_px: int) -> None:
        self.size_px = size_px
        self._words: list[tuple[float, float, str, Colour]] = []

    def put(self, x: float, y: float, text: str, colour: Colour) -> None:
        """Words with their top left at (x, y) px."""
        if text:
            self._words.append((x, y, text, colour))

    def drawn(self, image: Image) -> Image:
        """The picture (h, w, 3) with the words on a dark ground. Raises FontMissing, ExtraMissing."""
        if not self._words:
            return image
        face = font(self.size_px, chinese=any(is_chinese(text) for _, _, text, _ in self._words))
        from PIL import Image as PillowImage
        from PIL import ImageDraw

        picture = PillowImage.fromarray(image[:, :, ::-1].copy())
        canvas = ImageDraw.Draw(picture, "RGBA")
        for x, y, text, (blue, green, red) in self._words:
            left, top, right, bottom = canvas.textbbox((x, y), text, font=face)
            canvas.rectangle((left - 3, top - 2, right + 3, bottom + 2), fill=(0, 0, 0, 150))
            canvas.text((x, y), text, font=face, fill=(red, green, blue, 255))
        result: Image = np.ascontiguousarray(np.asarray(picture)[:, :, ::-1])
        return result
