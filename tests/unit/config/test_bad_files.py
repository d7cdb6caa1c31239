"""Every kind of bad cell and job file: the report names key, value and bound, all at once, and never a traceback."""

import copy
import json
import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from docking.config.check import check_cell, check_files, check_job
from docking.config.findings import Severity
from docking.config.load import default_job_path, file_sha256, load_cell, load_job
from docking.errors import EXIT_USAGE, ConfigInvalid, FileUnreadable

CELLS = Path(__file__).parents[3] / "sim" / "cells"
Doc = dict[str, Any]
Change = Callable[[Doc], object]


def toml(value: object) -> str:
    """A value as inline TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else str(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value)


def document(name: str) -> Doc:
    return tomllib.loads((CELLS / name).read_text("utf-8"))


def write(path: Path, doc: Doc) -> Path:
    path.write_text("\n".join(f"{json.dumps(k)} = {toml(v)}" for k, v in doc.items()) + "\n", "utf-8")
    return path


def cell_problems(tmp_path: Path, change: Change, base: str = "lab-can") -> tuple[str, ...]:
    doc = document(f"{base}.toml")
    change(doc)
    with pytest.raises(ConfigInvalid) as refused:
        load_cell(write(tmp_path / "cell.toml", doc))
    assert refused.value.exit_code == EXIT_USAGE
    return refused.value.problems


def job_problems(tmp_path: Path, change: Change, base: str = "lab-can") -> tuple[str, ...]:
    doc = document(f"{base}.job.toml")
    change(doc)
    with pytest.raises(ConfigInvalid) as refused:
        load_job(write(tmp_path / "cell.job.toml", doc), load_cell(CELLS / f"{base}.toml"))
    return refused.value.problems


def put(path: str, value: object) -> Change:
    """Set the entry at a dotted path: `positioners.1.axes.0.stroke_mm`."""

    def change(doc: Any) -> None:
        *way, last = path.split(".")
        for part in way:
            doc = doc[int(part)] if isinstance(doc, list) else doc[part]
        doc[int(last) if isinstance(doc, list) else last] = value

    return change


def drop(path: str) -> Change:
    def change(doc: Any) -> None:
        *way, last = path.split(".")
        for part in way:
            doc = doc[int(part)] if isinstance(doc, list) else doc[part]
        del doc[int(last) if isinstance(doc, list) else last]

    return change


CELL_CASES = {
    "negative speed": (put("positioners.1.axes.0.v_mm_s", -3.0), ["positioners[1].axes[0].v_mm_s = -3", "> 0"]),
    "zero acceleration": (put("positioners.0.axes.2.a_mm_s2", 0.0), ["positioners[0].axes[2].a_mm_s2 = 0", "> 0"]),
    "nan": (put("positioners.2.origin_mm.1", math.nan), ["positioners[2].origin_mm[1] = NaN", "finite"]),
    "infinity": (put("limits.internal_force_n", math.inf), ["limits.internal_force_n = infinity", "finite"]),
    "huge": (put("tracker.measure_timeout_s", 1e300), ["tracker.measure_timeout_s = 1e+300", "<= 1e+09"]),
    "text for a number": (put("settle.window_s", "1"), ["settle.window_s = '1'", "must be a number"]),
    "number for a text": (put("tracker.port", 4), ["tracker.port = 4", "text"]),
    "yes for a number": (put("settle.window_s", True), ["settle.window_s = true", "must be a number"]),
    "table for a list": (put("tracker.ers", {"a": 1}), ["tracker.ers = {a}", "must be a list"]),
    "unknown key": (put("tracker.bauds", 9600), ["tracker.bauds = 9600", "nearest valid key: baud"]),
    "unknown key in the bus": (put("bus.cycles", 0.01), ["bus.cycles = 0.01", "nearest valid key: cycle_s"]),
    "unknown key far away": (put("limits.zzz", 1), ["limits.zzz = 1", "valid keys: following_error_rest_mm"]),
    "missing key": (drop("tracker.port"), ["tracker.port: missing", "pyserial URL"]),
    "missing table": (drop("tracker"), ["tracker: missing"]),
    "baud too low": (put("tracker.baud", 300), ["tracker.baud = 300", ">= 1200"]),
    "unknown protocol": (put("tracker.protocol", "lion"), ["tracker.protocol = 'lion'", "'line' or 'geocom'"]),
    "unknown bus": (put("bus.kind", "profibus"), ["bus", "'canopen', 'modbus-tcp'"]),
    "bit rate": (put("bus.bitrate", 800000), ["bus.bitrate = 800000", "125000, 250000, 500000 or 1000000"]),
    "bad name": (put("positioners.0.name", "a b"), ["positioners[0].name = 'a b'", "must match"]),
    "schema version": (put("schema_version", 2), ["schema_version = 2", "must be 1"]),
    "stroke reversed": (
        put("positioners.1.axes.0.stroke_mm", [25.0, -25.0]),
        ["positioners[1].axes[0].stroke_mm", "[25, -25]", "below"],
    ),
    "stroke inside the margin": (
        put("positioners.1.axes.0.stroke_mm", [-0.5, 0.5]),
        ["positioners[1].axes[0].stroke_mm", "stroke_margin_mm = 1"],
    ),
    "quick stop slower than the ramp": (
        put("positioners.3.axes.1.a_quick_mm_s2", 5.0),
        ["positioners[3].axes[1].a_mm_s2", "20", "a_quick_mm_s2 = 5"],
    ),
    "two positioners of one name": (put("positioners.1.name", "A"), ["positioners[1].name", "'A'", "positioners[0]"]),
    "two reference points of one name": (put("tracker.ers.2.name", "E1"), ["tracker.ers[2].name", "'E1'"]),
    "two axes of one name": (put("positioners.1.axes.0.name", "Y"), ["positioners[1].axes", "Y, Y, Z"]),
    "two axes of one node": (put("positioners.1.axes.0.node", 1), ["positioners[1].axes[0].node", "1", "duplicate"]),
    "axis without node": (drop("positioners.1.axes.0.node"), ["positioners[1].axes[0].node", "missing", "CANopen"]),
    "node out of range": (put("positioners.1.axes.0.node", 128), ["positioners[1].axes[0].node = 128", "<= 127"]),
    "directions alike": (
        put("positioners.2.axes.1.direction", [1.0, 0.001, 0.0]),
        ["positioners[2].axes", "positioner C are not independent", "0.2"],
    ),
    "direction of no length": (
        put("positioners.2.axes.1.direction", [0.0, 0.0, 0.0]),
        ["positioners[2].axes[1].direction", "length 0", "0.9 to 1.1"],
    ),
    "direction in metres": (
        put("positioners.2.axes.1.direction", [0.0, 0.001, 0.0]),
        ["positioners[2].axes[1].direction", "length 0.001"],
    ),
    "Z follows": (put("positioners.3.axes.2.driven", False), ["positioners[3].axes[2].driven", "D.Z", "tips"]),
    "gravity of no direction": (put("gravity_direction", [0.0, 0.0, 0.0]), ["gravity_direction", "length 0", "unit"]),
    "budget over stop": (
        put("limits.sync_error_mm", 0.2),
        ["limits.sync_error_mm", "0.2", "limits.ball_residual_mm = 0.1"],
    ),
    "heartbeat slower than its guard": (
        put("bus.heartbeat_s", 0.5),
        ["bus.drive_timeout_s", "0.28", "bus.heartbeat_s = 0.5"],
    ),
    "bus too slow": (put("bus.bitrate", 125000), ["bus.cycle_s", "12 axes at 125000 bit/s", "over 100 %"]),
    "load cells undescribed": (drop("load_cells"), ["load_cells", "missing", "positioners[0].load_cell"]),
    "reference points on a line": (
        lambda doc: [point.update(xyz_mm=[100.0 * i, 0.0, 0.0]) for i, point in enumerate(doc["tracker"]["ers"])],
        ["tracker.ers", "lie on a line", "0.001"],
    ),
    "empty positioners": (put("positioners", []), ["positioners = []", "at least 3"]),
}


@pytest.mark.parametrize("case", CELL_CASES)
def test_a_bad_cell_is_named_by_key_value_and_bound(case: str, tmp_path: Path) -> None:
    change, words = CELL_CASES[case]
    problems = cell_problems(tmp_path, change)
    assert any(all(word in problem for word in words) for problem in problems), problems


def only_driven(*axes: str) -> Change:
    def change(doc: Doc) -> None:
        for positioner in doc["positioners"]:
            for axis in positioner["axes"]:
                axis["driven"] = f"{positioner['name']}.{axis['name']}" in axes

    return change


def test_a_rank_deficient_set_is_refused(tmp_path: Path) -> None:
    """Two X axes in one line with the four Z: nothing but the small tilt of the bases holds Y and the yaw."""
    problems = cell_problems(tmp_path, only_driven("A.Z", "B.Z", "C.Z", "D.Z", "A.X", "B.X"))
    assert any("positioners: " in p and "rank-deficient" in p and "A.X, A.Z, B.X" in p for p in problems), problems


def test_too_few_driven_axes_are_counted(tmp_path: Path) -> None:
    problems = cell_problems(tmp_path, only_driven("A.Z", "B.Z", "C.Z", "D.Z", "A.X"))
    assert any("5 driven axes" in p and "six or more" in p for p in problems), problems


def test_a_badly_conditioned_set_is_refused(tmp_path: Path) -> None:
    problems = cell_problems(tmp_path, put("limits.condition_max", 1.5))
    assert any("condition 1.8" in p and "limits.condition_max = 1.5" in p for p in problems), problems


def test_modbus_needs_its_address_and_only_once(tmp_path: Path) -> None:
    problems = cell_problems(tmp_path, drop("positioners.1.port"), "lab-modbus")
    assert any("positioners[1].port" in p and "host, port and unit" in p for p in problems), problems
    problems = cell_problems(tmp_path, put("positioners.1.port", 15021), "lab-modbus")
    assert any("positioners[1]" in p and "127.0.0.1:15021:1" in p and "positioners[0]" in p for p in problems), problems


JOB_CASES = {
    "empty start": (put("start", "empty"), ["start", "'empty'", "homing and ball entry", 'start = "seated"']),
    "two targets of one name": (put("component.targets.3.name", "J01"), ["component.targets[3].name", "'J01'"]),
    "check point named as a target": (
        put("component.check_points.0.name", "J02"),
        ["component.check_points[0].name", "'J02'", "component.targets[1].name"],
    ),
    "mate target named as a target": (put("mate.targets.0.name", "J02"), ["mate.targets[0].name", "'J02'"]),
    "target named as a reference point": (
        put("component.targets.3.name", "E2"),
        ["component.targets[3].name", "'E2'", "tracker.ers[1]"],
    ),
    "two features of one name": (put("component.features.1.name", "upper-right"), ["component.features[1].name"]),
    "sigma zero": (put("component.targets.0.sigma_mm", 0.0), ["component.targets[0].sigma_mm = 0", "> 0"]),
    "ball for no positioner": (
        put("component.balls.3.positioner", "Q"),
        ["component.balls[3].positioner", "'Q'", "A, B, C, D"],
    ),
    "positioner without ball": (drop("component.balls.3"), ["component.balls", "positioner D has no ball"]),
    "two balls for one positioner": (
        put("component.balls.3.positioner", "A"),
        ["component.balls[3]", "'A'", "duplicate"],
    ),
    "normal not unit": (
        put("component.targets.1.normal", [0.0, -1.0, 0.1]),
        ["component.targets[1].normal", "1.00499", "unit vector"],
    ),
    "docking axis not unit": (put("docking_axis", [2.0, 0.0, 0.0]), ["docking_axis", "length 2", "unit vector"]),
    "stand-offs not falling": (put("stages.1.standoff_mm", 9.0), ["stages[1].standoff_mm", "9 mm", "8 mm"]),
    "last stage not at zero": (put("stages.2.standoff_mm", 0.5), ["stages[2].standoff_mm", "0.5 mm", "0 mm"]),
    "stage too fast": (put("stages.0.speed_mm_s", 50.0), ["stages[0].speed_mm_s", "50 mm/s", "v_mm_s = 5"]),
    "stage out of reach": (put("stages.0.standoff_mm", 40.0), ["stages[0].standoff_mm", "A.X", "-40.00", "-24 to 24"]),
    "unknown permissive": (
        put("stages.0.permissives", ["crane_fre"]),
        ["stages[0].permissives[0]", "'crane_fre'", "crane_free"],
    ),
    "passes over the most": (put("measuring.passes", 8), ["measuring.passes", "8", "measuring.max_passes = 6"]),
    "too many drift points": (put("measuring.drift_points", 8), ["measuring.drift_points", "8", "7 of tracker.ers"]),
    "collinear targets": (
        lambda doc: [t.update(xyz_mm=[50.0 * i, 0.0, 0.0]) for i, t in enumerate(doc["component"]["targets"])],
        ["component.targets", "lie on a line", "0.001"],
    ),
    "collinear mate targets": (
        lambda doc: [t.update(xyz_mm=[50.0 * i, 0.0, 0.0]) for i, t in enumerate(doc["mate"]["targets"])],
        ["mate.targets", "lie on a line"],
    ),
    "targets on one spot": (
        lambda doc: [t.update(xyz_mm=[5.0, 0.0, 0.0]) for t in doc["component"]["targets"]],
        ["component.targets", "0 mm of 0 mm"],
    ),
    "features do not fit": (
        put("component.features.0.mate_xyz_mm", [0.0, 150.0, 105.0]),
        ["component.features[0].mate_xyz_mm", "upper-right", "tolerance 0.1 mm"],
    ),
    "part tips": (
        put("component.com_mm", [290.0, 10.0, 0.0]),
        ["component.com_mm", "could tip", "ball A", "reaction_min_fraction = 0.1"],
    ),
    "part tips at the end of its tolerance": (
        put("component.com_tolerance_mm", [260.0, 5.0, 5.0]),
        ["component.com_mm", "could tip", "260.0"],
    ),
    "part too heavy": (put("component.mass_kg", 400.0), ["component.mass_kg", "C.Z", "rated_n is 500"]),
    "tolerance not provable": (
        put("component.features.1.tolerance_mm", 0.01),
        ["component.features[1].tolerance_mm", "0.01 mm", "lower-right", "2 sigma = 0.0275", "largest part"],
    ),
    "risk too high though 2 sigma fit": (
        lambda doc: [feature.update(tolerance_mm=0.034) for feature in doc["component"]["features"]],
        ["component.features[1].tolerance_mm", "lower-right", "no error measured", "tolerance is 1", "at most 2.5%"],
    ),
    "nan": (put("component.com_mm.2", math.nan), ["component.com_mm[2] = NaN", "finite"]),
    "unknown key": (put("component.massa_kg", 60.0), ["component.massa_kg = 60", "nearest valid key: mass_kg"]),
    "no features": (drop("component.features"), ["component.features: missing"]),
    "too few targets": (
        lambda doc: doc["component"].update(targets=doc["component"]["targets"][:2]),
        ["component.targets", "at least 3"],
    ),
}


@pytest.mark.parametrize("case", JOB_CASES)
def test_a_bad_job_is_named_by_key_value_and_bound(case: str, tmp_path: Path) -> None:
    change, words = JOB_CASES[case]
    problems = job_problems(tmp_path, change)
    assert any(all(word in problem for word in words) for problem in problems), problems


def test_a_mirrored_mate_is_recognised(tmp_path: Path) -> None:
    """Four coplanar features are their own mirror image; one out of the plane tells left from right."""

    def change(doc: Doc) -> None:
        doc["component"]["features"][0]["xyz_mm"] = [350.0, 150.0, 100.0]
        doc["component"]["features"][0]["mate_xyz_mm"] = [100.0, 150.0, 100.0]

    assert any("mirror image" in p for p in job_problems(tmp_path, change))


def test_a_total_station_cannot_prove_what_a_tracker_can(tmp_path: Path) -> None:
    cell = document("fuselage-can.toml")
    cell["tracker"]["device_class"] = "total-station"
    checked = load_cell(write(tmp_path / "cell.toml", cell))
    with pytest.raises(ConfigInvalid) as refused:
        load_job(CELLS / "fuselage-can.job.toml", checked)
    problems = refused.value.problems
    assert any("feature right cannot be proved" in p for p in problems)
    assert all("total-station" in p and "instrument noise on the" in p for p in problems)


def test_all_problems_of_a_file_are_reported_at_once(tmp_path: Path) -> None:
    def change(doc: Doc) -> None:
        put("positioners.1.axes.0.v_mm_s", -3.0)(doc)
        put("tracker.bauds", 9600)(doc)
        put("positioners.2.name", "A")(doc)
        put("positioners.1.axes.1.stroke_mm", [5.0, -5.0])(doc)
        put("settle.window_s", math.nan)(doc)

    problems = cell_problems(tmp_path, change)
    for key in ("axes[0].v_mm_s", "tracker.bauds", "positioners[2].name", "axes[1].stroke_mm", "settle.window_s"):
        assert sum(key in problem for problem in problems) == 1, problems


def test_an_unknown_key_does_not_hide_what_the_geometry_says(tmp_path: Path) -> None:
    def change(doc: Doc) -> None:
        put("component.weight_kg", 60.0)(doc)
        put("component.com_mm", [290.0, 10.0, 0.0])(doc)

    problems = job_problems(tmp_path, change)
    assert any("weight_kg" in p for p in problems)
    assert any("could tip" in p for p in problems)


WARNINGS = {
    "six targets": (
        lambda doc: doc["component"].update(targets=doc["component"]["targets"][:6]),
        ["component.targets", "6 targets", "7 or more"],
    ),
    "no check points": (drop("component.check_points"), ["component.check_points", "none"]),
}


@pytest.mark.parametrize("case", WARNINGS)
def test_what_is_only_unwise_is_a_warning(case: str, tmp_path: Path) -> None:
    change, words = WARNINGS[case]
    doc = document("lab-can.job.toml")
    change(doc)
    result = check_files(CELLS / "lab-can.toml", write(tmp_path / "x.job.toml", doc))
    ((_, finding),) = result.warnings
    assert finding.severity is Severity.WARNING
    assert all(word in str(finding) for word in words)
    assert f"warning: x.job.toml: {finding}" in result.text


def test_a_left_handed_positioner_is_a_warning(tmp_path: Path) -> None:
    doc = document("lab-can.toml")
    axis = doc["positioners"][1]["axes"][1]
    axis["direction"] = [-v for v in axis["direction"]]
    (finding,) = check_cell(load_cell(write(tmp_path / "cell.toml", doc)))
    assert finding.severity is Severity.WARNING
    assert "left-handed" in finding.text


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a = 1\nb = = 2\n", ["TOML syntax", "line 2"]),
        (b"a = 1\na = 2\n", ["TOML syntax", "line 2"]),
        (b"a = [1,\n\n", ["TOML syntax", "line 3"]),
        (b'ok = 1\nname = "\xff"\n', ["UTF-8", "line 2"]),
        (b"a = " + b"[" * 5000, ["TOML"]),
        (b"a = 1" + b"0" * 5000, ["TOML"]),
        (b"x" * 5_000_000, ["4000000"]),
    ],
)
def test_a_file_that_is_no_toml_is_unreadable(content: bytes, words: list[str], tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_bytes(content)
    with pytest.raises(FileUnreadable) as refused:
        load_cell(path)
    assert all(word in str(refused.value) for word in [*words, str(path)])
    assert refused.value.exit_code == EXIT_USAGE


def test_a_missing_file_and_a_directory_are_unreadable(tmp_path: Path) -> None:
    for path, word in ((tmp_path / "none.toml", "no such file"), (tmp_path, "directory")):
        with pytest.raises(FileUnreadable, match=word):
            load_cell(path)
        with pytest.raises(FileUnreadable, match=word):
            file_sha256(path)


def test_the_other_kind_of_file_is_recognised() -> None:
    with pytest.raises(ConfigInvalid, match=r"this is a JOB file .*a CELL file is wanted"):
        load_cell(CELLS / "lab-can.job.toml")
    with pytest.raises(ConfigInvalid, match=r"this is a CELL file .*a JOB file is wanted"):
        load_job(CELLS / "lab-can.toml", load_cell(CELLS / "lab-can.toml"))


def test_a_file_of_no_kind_is_said_to_be_none(tmp_path: Path) -> None:
    path = tmp_path / "other.toml"
    path.write_text("[project]\nversion = '1'\n")
    with pytest.raises(ConfigInvalid, match="not a CELL file: it has none of bus, name, positioners, tracker"):
        load_cell(path)


def test_the_job_stands_beside_its_cell() -> None:
    assert default_job_path("a/b/fuselage-can.toml") == Path("a/b/fuselage-can.job.toml")
    assert default_job_path(Path("x/cell")) == Path("x/cell.job.toml")


def test_the_hash_is_of_the_bytes(tmp_path: Path) -> None:
    path = tmp_path / "abc"
    path.write_bytes(b"abc")
    assert file_sha256(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


# ----------------------------------------------------- whatever is in a file, it loads or is refused
LEAVES = st.one_of(
    st.floats(allow_nan=True),
    st.integers(),
    st.booleans(),
    st.text(max_size=8).filter(lambda s: s.isprintable()),
    st.sampled_from([0.0, -1.0, 1e-300, 1e9, -1e9, 10**400, [], {}, [1.0, 2.0], ["A"], {"name": "X"}]),
    st.lists(st.floats(-1e9, 1e9), min_size=3, max_size=3),
)


def places(doc: object, here: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    items = list(doc.items()) if isinstance(doc, dict) else list(enumerate(doc)) if isinstance(doc, list) else []
    return [place for key, value in items for place in ((*here, key), *places(value, (*here, key)))]


@st.composite
def damaged(draw: st.DrawFn, name: str) -> Doc:
    """A valid document with one to four entries replaced, removed, doubled or added."""
    doc = copy.deepcopy(document(name))
    for _ in range(draw(st.integers(1, 4))):
        *way, last = draw(st.sampled_from(places(doc)))
        owner: Any = doc
        for part in way:
            owner = owner[part]
        match draw(st.sampled_from(["replace", "replace", "remove", "double", "add"])):
            case "replace":
                owner[last] = draw(LEAVES)
            case "remove":
                del owner[last]
            case "double" if isinstance(owner, list):
                owner.append(copy.deepcopy(owner[last]))
            case _:
                entry = draw(LEAVES)
                owner.append(entry) if isinstance(owner, list) else owner.update({draw(st.text(max_size=6)): entry})
    return doc


def loads_or_is_refused(load: Callable[[], object]) -> None:
    said: tuple[str, ...] = ("loaded",)
    try:
        load()
    except ConfigInvalid as refused:
        said = refused.problems
    except FileUnreadable as refused:
        said = (refused.cause,)
    assert said
    assert all(said)


@settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))
@given(doc=damaged("wing-modbus.toml"))
def test_a_damaged_cell_loads_or_is_refused(doc: Doc, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = write(tmp_path_factory.mktemp("cell") / "cell.toml", doc)
    loads_or_is_refused(lambda: load_cell(path))


@settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))
@given(doc=damaged("lab-can.job.toml"))
def test_a_damaged_job_loads_or_is_refused(doc: Doc, tmp_path_factory: pytest.TempPathFactory) -> None:
    cell = load_cell(CELLS / "lab-can.toml")
    path = write(tmp_path_factory.mktemp("job") / "cell.job.toml", doc)
    loads_or_is_refused(lambda: load_job(path, cell))


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(cut=st.integers(0, 9000), length=st.integers(0, 60), insert=st.binary(max_size=12))
def test_damaged_bytes_load_or_are_refused(
    cut: int, length: int, insert: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = (CELLS / "lab-can.toml").read_bytes()
    path = tmp_path_factory.mktemp("bytes") / "cell.toml"
    path.write_bytes(data[:cut] + insert + data[cut + length :])
    loads_or_is_refused(lambda: load_cell(path))


def test_checks_of_a_model_changed_in_memory_find_the_same() -> None:
    """Studies change a job in memory: the checks do not need the file."""
    cell = load_cell(CELLS / "lab-can.toml")
    job = load_job(CELLS / "lab-can.job.toml", cell)
    turned = job.model_copy(update={"stages": job.stages[::-1]})
    assert any("must be below the stage before it" in f.text for f in check_job(cell, turned))
