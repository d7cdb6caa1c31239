"""The report: made from the journal alone, readable anywhere, honest about what is not known."""

from __future__ import annotations

import re
import tomllib
from html.parser import HTMLParser
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from docking.errors import BadArgument, FileUnreadable, catalogue
from docking.motion.lateness import Lateness
from docking.report import page as page_module
from docking.report import summary, write_report
from docking.report.page import html
from tests.unit.report.fake_run import FakeRun, docked_run, faulted_run, records_of

VOID = {"meta", "br", "link", "img", "hr", "input"}


class Page(HTMLParser):
    """Refuses badly nested pages; collects ids, references and visible text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.tags: set[str] = set()
        self.ids: list[str] = []
        self.references: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.stack == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in VOID:
            self.stack.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            elif name in ("href", "src", "xlink:href"):
                self.references.append(value or "")
            self.references += re.findall(r"url\(([^)]*)\)", value or "")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.stack.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.stack, f"</{tag}> closes nothing"
        assert self.stack.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.stack:
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


@pytest.fixture(scope="module")
def docked(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    return records_of(docked_run(), tmp_path_factory.mktemp("run") / "run.jsonl")


@pytest.fixture(scope="module")
def docked_page(docked: list[dict[str, Any]]) -> str:
    return html(docked)


def records(run: FakeRun, tmp_path: Path) -> list[dict[str, Any]]:
    return records_of(run, tmp_path / "run.jsonl")


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the drawing out where a test looks at the words."""
    monkeypatch.setattr(page_module, "drawings", lambda run, words: {})


def last(found: list[dict[str, Any]], kind: str) -> dict[str, Any]:
    body: dict[str, Any] = next(r["body"] for r in reversed(found) if r["kind"] == kind)
    return body


def test_page_is_well_formed_and_needs_nothing_from_elsewhere(docked_page: str) -> None:
    page = Page(docked_page)
    assert len(page.ids) == len(set(page.ids))
    assert page.references
    for reference in page.references:
        assert reference.startswith("#"), reference
        assert reference[1:] in page.ids
    assert not page.tags & {"script", "link", "img", "iframe", "object", "embed", "form"}
    assert "://" not in docked_page
    assert "@import" not in docked_page
    assert not re.search(r"\son\w+=", docked_page)


def test_page_tells_how_late_the_cycles_came(tmp_path: Path, no_pictures: None) -> None:
    run, late = docked_run(), Lateness()
    for _ in range(1234):
        late.add(2e-4)
    run.add("lateness", **late.as_record(), speed_limit_mm_s=99.0)
    late.add(0.0321)
    run.add("run_lateness", **late.as_record())
    text = Page(html(records(run, tmp_path))).text
    assert "measured at the start 1 234 0.200 0.200 0.200 0.200 0 1 234 0 0 0" in text.replace("\u202f", " ")
    usual = f"{1e3 * late.quantile_s(0.5):.3f}"
    assert f"all cycles of the run 1 235 {usual} {usual} {usual} 32.100 0 1 234 0 1 0" in text.replace("\u202f", " ")
    assert "Punctuality" not in Page(html(records_of(docked_run(), tmp_path / "punctual.jsonl"))).text


def test_page_carries_the_numbers_of_the_journal(docked: list[dict[str, Any]], docked_page: str) -> None:
    text = Page(docked_page).text
    outcome, final = last(docked, "outcome"), last(docked, "features")
    assert f"{outcome['max_feature_error_mm']:.3f}" in text
    assert f"{outcome['max_feature_error_mm'] + 2 * outcome['feature_sigma_mm']:.3f}" in text
    assert f"{outcome['max_consistency_residual_mm']:.3f}" in text
    assert "0.071" in text  # the plant's truth
    for norm, vector in zip(final["norm_mm"], final["error_mm"], strict=True):
        assert f"{norm:.3f}" in text
        assert all(f"{v:+.3f}".replace("-", "−") in text for v in vector)
    for plan in (r["body"] for r in docked if r["kind"] == "plan"):
        assert plan["plan_hash"] in text
        assert f"{plan['duration_s']:.1f}" in text
        assert all(f"{mm:+.3f}".replace("-", "−") in text for mm in plan["displacement_mm"].values())
    for name, residual in last(docked, "fit")["residuals_mm"].items():
        assert name in text
        assert f"{np.linalg.norm(residual):.3f}" in text
    start = last(docked, "run_started")
    assert {start["cell_sha256"], start["job_sha256"], docked[-1]["sha"]} <= set(re.findall(r"[0-9a-f]{64}", text))
    assert "not-congruent 1.874 mm against 8 others" in text
    assert "FUS-15-2200" in text
    assert "SN-0042" in text
    assert "ISO 14253-1" in text
    assert "Docked" in text


