"""From a run's journal and its job to what is drawn in the operator's picture; and the steps of work ticked off.

Only what the journal proves is drawn: the component where it was measured last, or where a whole planned move took it;
after a move that did not end its place is unknown and it is not drawn at all.
"""

from __future__ import annotations

import time
import tomllib
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from docking.config.instructions import Instruction
from docking.config.job import JobFile
from docking.config.load import file_sha256, load_cell, load_job
from docking.errors import BadArgument
from docking.geometry import exp_so3, pose_from_vector
from docking.guidance.mesh import Mesh, read_mesh
from docking.guidance.scene import Line, Mark, PartToPlace, Scene, Tone
from docking.journal import JournalFile, Record, read
from docking.types import Array, Pose

STEP_KIND = "instruction"
NEAR_SHARE = 0.8
"""e + 2 sigma beyond this share of the tolerance is near the limit."""
_ARROW_MM = 80.0
"""The longest vector of a kind is drawn about this long."""


@dataclass(frozen=True, eq=False)
class Source:
    """A verified journal, the job it is about, and where that lies."""

    records: list[Record]
    job: JobFile
    job_path: Path

    def last(self, kind: str, **wanted: str) -> Record | None:
        """The newest record of a kind whose body has these values."""
        for record in reversed(self.records):
            if record["kind"] == kind and all(record["body"].get(k) == v for k, v in wanted.items()):
                return record
        return None


def open_source(journal: Path, job: Path | None) -> Source:
    """The journal of a run and its job; `job` where the file has moved since.

    Raises JournalCorrupt, FileUnreadable, ConfigInvalid, BadArgument when the job is not the one of the run.
    """
    records = read(journal)
    started = next((r["body"] for r in reversed(records) if r["kind"] == "run_started"), None)
    if started is None:
        raise BadArgument("--journal", "no run begins in it", value=str(journal))
    path = job or _existing(Path(started["job"]), journal)
    if file_sha256(path) != started["job_sha256"]:
        raise BadArgument("--job", "the file is not the one of the run: it has been changed since", value=str(path))
    cell = load_cell(_existing(Path(started["cell"]), journal) if job is None else _cell_beside(job, started))
    return Source(records, load_job(path, cell, proof=False), path)


def _existing(path: Path, journal: Path) -> Path:
    """A path of the journal as it stands, or beside the journal."""
    return path if path.exists() else journal.parent / path.name


def _cell_beside(job: Path, started: dict[str, Any]) -> Path:
    stated = Path(started["cell"])
    return stated if stated.exists() else job.parent / stated.name


@cache
def overlay_texts(language: str) -> dict[str, str]:
    """The words of the picture in one language."""
    text = resources.files("docking.locale").joinpath(f"overlay.{language}.toml").read_text("utf-8")
    return {key: str(value) for key, value in tomllib.loads(text).items()}


def build_scene(source: Source, language: str, now: datetime | None = None) -> Scene:
    """What is true in the cell at the end of the journal; ages are counted to `now` (default: the time of day)."""
    return _Builder(source, overlay_texts(language), language, now or datetime.now(UTC)).scene()


