"""What the operator is told: both languages say the same things with the same facts, and everything said exists."""

from __future__ import annotations

import re
import string
from pathlib import Path

import pytest

from docking.errors import AxisStuck, BadArgument, DriveFault
from docking.words import LANGUAGES, tell, texts

ROOT = Path(__file__).parents[3]
SAID = re.compile(
    r'(?:notify|(?<!_)tell|_ask)\(\s*(?:language\(\), |self\._language, |request\.language, |[_A-Za-z| ]+, )?"(\w+)"'
)
OUTCOMES = {"docked", "relieved", "out_of_tolerance", "stopped", "fault", "refused"}


def fields(text: str) -> set[str]:
    return {name for _, name, _, _ in string.Formatter().parse(text) if name}


def test_both_catalogues_have_the_same_texts_and_facts() -> None:
    english, chinese = texts("en"), texts("zh")
    assert list(english) == list(chinese)
    assert list(english["terms"]) == list(chinese["terms"])
    for key in set(english) - {"terms"}:
        assert fields(english[key]) == fields(chinese[key]), key


def test_every_text_is_said_somewhere_and_everything_said_is_a_text() -> None:
    source = "".join(path.read_text("utf-8") for path in (ROOT / "docking").rglob("*.py"))
    said = set(SAID.findall(source)) | {"paused", "resumed", "stopping"} | OUTCOMES
    assert said == set(texts("en")) - {"terms"}


@pytest.mark.parametrize("language", LANGUAGES)
def test_every_text_takes_its_facts(language: str) -> None:
    for key, text in texts(language).items():
        if key != "terms":
            numbers = dict.fromkeys(fields(text), 1.25)
            assert "{" not in tell(language, key, **numbers)


def test_what_limits_a_move_is_translated_with_its_axis() -> None:
    facts = {"kind": "align", "stage": "align", "duration_s": 2.0}
    assert tell("zh", "moving", limited_by="B.Z acceleration", **facts).endswith("受限于B.Z 加速度")
    assert "对准,站位 'align'" in tell("zh", "moving", limited_by="stage speed", **facts)
    assert tell("en", "moving", limited_by="B.Z acceleration", **facts).endswith("limited by B.Z acceleration")
    assert tell("en", "moving", limited_by="something else", **facts).endswith("something else")


def test_an_error_speaks_the_language_and_brings_its_remedy() -> None:
    error = DriveFault("A.X", "over-current", value=0x2310)
    assert tell("zh", "alarm", code=2106, error=error) == f"2106:{error.text('zh')}\n    -> {error.remedy('zh')}"
    assert tell("en", "alarm", code=2106, error=error) == f"2106: {error.text('en')}\n    -> {error.remedy('en')}"


def test_an_error_without_a_cause_ends_with_its_last_word() -> None:
    error = AxisStuck("A.X", "", value=0.021, limit=0.02)
    assert error.text("en").endswith("0.02 mm.")
    assert error.text("zh") == error.text("zh").strip()


def test_an_unknown_language_is_named() -> None:
    with pytest.raises(BadArgument, match="fr"):
        tell("fr", "docked")
