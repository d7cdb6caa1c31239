"""Work instructions of a job: what a person does, with which tool, where; drawn in the picture of the cell."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from docking.config.base import Model, Name, PoseVector

StepText = Annotated[str, Field(min_length=1, max_length=200)]


class Instruction(Model):
    """One step of work by a person."""

    name: Name = Field(description="of the step")
    order: Annotated[int, Field(ge=1, le=9999)] = Field(description="steps are done in this order")
    text_en: StepText = Field(description="what to do, in English")
    text_zh: StepText = Field(description="what to do, in Chinese")
    tool: Annotated[str, Field(max_length=80)] = Field(default="", description="what it is done with")
    frame: Literal["cell", "component"] = Field(description="the frame that `pose` is in: W or C")
    pose: PoseVector = Field(description="of the part in that frame, mm and deg")
    mesh: Annotated[str, Field(max_length=260)] | None = Field(
        default=None,
        description=(
            "the part: an STL (mm) or glTF file (.stl, .gltf, .glb), beside the job file; none: its axes are drawn"
        ),
    )

    def text(self, language: str) -> str:
        """What to do in one language."""
        return self.text_zh if language == "zh" else self.text_en