class _Builder:
    """Gathers lines, marks and words of one scene."""

    def __init__(self, source: Source, texts: dict[str, str], language: str, now: datetime) -> None:
        self._source, self._job, self._texts = source, source.job, texts
        self._language, self._now = language, now
        self._lines: list[Line] = []
        self._marks: list[Mark] = []
        self._head: list[tuple[str, Tone]] = []

    def scene(self) -> Scene:
        started = self._source.last("run_started")
        if started is not None and started["body"].get("simulated"):
            self._head.append((self._texts["simulated"], "dim"))
        X_WM = self._mate()
        X_WC = self._component()
        if X_WC is not None:
            self._lines += _outline(self._job, X_WC)
        parts, steps = self._instructions(X_WC)
        anchor = self._anchor(X_WC, X_WM, parts)
        return Scene(
            anchor, tuple(self._lines), tuple(self._marks), parts, tuple(self._head), steps, self._texts
        )  # fmt: skip

    def _anchor(self, X_WC: Pose | None, X_WM: Pose, parts: tuple[PartToPlace, ...]) -> Array:
        """What the picture is about: the next part, else the component's docking face, else the mate."""
        coming = [part for part in parts if part.tone == "next"]
        if coming:
            return coming[0].X_WP.t_mm
        if X_WC is not None:
            return X_WC.apply(self._job.component.docking_face_mm)
        return X_WM.apply(np.mean([f.mate_xyz_mm for f in self._job.component.features], axis=0))

    def _mate(self) -> Pose:
        fit = self._source.last("fit", what="mate")
        X_WM = pose_from_vector(self._job.mate.pose) if fit is None else _pose(fit["body"]["X"])
        self._lines += [Line(X_WM.apply(ring), "dim") for box in self._job.mate.envelope for ring in _box(box)]
        return X_WM

    def _component(self) -> Pose | None:
        """X_WC as measured or moved since, with marks and words; None where it is not known."""
        fit = self._source.last("fit", what="component")
        if fit is None:
            self._head.append((self._texts["nothing"], "close"))
            return None
        X_WC = _pose(fit["body"]["X"])
        moves = [r for r in self._source.records if r["kind"] in ("intent", "moved") and r["seq"] > fit["seq"]]
        stage = {"stage": fit["body"]["stage"], "age": self._age(fit["t_wall"])}
        self._head.append((self._texts["state"].format(**stage), "plain"))
        if not moves:
            self._targets(fit["body"], X_WC)
            self._features(X_WC, fit)
            self._next_move(X_WC, fit)
            return X_WC
        if len(moves) % 2 or any(r["body"].get("result") != "done" for r in moves if r["kind"] == "moved"):
            self._head.append((self._texts["unknown"], "bad"))
            return None
        return self._moved(X_WC, fit)

    def _moved(self, X_WC: Pose, fit: Record) -> Pose:
        """Where whole moves took the component."""
        plans = {r["body"]["plan_hash"]: r["body"] for r in self._source.records if r["kind"] == "plan"}
        for record in self._source.records:
            if record["kind"] == "moved" and record["seq"] > fit["seq"]:
                plan = plans[record["body"]["plan_hash"]]
                X_WC = _corrected(X_WC, plan["correction"])
                self._head.append((self._texts["moved"].format(stage=plan["stage"]), "close"))
        return X_WC

    def _age(self, t_wall: str) -> str:
        seconds = max(0.0, (self._now - datetime.fromisoformat(t_wall)).total_seconds())
        if seconds < 120.0:
            return self._texts["age_s"].format(seconds=seconds)
        if seconds < 7200.0:
            return self._texts["age_min"].format(minutes=seconds / 60.0)
        if seconds < 172800.0:
            return self._texts["age_h"].format(hours=seconds / 3600.0)
        return self._texts["age_d"].format(days=seconds / 86400.0)

    def _targets(self, fit: dict[str, Any], X_WC: Pose) -> None:
        rejected = {item["name"]: item["reason"] for item in fit["rejected"]}
        residuals = {name: np.array(vector) for name, vector in fit["residuals_mm"].items()}
        magnified = _magnification([float(np.linalg.norm(v)) for v in residuals.values()])
        for target in self._job.component.targets:
            at = X_WC.apply(np.array(target.xyz_mm) + target.reflector_offset_mm * np.array(target.normal))
            if target.name in rejected:
                words = self._texts["rejected"].format(name=target.name, reason=rejected[target.name])
                self._marks.append(Mark(at, words, "bad"))
            elif target.name in residuals:
                vector = residuals[target.name]
                words = self._texts["target"].format(name=target.name, residual_mm=float(np.linalg.norm(vector)))
                self._marks.append(Mark(at, words, "plain", vector, magnified))
        self._head.append((self._texts["magnified"].format(magnified=magnified), "dim"))

    def _features(self, X_WC: Pose, fit: Record) -> None:
        record = self._source.last("features")
        if record is None or record["seq"] < fit["seq"]:
            return
        body = record["body"]
        places = {f.name: np.array(f.xyz_mm) for f in self._job.component.features}
        magnified = _magnification(body["norm_mm"])
        rows = zip(
            body["names"], body["error_mm"], body["norm_mm"], body["sigma_mm"], body["tolerance_mm"], strict=True
        )  # fmt: skip
        for name, error, norm, sigma, tolerance in rows:
            key, tone = _judged(norm, sigma, tolerance)
            words = self._texts[key].format(name=name, error_mm=norm, tolerance_mm=tolerance)
            # The arrow points where the feature must go: against its deviation.
            vector = -np.array(error)
            self._marks.append(Mark(X_WC.apply(places[name]), words, tone, vector, magnified, "feature"))
        self._head.append((self._texts["feature_arrows"].format(magnified=magnified), "dim"))

    def _next_move(self, X_WC: Pose, fit: Record) -> None:
        record = self._source.last("plan")
        if record is None or record["seq"] < fit["seq"]:
            return
        X_next = _corrected(X_WC, record["body"]["correction"])
        balls = {ball.positioner: np.array(ball.xyz_mm) for ball in self._job.component.balls}
        vectors = {name: X_next.apply(ball) - X_WC.apply(ball) for name, ball in balls.items()}
        lengths = {name: float(np.linalg.norm(vector)) for name, vector in vectors.items()}
        magnified = _magnification(list(lengths.values()))
        for name, vector in vectors.items():
            words = self._texts["move"].format(name=name, length_mm=lengths[name])
            self._marks.append(Mark(X_WC.apply(balls[name]), words, "next", vector, magnified, "move"))
        facts = {"stage": record["body"]["stage"], "length_mm": max(lengths.values()), "magnified": magnified}
        self._head.append((self._texts["next_move"].format(**facts), "next"))

    def _instructions(self, X_WC: Pose | None) -> tuple[tuple[PartToPlace, ...], tuple[tuple[str, Tone], ...]]:
        """The next part at its place, those done as outlines; and the list of steps. Meshes lie beside the job."""
        parts: list[PartToPlace] = []
        steps: list[tuple[str, Tone]] = []
        for step, state in step_states(self._source):
            tool = step.tool or self._texts["no_tool"]
            words = self._texts[f"step_{state}"].format(order=step.order, text=step.text(self._language), tool=tool)
            tone: Tone = {"next": "next", "done": "good"}.get(state, "dim")  # type: ignore[assignment]
            steps.append((words, tone))
            base = Pose.identity() if step.frame == "cell" else X_WC
            if base is not None and state != "later":
                place = base @ pose_from_vector(step.pose)
                parts.append(PartToPlace(step.name, place, self._mesh(step), tone, words if state == "next" else ""))
        if steps and not any(part.tone == "next" for part in parts) and all(tone == "good" for _, tone in steps):
            steps.append((self._texts["all_done"], "good"))
        return tuple(parts), tuple(steps)

    def _mesh(self, step: Instruction) -> Mesh | None:
        return None if step.mesh is None else read_mesh(self._source.job_path.parent / step.mesh)


