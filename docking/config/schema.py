"""JSON schemas of the CELL and JOB files, for editors. `python -m docking.config.schema [DIR]` writes them."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from docking.config.base import Model
from docking.config.cell import CellFile
from docking.config.job import JobFile

SCHEMA_FILES: dict[str, type[Model]] = {"cell.schema.json": CellFile, "job.schema.json": JobFile}
DEFAULT_DIRECTORY = Path("docs/schema")


def schema_text(model: type[Model]) -> str:
    """The JSON schema (2020-12) of a file model, as committed."""
    schema: dict[str, Any] = {"$schema": "https://json-schema.org/draft/2020-12/schema", **model.model_json_schema()}
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def write_schemas(directory: Path) -> None:
    """Write `cell.schema.json` and `job.schema.json` into `directory`."""
    directory.mkdir(parents=True, exist_ok=True)
    for name, model in SCHEMA_FILES.items():
        (directory / name).write_text(schema_text(model), "utf-8")


if __name__ == "__main__":
    write_schemas(Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT_DIRECTORY)
