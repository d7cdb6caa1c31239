"""The part of the CELL file about the live pose of the part in a move. Lengths mm, times s."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from docking.config.base import Finite, Model, Name, NonNegative, PoseVector, Positive, Vector3


class CameraCalibration(Model):
    """Calibration of one camera of a pair, and where it stands."""

    width_px: Positive = Field(description="of the image, px")
    height_px: Positive = Field(description="of the image, px")
    fx_px: Positive = Field(description="focal length, px")
    fy_px: Positive = Field(description="focal length, px")
    cx_px: Positive = Field(description="principal point, px")
    cy_px: Positive = Field(description="principal point, px")
    distortion: Annotated[tuple[Finite, ...], Field(min_length=4, max_length=5)] = Field(
        default=(0.0,) * 5, description="Brown: k1, k2, p1, p2(, k3)"
    )
    pose: PoseVector = Field(description="X_W camera, mm and deg; camera axes: x right, y down, z ahead")
    pixel_sigma: Positive = Field(default=0.2, description="noise of a pixel coordinate, 1 sigma, px")


class StereoCameraConfig(CameraCalibration):
    """One camera of the pair in the cell."""

    name: Name = Field(description="as the lines call it")


class StereoConfig(Model):
    """A calibrated camera pair whose computer sends pixel tracks."""

    port: str = Field(min_length=1, description="any pyserial URL, such as socket://192.168.0.7:4000")
    baud: Annotated[int, Field(ge=9600, le=4_000_000)] = Field(default=921600, description="line speed, bit/s")
    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = Field(default=20.0, description="exposures a second")
    cameras: tuple[StereoCameraConfig, StereoCameraConfig] = Field(description="both, called differently")


class LivePoint(Model):
    """A tool of the camera that rides on the part."""

    name: Name = Field(description="as the frames call it")
    at_mm: Vector3 = Field(description="origin of the tool in the component frame, mm")


class LiveConfig(Model):
    """The part is followed during every move; `camera` or `stereo` has to be there."""

    method: Literal["auto", "encoders", "ins", "repaired", "published"] = Field(
        default="auto", description="what follows the points; auto: the encoders' pose, corrected by what is seen"
    )
    grade: Literal["tactical", "mems", "adis16448", "consumer"] = Field(
        default="mems", description="what the inertial sensor is worth"
    )
    points: tuple[LivePoint, ...] = Field(default=(), description="tools on the part; further points: its targets")
    match_mm: Positive = Field(
        default=20.0, description="a single marker so near to where a target is expected is that target, mm"
    )
    sigma_mm: Positive = Field(default=0.1, description="noise of a coordinate of a seen point, 1 sigma, mm")
    delay_s: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        default=0.0, description="fixed delay of camera and line, taken off the times of its frames, s"
    )
    deviation_mm: Positive = Field(
        default=0.5, description="a move stops when a docking feature is so far from where the plan has it, mm"
    )
    frames: Annotated[int, Field(ge=1, le=100)] = Field(
        default=3, description="so many frames in a row have to show a deviation"
    )
    predicted_sd_mm: Positive = Field(
        default=0.3, description="a move stops when the pose is known no better than this at the worst point, mm"
    )
    blind_s: NonNegative = Field(
        default=30.0, description="a move stops when no point has been seen for so long, whatever is predicted, s"
    )
    rest_s: Annotated[float, Field(ge=0.1, le=10.0)] = Field(
        default=0.5, description="how long the points are looked at before every move, at rest, s"
    )
