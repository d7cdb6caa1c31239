"""What a person is told while a docking runs: texts by key from `docking/locale/operator.*.toml`."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib import resources
from typing import Any

from docking.errors import BadArgument, DockingError

LANGUAGES = ("en", "zh")


@cache
def texts(language: str) -> dict[str, Any]:
    """The catalogue of one language: key -> text, and `terms`. Raises BadArgument for a language without one."""
    if language not in LANGUAGES:
        raise BadArgument("language", "no such catalogue", value=language, limit=", ".join(LANGUAGES))
    text = resources.files("docking.locale").joinpath(f"operator.{language}.toml").read_text("utf-8")
    return tomllib.loads(text)


def tell(language: str, key: str, **facts: Any) -> str:
    """The text `key` with its facts; an error among them speaks the same language and brings its `remedy`.

    `kind` and `limited_by`, which planning names in English, are translated by the catalogue's `terms`.
    """
    catalogue = texts(language)
    spoken = dict(facts)
    for name, fact in facts.items():
        if isinstance(fact, DockingError):
            spoken |= {name: fact.text(language), "remedy": fact.remedy(language)}
    for name in ("kind", "limited_by"):
        if name in spoken:
            spoken[name] = term(language, str(spoken[name]))
    text: str = catalogue[key]
    return text.format(**spoken)


def term(language: str, text: str) -> str:
    """A word of planning and motion in the language: a whole term, or one that begins with the name of an axis.

    What is no term stays as it is.
    """
    terms: dict[str, str] = texts(language)["terms"]
    if text in terms:
        return terms[text]
    axis, _, what = text.partition(" ")
    return f"{axis} {terms[what]}" if what in terms else text
