"""Reads the TOML files of the simulation against their models, all problems at once."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from docking.config.base import Model
from docking.errors import ConfigInvalid, FileUnreadable

M = TypeVar("M", bound=Model)


def read_toml(path: Path, model: type[M]) -> M:
    """The file `path` as a `model`. Raises FileUnreadable, or ConfigInvalid with every problem and its key."""
    try:
        data = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise FileUnreadable(str(path), (error.strerror or str(error)).lower()) from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FileUnreadable(str(path), str(error)) from error
    try:
        # JSON mode is strict about types yet takes arrays as tuples, which TOML cannot spell otherwise.
        return model.model_validate_json(json.dumps(data))
    except ValidationError as error:
        problems = [f"{_key(item['loc'])}: {item['msg']}" for item in error.errors(include_url=False)]
        raise ConfigInvalid(str(path), tuple(dict.fromkeys(problems))) from error
    except (TypeError, ValueError) as error:
        # A date has no place in JSON.
        raise ConfigInvalid(str(path), (str(error),)) from error


def _key(loc: tuple[int | str, ...]) -> str:
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc).lstrip(".")