@pytest.mark.usefixtures("no_pictures")
def test_stage_table_shows_the_first_before_and_the_last_after(tmp_path: Path) -> None:
    run = docked_run()
    found = records(run, tmp_path)
    judged = [r["body"] for r in found if r["kind"] == "features" and r["body"]["stage"] == "dock"]
    assert [body["when"] for body in judged] == ["before", "after", "final"]
    row = re.search(r'<tr class="first"><td class="t">dock</td>(.*?)</tr>', html(found))
    assert row is not None
    cells = re.findall(r"<td>([^<]*)</td>", row[1])
    assert cells[0] == f"{judged[0]['norm_mm'][0]:.3f}"
    assert cells[3] == f"{judged[2]['norm_mm'][0]:.3f}"
    assert cells[5] == f"{judged[2]['norm_mm'][0] + 2 * judged[2]['sigma_mm'][0]:.3f}"


@pytest.mark.usefixtures("no_pictures")
def test_a_run_refused_on_risk_shows_no_feature_as_inside(tmp_path: Path) -> None:
    run = docked_run()
    for _, kind, body in run.events:
        if kind == "features":
            body["risk"] = 0.031
    text = html(records(run, tmp_path))
    shown = Page(text).text
    assert "3.10 %" in shown
    assert "over its limit" in shown
    assert "✓ proved inside" not in shown
    assert "risk too high" in shown


@pytest.mark.usefixtures("no_pictures")
def test_points_kept_out_of_the_fits_are_shown(tmp_path: Path) -> None:
    text = Page(html(records(docked_run(), tmp_path))).text
    for told in ("F2.C 0.021 0.081 ✓ agrees", "F2.M 0.046 0.081 ✓ agrees", "K3 2.716 0.118"):
        assert told in text
    assert "given area_clear, reflectors_off; not given none" in text


@pytest.mark.usefixtures("no_pictures")
def test_risk_stands_beside_every_stage(tmp_path: Path) -> None:
    text = html(records(docked_run(), tmp_path))
    rows = re.findall(r'<tr class="first">(.*?)</tr>', text)
    risks = [re.findall(r'<td rowspan="4">([^<]*)</td>', row) for row in rows]
    assert [r for r in risks if r][-1] == ["98.00", "0.42"]
    assert "✓ yes" in rows[len(risks) - 1]
    assert "0.42 %" in Page(text).text


def test_every_picture_is_there(docked_page: str) -> None:
    assert docked_page.count("<svg") == docked_page.count("<figure>") == 8
    for word in ("Δ position", "following error", "consistency residual", "internal force", "limit 0.1 mm"):
        assert word in docked_page


@pytest.mark.usefixtures("no_pictures")
def test_simulated_and_real_are_said_plainly(docked_page: str, tmp_path: Path) -> None:
    simulated = Page(docked_page).text
    real = Page(html(records(docked_run(simulated=False), tmp_path))).text
    assert "no component was moved" in simulated
    assert "True largest error" in simulated
    assert "no component was moved" not in real
    assert "Real run" in real
    assert "True largest error" not in real
    assert "Random seed" not in real


@pytest.mark.parametrize(
    "part", ["<b>bold</b>", "</style><script>alert(1)</script>", '"; } body { display: none', "a & b < c"]
)
@pytest.mark.usefixtures("no_pictures")
def test_text_from_files_is_only_text(part: str, tmp_path: Path) -> None:
    text = html(records(docked_run(part_number=part), tmp_path))
    page = Page(text)
    assert page.text.count(part) == 2  # title and part; the page foot is spelt out in the style
    assert "script" not in page.tags
    assert part not in text
    style = text[text.index("<style>") : text.index("</style>")]
    assert style.count('"') % 2 == 0
    assert "display: none" not in style


def test_names_in_pictures_are_only_text_too(tmp_path: Path) -> None:
    found = records(docked_run(), tmp_path)
    for record in found:
        if record["kind"] == "features":
            record["body"]["names"] = ["<i>F1</i>", "F2 & $x_2$", "F3 $", "特征四"]
            record["body"]["stage"] = "<i>stage</i> $"
    page = Page(html(found))
    assert "i" not in page.tags
    assert page.text.count("<i>F1</i>") >= 3  # two tables and a picture
    assert page.text.count("F2 & $x_2$") >= 3


def test_faulted_run_shows_the_alarm_and_what_to_do(tmp_path: Path) -> None:
    text = Page(html(records(faulted_run(), tmp_path))).text
    assert "Fault The run ended with a fault" in text
    assert "2101 C.Z: following error 0.62 mm is over the limit 0.5 mm." in text
    assert "Look for a jam" in text
    assert "Found at 0:01:15 · first changed command after 11 ms · at rest after 214 ms" in text
    assert "The run ended before acceptance" in text
    assert "Result stopped" in text
    assert "Docked" not in text


@pytest.mark.usefixtures("no_pictures")
def test_every_beginning_of_a_run_makes_a_report(tmp_path: Path) -> None:
    found = records(faulted_run(), tmp_path)
    for cut in (*range(0, len(found), 4), len(found)):
        page = Page(html(found[:cut]))
        assert ("Incomplete" in page.text) == (cut < len(found))