def _judged(norm_mm: float, sigma_mm: float | None, tolerance_mm: float) -> tuple[str, Tone]:
    """The words and colour of a deviation by the decision rule e + 2 sigma <= tolerance; unknown sigma is out."""
    reach = float("nan") if sigma_mm is None else norm_mm + 2.0 * sigma_mm
    if reach <= NEAR_SHARE * tolerance_mm:
        return "within", "good"
    return ("near", "close") if reach <= tolerance_mm else ("out", "bad")


def _magnification(lengths_mm: list[float]) -> float:
    """1, 2, 5, 10, ... times, so that the longest is drawn at most _ARROW_MM long; never smaller than it is."""
    longest = max([*lengths_mm, 1e-6])
    if longest >= _ARROW_MM / 2.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(_ARROW_MM / longest))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power * longest <= _ARROW_MM))


def _pose(matrix: list[list[float]]) -> Pose:
    m = np.array(matrix, dtype=np.float64)
    return Pose(m[:3, :3], m[:3, 3])


def _corrected(X_WC: Pose, correction: dict[str, list[float]]) -> Pose:
    """The pose after a planned displacement: turned by the rotation vector about the pivot, and shifted."""
    R = exp_so3(np.radians(correction["rotvec_deg"]))
    pivot = np.array(correction["pivot_mm"])
    return Pose(R @ X_WC.R, R @ (X_WC.t_mm - pivot) + pivot + np.array(correction["shift_mm"]))


def _outline(job: JobFile, X_WC: Pose) -> list[Line]:
    rings = [np.array([*ring, ring[0]]) for ring in job.component.outline_mm]
    lines = [Line(X_WC.apply(ring)) for ring in rings]
    if len(rings) == 2 and len(rings[0]) == len(rings[1]):
        lines += [Line(X_WC.apply(np.array([a, b]))) for a, b in zip(rings[0][:-1], rings[1][:-1], strict=True)]
    return lines


def _box(box: Any) -> list[Array]:
    """The two faces of a box along x, as closed rings (5, 3), and the four edges between them."""
    low, high = np.array(box.min_mm), np.array(box.max_mm)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    rings = [np.column_stack([np.full(5, x), *(low[1:] + corners * (high - low)[1:]).T]) for x in (low[0], high[0])]
    return [*rings, *(np.array([a, b]) for a, b in zip(rings[0][:-1], rings[1][:-1], strict=True))]


def step_states(source: Source) -> list[tuple[Instruction, str]]:
    """The steps of the job in their order, each `done`, `next` or `later`, as the journal has them."""
    done: dict[str, bool] = {}
    for record in source.records:
        if record["kind"] == STEP_KIND:
            done[record["body"]["step"]] = bool(record["body"]["done"])
    ordered = sorted(source.job.instructions, key=lambda step: step.order)
    coming = next((step.name for step in ordered if not done.get(step.name, False)), None)
    return [
        (step, "done" if done.get(step.name, False) else "next" if step.name == coming else "later") for step in ordered
    ]


def tick(journal: Path, source: Source, step: str, by: str, *, done: bool) -> None:
    """Write into the journal that a person has done a step, or takes that back.

    Raises BadArgument for a step the job does not have or that is not the next one, JournalBusy while a run holds it.
    """
    states = {item.name: state for item, state in step_states(source)}
    if step not in states:
        raise BadArgument("step", f"the steps are {', '.join(states) or 'none'}", value=step)
    if done and states[step] != "next":
        raise BadArgument(
            "step", "it is done already" if states[step] == "done" else "another step is next", value=step
        )
    if not done and states[step] != "done":
        raise BadArgument("step", "it is not done", value=step)
    if not by.strip():
        raise BadArgument("--by", "who has done it must have a name", value=by)
    file = JournalFile(journal, time.monotonic)
    try:
        file.write(STEP_KIND, {"step": step, "done": done, "by": by.strip()})
    finally:
        file.close()
