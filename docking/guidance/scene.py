"""What is true in the cell and worth drawing: places in W (mm), with words already in the reader's language."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from docking.guidance.mesh import Mesh
from docking.types import Array, Pose

Tone = Literal["good", "close", "bad", "plain", "dim", "next"]
"""Colour of a thing; every tone but plain and dim is said in words as well."""


@dataclass(frozen=True, eq=False)
class Line:
    """A polyline (n, 3) in W."""

    points_mm: Array
    tone: Tone = "plain"


@dataclass(frozen=True, eq=False)
class Mark:
    """A place with words; `vector_mm` (3,) is drawn from it, `magnified` times longer than it is."""

    at_mm: Array
    words: str = ""
    tone: Tone = "plain"
    vector_mm: Array | None = None
    magnified: float = 1.0
    kind: Literal["target", "feature", "move"] = "target"


@dataclass(frozen=True, eq=False)
class PartToPlace:
    """A part of the work instructions at its place X_WP; without a mesh its axes are drawn."""

    name: str
    X_WP: Pose
    mesh: Mesh | None
    tone: Tone
    words: str


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything to draw. `head` lines stand at the top (state and age), `steps` at the left.

    `anchor_mm` (3,) is the place that the drawing is about: the predicted error there decides whether anything is
    drawn. `captions`: texts with {places} for what only the picture knows: `quality`, `source_map`, `source_marker`,
    `left_out`, `refused`.
    """

    anchor_mm: Array
    lines: tuple[Line, ...]
    marks: tuple[Mark, ...]
    parts: tuple[PartToPlace, ...]
    head: tuple[tuple[str, Tone], ...]
    steps: tuple[tuple[str, Tone], ...]
    captions: dict[str, str]
