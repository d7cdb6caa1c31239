"""Turns the validation errors of a file into texts that name key, value, bound and the nearest valid key."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

Loc = tuple[int | str, ...]

_BOUNDS = {
    "greater_than": "must be > {gt:g}",
    "greater_than_equal": "must be >= {ge:g}",
    "less_than": "must be < {lt:g}",
    "less_than_equal": "must be <= {le:g}",
    "finite_number": "must be a finite number",
    "literal_error": "must be {expected}",
    "string_pattern_mismatch": "must match {pattern}",
    "string_too_short": "must have at least {min_length} character(s)",
    "string_too_long": "must have at most {max_length} characters",
    "too_short": "must have at least {min_length} items",
    "too_long": "must have at most {max_length} items, has {actual_length}",
    "union_tag_invalid": "must be one of {expected_tags} (key {discriminator})",
    "union_tag_not_found": "needs the key {discriminator}",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "string_type": "must be a text in quotes",
    "bool_type": "must be true or false",
    "tuple_type": "must be a list",
    "model_type": "must be a table of keys",
    "model_attributes_type": "must be a table of keys",
    "dict_type": "must be a table of keys",
}


def key_path(loc: Iterable[int | str]) -> str:
    """`("positioners", 1, "axes", 0)` -> `positioners[1].axes[0]`."""
    text = ""
    for part in loc:
        text += f"[{part}]" if isinstance(part, int) else (f".{part}" if text else str(part))
    return text


def show(value: object) -> str:
    """A value as a reader of the file would recognise it, shortened."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else ("infinity" if value > 0 else "-infinity")
    if isinstance(value, int) and value.bit_length() > 200:
        return "a whole number beyond all bounds"
    if isinstance(value, tuple | list):
        text = "[" + ", ".join(show(v) for v in value[:6]) + (", ..." if len(value) > 6 else "") + "]"
    elif isinstance(value, Mapping):
        text = "{" + ", ".join(str(k) for k in list(value)[:6]) + "}"
    else:
        text = f"{value:g}" if isinstance(value, float) else repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def problems_of(error: ValidationError, model: type[BaseModel], doc: Mapping[str, Any]) -> tuple[str, ...]:
    """One text for each problem of the file `doc` that failed to validate as `model`, in file order."""
    items = error.errors(include_url=False)
    locs = [_in_file(tuple(item["loc"]), doc) for item in items]
    texts = []
    for item, loc in zip(items, locs, strict=True):
        nested = any(len(other) > len(loc) and other[: len(loc)] == loc for other in locs)
        if item["type"] == "too_short" and nested:  # the faulty items themselves are named instead
            continue
        texts.append(_text(item, loc, model, doc))
    return tuple(dict.fromkeys(texts))


def unknown_keys(error: ValidationError, doc: Mapping[str, Any]) -> tuple[Loc, ...]:
    """Where the file has keys that the model does not know."""
    found = [item["loc"] for item in error.errors(include_url=False) if item["type"] == "extra_forbidden"]
    return tuple(_in_file(tuple(loc), doc) for loc in found)


def without(doc: Any, locs: Sequence[Loc]) -> Any:
    """A copy of the document without the entries at `locs`."""
    here = {loc[0] for loc in locs if len(loc) == 1}

    def child(key: int | str, value: Any) -> Any:
        below = [loc[1:] for loc in locs if loc[0] == key and len(loc) > 1]
        return without(value, below) if below else value

    if isinstance(doc, Mapping):
        return {key: child(key, value) for key, value in doc.items() if key not in here}
    if isinstance(doc, tuple):
        return tuple(child(i, value) for i, value in enumerate(doc))
    return doc


def _in_file(loc: Loc, doc: Any) -> Loc:
    """The place in the file: without the union's tag that pydantic inserts after `bus`."""
    kept: list[int | str] = []
    for part in loc:
        tag = isinstance(part, str) and isinstance(doc, Mapping) and part not in doc and doc.get("kind") == part
        if tag:
            continue
        kept.append(part)
        doc = _child(doc, part)
    return tuple(kept)


def _child(doc: Any, part: int | str) -> Any:
    if isinstance(doc, Mapping):
        return doc.get(part)
    if isinstance(doc, list | tuple) and isinstance(part, int) and part < len(doc):
        return doc[part]
    return None


def _text(item: Any, loc: Loc, model: type[BaseModel], doc: Any) -> str:
    key = key_path(loc) or "file"
    if item["type"] == "missing":
        meaning = _meaning(model, loc, doc)
        return f"{key}: missing" + (f" ({meaning})" if meaning else " (required)")
    if item["type"] == "extra_forbidden":
        return f"{key} = {show(item['input'])}: unknown key; {_nearest(model, loc, doc)}"
    rule = _BOUNDS.get(item["type"])
    bound = rule.format(**item.get("ctx", {})) if rule else item["msg"]
    return f"{key} = {show(item['input'])}: {bound}"


def _meaning(model: type[BaseModel], loc: Loc, doc: Any) -> str:
    owner = _model_at(model, loc[:-1], doc)
    if owner is None or not isinstance(loc[-1], str) or loc[-1] not in owner.model_fields:
        return ""
    return owner.model_fields[loc[-1]].description or ""


def _nearest(model: type[BaseModel], loc: Loc, doc: Any) -> str:
    owner = _model_at(model, loc[:-1], doc)
    valid = list(owner.model_fields) if owner is not None else []
    close = difflib.get_close_matches(str(loc[-1]), valid, n=1, cutoff=0.5)
    return f"nearest valid key: {close[0]}" if close else "valid keys: " + ", ".join(valid)


def _model_at(model: type[BaseModel], loc: Loc, doc: Any) -> type[BaseModel] | None:
    """The model that owns the table at `loc`; a union is decided by the file's `kind`."""
    candidates = [model]
    for part in loc:
        doc = _child(doc, part)
        if isinstance(part, str):
            fields = [c.model_fields[part].annotation for c in candidates if part in c.model_fields]
            candidates = [m for annotation in fields for m in models_in(annotation)]
    kind = doc.get("kind") if isinstance(doc, Mapping) else None
    for candidate in candidates:
        field = candidate.model_fields.get("kind")
        if field is None or kind in get_args(field.annotation):
            return candidate
    return None


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """The models that a field annotation may hold: `tuple[Ball, ...]` -> [Ball], a union -> its members."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for arg in get_args(annotation) for m in models_in(arg)]