@pytest.mark.parametrize("kind", ["run_started", "fit", "features"])
def test_pictures_are_drawn_of_what_there_is(kind: str, tmp_path: Path) -> None:
    found = records(faulted_run(), tmp_path)
    first = next(i for i, record in enumerate(found) if record["kind"] == kind)
    Page(html(found[: first + 1]))


@pytest.mark.parametrize("kind", ["run_started", "fit", "features", "moved"])
def test_a_body_without_its_keys_is_shown_as_unknown(kind: str, tmp_path: Path) -> None:
    Page(html(_emptied(kind, tmp_path)))


@pytest.mark.parametrize("kind", ["station", "plan", "drift", "alarm", "confirm", "outcome", "measurement"])
@pytest.mark.usefixtures("no_pictures")
def test_a_row_without_its_values_is_shown_as_unknown(kind: str, tmp_path: Path) -> None:
    Page(html(_emptied(kind, tmp_path)))


def _emptied(kind: str, tmp_path: Path) -> list[dict[str, Any]]:
    return [{**r, "body": {}} if r["kind"] == kind else r for r in records(faulted_run(), tmp_path)]


@pytest.mark.usefixtures("no_pictures")
def test_unknown_numbers_never_look_like_a_pass(tmp_path: Path) -> None:
    run = docked_run()
    for _, kind, body in run.events:
        if kind == "features":
            body["sigma_mm"] = [None] * len(body["names"])
    text = Page(html(records(run, tmp_path))).text
    assert "proved inside" not in text.replace("Every docking feature is proved inside its tolerance", "")
    assert "not proved" in text


def test_chinese_report(docked: list[dict[str, Any]]) -> None:
    text = html(docked, "zh")
    assert '<html lang="zh">' in text
    page = Page(text).text
    for word in ("对接报告", "对接完成", "公差", "跟随误差", "一致性残差", "急停为硬接线", "阶段速度"):
        assert word in page
    assert "stage speed" not in page
    assert "done" not in page
    with pytest.raises(BadArgument, match="fr"):
        html(docked, "fr")


@pytest.mark.usefixtures("no_pictures")
def test_remedies_are_in_the_language_of_the_report(tmp_path: Path) -> None:
    text = Page(html(records(faulted_run(), tmp_path), "zh")).text
    assert catalogue("zh")["2101"]["remedy"] in text


def test_the_catalogues_have_the_same_words_and_every_word_is_used() -> None:
    def words(language: str) -> dict[str, str]:
        return tomllib.loads(resources.files("docking.locale").joinpath(f"report.{language}.toml").read_text("utf-8"))

    english, chinese = words("en"), words("zh")
    assert english.keys() == chinese.keys()
    for key in english:
        assert sorted(re.findall(r"{(\w+)}", english[key])) == sorted(re.findall(r"{(\w+)}", chinese[key])), key
    room = Path(__file__).parents[3] / "docking"
    source = "".join(p.read_text("utf-8") for p in (*room.glob("report/*.py"), room / "templates" / "report.html.j2"))
    composed = ("outcome_", "said_", "event_", "fit_", "goal_", "late_", "before", "after", "final")
    assert [key for key in english if not re.search(rf"\b{key}\b", source) and not key.startswith(composed)] == []


@pytest.mark.usefixtures("no_pictures")
def test_only_the_last_run_of_a_journal_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    records_of(faulted_run(), path)
    found = records_of(docked_run(part_number="SECOND"), path)
    assert summary(found)["outcome"] == "docked"
    text = Page(html(found)).text
    assert "2101" not in text
    assert "SECOND" in text
    assert "FUS-15-2200" not in text


def test_same_records_same_page(docked: list[dict[str, Any]], docked_page: str) -> None:
    assert html(docked) == docked_page


@pytest.mark.usefixtures("no_pictures")
def test_the_file_is_written_whole_or_not_at_all(docked: list[dict[str, Any]], tmp_path: Path) -> None:
    target = tmp_path / "out.html"
    write_report(docked, target)
    assert target.read_text("utf-8").rstrip().endswith("</html>")
    assert [p.name for p in tmp_path.iterdir()] == ["out.html"]
    with pytest.raises(FileUnreadable):
        write_report(docked, tmp_path / "none" / "out.html")


def test_summary_is_the_outcome_with_every_key(docked: list[dict[str, Any]]) -> None:
    known = summary(docked)
    assert list(known) == [
        "outcome",
        "tolerance_mm",
        "max_feature_error_mm",
        "feature_sigma_mm",
        "true_max_feature_error_mm",
        "moves",
        "rejected_points",
        "max_consistency_residual_mm",
        "max_internal_force_n",
        "virtual_time_s",
        "wall_time_s",
        "alarms",
        "report",
    ]
    assert known == last(docked, "outcome")


def test_summary_without_an_outcome_is_a_fault_with_nulls(docked: list[dict[str, Any]]) -> None:
    known = summary(docked[:-1])
    assert known["outcome"] == "fault"
    assert known["tolerance_mm"] == 0.2
    assert known["moves"] == 5
    assert known["max_feature_error_mm"] is None
    assert summary([])["outcome"] == "fault"
