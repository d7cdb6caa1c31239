"""The committed JSON schemas are those of the models, and every key says what it means."""

import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from docking.config import CellFile, JobFile
from docking.config.problems import models_in
from docking.config.schema import SCHEMA_FILES, schema_text, write_schemas

COMMITTED = Path(__file__).parents[3] / "docs" / "schema"


@pytest.mark.parametrize("name", SCHEMA_FILES)
def test_committed_schema_equals_the_model(name: str) -> None:
    """After a change of the models: python -m docking.config.schema"""
    assert (COMMITTED / name).read_text("utf-8") == schema_text(SCHEMA_FILES[name])


def test_schemas_are_written_where_asked(tmp_path: Path) -> None:
    write_schemas(tmp_path / "schema")
    assert sorted(p.name for p in (tmp_path / "schema").iterdir()) == sorted(SCHEMA_FILES)


def models(root: type[BaseModel]) -> set[type[BaseModel]]:
    found = {root}
    for field in root.model_fields.values():
        found |= {m for child in models_in(field.annotation) for m in models(child)}
    return found


@pytest.mark.parametrize("root", [CellFile, JobFile])
def test_every_key_is_described(root: type[BaseModel]) -> None:
    bare = [
        f"{m.__name__}.{key}" for m in models(root) for key, field in m.model_fields.items() if not field.description
    ]
    assert bare == []


@pytest.mark.parametrize("root", [CellFile, JobFile])
def test_every_key_stands_in_the_documentation(root: type[BaseModel]) -> None:
    text = (COMMITTED.parent / "configuration.md").read_text("utf-8")
    absent = [
        f"{m.__name__}.{key}"
        for m in models(root)
        for key in m.model_fields
        if not re.search(rf"[`\[]{key}[`\]]", text)
    ]
    assert absent == []
