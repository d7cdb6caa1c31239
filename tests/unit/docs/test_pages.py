"""The documents: links lead somewhere, the recipe for checking a journal works, the commands they name exist."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

import pytest

from docking.cli import cli
from docking.journal import JournalFile

ROOT = Path(__file__).parents[3]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_to_files_of_this_repository(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        if not target.startswith(("https://", "#")):
            assert (page.parent / target.split("#")[0]).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_paths_in_code_marks_exist(page: Path) -> None:
    rooms = r"`((?:docking|drivers|sim|tests|docs)/[\w./-]*[\w/])`"
    for named in re.findall(rooms, page.read_text("utf-8")):
        assert "NAME" in named or (ROOT / named).exists(), named


SOURCES = sorted(path for room in ("docking", "drivers", "sim", "tests") for path in (ROOT / room).rglob("*.py"))
CITED = re.compile(r"docs/([\w-]+)\.md((?:(?:,| to| and|\s)\s*\(\d+\))*)")


def equations(page: str) -> list[int]:
    """Numbers of a page's equations: at the beginning of a line of mathematics, a cell or a code mark."""
    text = (ROOT / "docs" / page).read_text("utf-8")
    return [int(n) for n in re.findall(r"(?:^    |\| |`)\((\d+)\) (?!\|$)", text, re.MULTILINE)]


@pytest.mark.parametrize("page", ["mechanics.md", "fit.md"])
def test_equations_are_numbered_once_and_in_order(page: str) -> None:
    numbers = equations(page)
    assert len(numbers) > 10
    assert numbers == list(range(1, len(numbers) + 1))


def test_pages_and_equations_that_the_code_cites_exist() -> None:
    cited = 0
    for path in SOURCES:
        for page, listed in CITED.findall(path.read_text("utf-8")):
            assert (ROOT / "docs" / f"{page}.md").exists(), (path, page)
            numbers = {int(n) for n in re.findall(r"\d+", listed)}
            assert not numbers or numbers <= set(equations(f"{page}.md")), (path, page, numbers)
            cited += len(numbers)
    assert cited > 50


def test_the_recipe_for_checking_a_journal_accepts_a_journal_and_refuses_a_changed_one(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "journal.md").read_text("utf-8")
    found = re.search(r"^    import hashlib.*?(?=^\S)", page, re.DOTALL | re.MULTILINE)
    assert found is not None
    path = tmp_path / "run.journal.jsonl"
    recipe = textwrap.dedent(found[0]).replace('open("run.journal.jsonl", "rb")', "lines")
    assert "lines" in recipe
    journal = JournalFile(path, clock=lambda: 1.5)
    journal.write("state", {"to": "机身", "e_mm": 1e-05})
    journal.write("intent", {"target_mm": {"A.X": 12.5}})
    journal.close()
    lines = path.read_bytes().splitlines(keepends=True)
    exec(compile(recipe, "docs/journal.md", "exec"), {"lines": lines})
    with pytest.raises(AssertionError):
        exec(compile(recipe, "docs/journal.md", "exec"), {"lines": [lines[0].replace(b"1e-05", b"2e-05"), lines[1]]})


def test_every_command_of_the_readme_exists() -> None:
    readme = (ROOT / "README.md").read_text("utf-8")
    named = set(re.findall(r"`docking ([a-z-]+)", readme))
    assert set(cli.commands) <= named
    for line in re.findall(r"^\| `docking ([^`]*)`", readme, re.MULTILINE):
        command = cli.commands.get(line.split()[0])
        assert command is not None, line
        options = {name for part in command.params for name in part.opts}
        options |= {
            name for sub in getattr(command, "commands", {}).values() for part in sub.params for name in part.opts
        }
        assert set(re.findall(r"--[a-z-]+", line)) <= options, line
