"""`docking guide overlay`: a picture or a video of the cell with what the journal proves drawn into it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from docking.errors import BadArgument, FileUnwritable, NotLocalised, OverlayUncertain
from docking.guidance.guide import Guide, answer, refusal
from docking.guidance.images import Picture, pictures, rate
from docking.guidance.localiser import Localised
from docking.guidance.opencv import opencv
from docking.guidance.overlay import draw, draw_refusal
from docking.guidance.scene import Scene
from docking.guidance.tracking import Tracker
from docking.guidance.types import Image
from docking.guide_scene import Source, build_scene

VIDEO_SUFFIXES = (".mp4", ".avi")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True, eq=False)
class OverlayRequest:
    """What to draw into what; `fps` of a folder; `now` to which ages are counted (default: the time of day)."""

    guide: Guide
    pictures: Path
    source: Source
    out: Path
    limit_mm: float
    language: str
    fps: float = 10.0
    now: datetime | None = None


def write_overlay(request: OverlayRequest) -> dict[str, Any]:
    """Write the picture or the video; returns what was drawn.

    A picture that cannot be localised, or only with too large an error, is refused: NotLocalised, OverlayUncertain, and
    no file is written. In a video such a picture carries the refusal and nothing else; all refused is an error.
    """
    if not 0.0 < request.limit_mm < float("inf"):
        raise BadArgument("--limit-mm", "a positive length is needed", value=request.limit_mm)
    if request.out.resolve() == request.pictures.resolve():
        raise BadArgument("--out", "it would write over what it draws into", value=str(request.out))
    scene = build_scene(request.source, request.language, request.now)
    suffix = request.out.suffix.lower()
    if suffix in PICTURE_SUFFIXES:
        return _picture(request, scene)
    if suffix in VIDEO_SUFFIXES:
        return _video(request, scene)
    raise BadArgument("--out", f"the name must end with {', '.join(PICTURE_SUFFIXES + VIDEO_SUFFIXES)}", value=suffix)


def _picture(request: OverlayRequest, scene: Scene) -> dict[str, Any]:
    found = list(pictures(request.pictures, colour=True))
    if len(found) != 1:
        raise BadArgument(
            "--out", "one picture is drawn from one picture; a folder or video needs .mp4", value=len(found)
        )
    at = request.guide.localise(found[0].image)
    drawn = draw(found[0].image, at, scene, request.limit_mm)
    if not opencv().imwrite(str(request.out), drawn):
        raise FileUnwritable(str(request.out), "OpenCV cannot write it")
    return {"out": str(request.out), "frames": 1, "drawn": 1, "poses": [_said(found[0], at, scene)]}


def _video(request: OverlayRequest, scene: Scene) -> dict[str, Any]:
    tracker = request.guide.stream()
    writer: Any = None
    said: list[dict[str, Any]] = []
    try:
        for picture in pictures(request.pictures, request.fps, colour=True):
            drawn, facts = _one(request, tracker, picture, scene)
            said.append(facts)
            writer = writer or _writer(request, drawn)
            writer.write(drawn)
    except BaseException:
        if writer is not None:
            request.out.unlink(missing_ok=True)
        raise
    finally:
        if writer is not None:
            writer.release()
    count = sum(facts["drawn"] for facts in said)
    if count == 0:
        request.out.unlink(missing_ok=True)
        raise NotLocalised(str(request.pictures), f"nothing is drawn: {said[0]['cause']}", value=0, limit=1)
    return {"out": str(request.out), "frames": len(said), "drawn": count, "poses": said}


def _one(request: OverlayRequest, tracker: Tracker, picture: Picture, scene: Scene) -> tuple[Image, dict[str, Any]]:
    name = {"name": picture.name, "t_s": picture.t_s}
    try:
        found = tracker.step(picture.name, picture.t_s, picture.image)
        drawn = draw(picture.image, found, scene, request.limit_mm)
    except (NotLocalised, OverlayUncertain) as error:
        text = error.text(request.language)
        if isinstance(error, NotLocalised):
            return draw_refusal(picture.image, scene, error, text), {**name, "drawn": False, **refusal(error)}
        facts = {"drawn": False, "cause": text, "predicted_error_mm": error.value}
        return draw_refusal(picture.image, scene, error, text), {**name, **facts}
    return drawn, _said(picture, found, scene)


def _said(picture: Picture, found: Localised, scene: Scene) -> dict[str, Any]:
    at_anchor = {"predicted_error_mm": found.predicted_error_mm(scene.anchor_mm)}
    return {"name": picture.name, "t_s": picture.t_s, "drawn": True, **answer(found), **at_anchor}


def _writer(request: OverlayRequest, image: Image) -> Any:
    code = "mp4v" if request.out.suffix.lower() == ".mp4" else "MJPG"
    size, fps = (image.shape[1], image.shape[0]), rate(request.pictures, request.fps)
    writer = opencv().VideoWriter(str(request.out), opencv().VideoWriter_fourcc(*code), fps, size)
    if not writer.isOpened():
        raise FileUnwritable(str(request.out), "OpenCV cannot write this kind of video here")
    return writer
