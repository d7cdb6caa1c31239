"""`docking track`: options to gaps, files to an answer, the answer to words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from docking.errors import BadArgument
from docking.recordings import read_recording
from docking.tracking.follow import Followed, FollowSettings, follow
from docking.tracking.grades import GRADES
from docking.tracking.recording import Gap, Recording
from docking.tracking.replay import every

END_S = 0.1
"""By so much a gap may end after the last frame: nobody counts frames."""


def run_track(files: Sequence[Path], options: Mapping[str, object]) -> Followed:
    """Read, hide, follow. Raises FileUnreadable, BadRecording, BadArgument and what the trackers raise."""
    settings, sigma = settings_of(options)
    recording = read_recording(files, sigma)
    return follow(recording, gaps_of(recording, options), settings)


def settings_of(options: Mapping[str, object]) -> tuple[FollowSettings, float]:
    """How to follow, and the noise of a coordinate where no file states one, mm. Raises BadArgument."""
    sigma = options["sigma_mm"]
    if not (isinstance(sigma, float) and 0.0 < sigma < float("inf")):
        raise BadArgument("--sigma-mm", "a positive length is needed", value=str(sigma))
    settings = FollowSettings(
        str(options["method"]), GRADES[str(options["grade"])], rest=not options.get("creeping", False)
    )
    return settings, sigma


def gaps_of(recording: Recording, options: Mapping[str, object]) -> list[Gap]:
    """The gaps that `--occlude` and `--occlude-every` ask for, in order of time. Raises BadArgument."""
    asked = options.get("occlude") or ()
    assert isinstance(asked, tuple)
    gaps = [Gap(*_pair("--occlude", str(text))) for text in asked]
    regular = options.get("occlude_every")
    if regular is not None:
        period, length = _pair("--occlude-every", str(regular))
        if not (0.0 < length < period):
            raise BadArgument("--occlude-every", "LENGTH is shorter than PERIOD", value=str(regular))
        gaps += every(recording, period, length)
    whole = float(recording.frame_t_s[-1]) - recording.begin_s
    for gap in gaps:
        end = gap.start_s + gap.length_s
        if not (end <= whole + END_S):
            raise BadArgument("--occlude", "the recording ends before the gap does", value=end, limit=whole)
    gaps.sort()
    for a, b in pairwise(gaps):
        if not (a.start_s + a.length_s <= b.start_s):
            raise BadArgument("--occlude", "gaps must not overlap", value=b.start_s, limit=a.start_s + a.length_s)
    return gaps


def _pair(option: str, text: str) -> tuple[float, float]:
    first, _, second = text.partition(":")
    try:
        a, b = float(first), float(second)
    except ValueError:
        raise BadArgument(option, "write two numbers of seconds with a colon", value=text) from None
    if not (0.0 <= a < float("inf") and 0.0 < b < float("inf")):
        raise BadArgument(option, "times are finite, lengths positive", value=text)
    return a, b


def track_text(result: Followed) -> str:
    """The answer for a person."""
    answer = result.as_json()
    lines = [f"{result.recording.name}: method {result.method}, {answer['frames']} frames followed"]
    if result.choice is not None:
        lines.append(f"auto chose {result.choice.method}: {result.choice.why}")
    if len(result.recording.imu_t_s):
        lines.append(f"inertial stamps late by {1000.0 * result.time_offset_s:.2f} ms")
    for gap in result.gaps:
        kind = "moving" if gap.moving else "at rest"
        lines.append(
            f"  {gap.start_s:8.2f} s + {gap.length_s:.2f} s {kind:<8} end {gap.end_error_mm:9.3f} mm, largest "
            f"{gap.max_error_mm:9.3f} mm, predicted sd {gap.predicted_sd_mm:9.3f} mm, "
            f"hold-last {gap.hold_last_mm:9.3f} mm"
        )
    if result.gaps:
        lines.append(
            f"end of gap: median {answer['median_end_error_mm']:.3f} mm, 90 % {answer['p90_end_error_mm']:.3f} mm; "
            f"hold-last median {answer['median_hold_last_mm']:.3f} mm"
        )
    lines += [f"ALARM {error.code}: {error.text()}" for error in result.alarms]
    return "\n".join(lines)
