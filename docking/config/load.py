"""Reads CELL and JOB files. A file loads or raises ConfigInvalid (all problems) or FileUnreadable."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from docking.config.base import Model
from docking.config.cell import CellFile
from docking.config.cross_check import check_cell, check_job
from docking.config.document import cell_document_findings, job_document_findings
from docking.config.findings import Finding, errors_of
from docking.config.job import JobFile
from docking.config.problems import problems_of, unknown_keys, without
from docking.errors import ConfigInvalid, FileUnreadable

LARGEST_FILE_BYTES = 4_000_000
FileModel = TypeVar("FileModel", bound=Model)
Document = dict[str, Any]


def load_cell(path: Path | str) -> CellFile:
    """The checked cell of a CELL file. Raises FileUnreadable, ConfigInvalid."""
    return _load(Path(path), CellFile, cell_document_findings, check_cell)


def load_job(path: Path | str, cell: CellFile, *, proof: bool = True) -> JobFile:
    """The job of a JOB file, checked against its cell; without `proof` its tolerances need not be provable.

    Raises FileUnreadable, ConfigInvalid.
    """
    return _load(Path(path), JobFile, job_document_findings, lambda job: check_job(cell, job, proof=proof))


def default_job_path(cell_path: Path | str) -> Path:
    """`NAME.job.toml` beside the cell file `NAME.toml`."""
    cell_path = Path(cell_path)
    stem = cell_path.name.removesuffix(".toml")
    return cell_path.with_name(f"{stem}.job.toml")


def file_sha256(path: Path | str) -> str:
    """Hexadecimal SHA-256 of the file's bytes. Raises FileUnreadable."""
    return hashlib.sha256(_bytes(Path(path))).hexdigest()


def _load(
    path: Path,
    model: type[FileModel],
    of_document: Callable[[Document], list[Finding]],
    of_model: Callable[[FileModel], list[Finding]],
) -> FileModel:
    doc = _document(path)
    _refuse_other_kind(path, model, doc)
    try:
        parsed = model.model_validate(doc)
    except ValidationError as invalid:
        problems = list(problems_of(invalid, model, doc))
        findings = _findings_despite(invalid, model, doc, of_model)
        problems += _texts(of_document(doc) if findings is None else findings)
        raise ConfigInvalid(str(path), tuple(problems)) from None
    problems = _texts(of_model(parsed))
    if problems:
        raise ConfigInvalid(str(path), tuple(problems))
    return parsed


def _findings_despite(
    invalid: ValidationError, model: type[FileModel], doc: Document, of_model: Callable[[FileModel], list[Finding]]
) -> list[Finding] | None:
    """The findings of the file without its unknown keys; None when more than those is wrong."""
    try:
        return of_model(model.model_validate(without(doc, unknown_keys(invalid, doc))))
    except ValidationError:
        return None


def _texts(findings: Sequence[Finding]) -> list[str]:
    return [str(f) for f in errors_of(findings)]


def _bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST_FILE_BYTES + 1)
    except (OSError, ValueError) as failure:
        reason = getattr(failure, "strerror", None) or str(failure)
        raise FileUnreadable(str(path), reason.lower()) from None
    if len(data) > LARGEST_FILE_BYTES:
        raise FileUnreadable(str(path), f"larger than {LARGEST_FILE_BYTES} bytes: not a cell or job file")
    return data


def _document(path: Path) -> Document:
    data = _bytes(path)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        line = data.count(b"\n", 0, failure.start) + 1
        raise FileUnreadable(str(path), f"not UTF-8 text (line {line})") from None
    try:
        doc: Document = _with_tuples(tomllib.loads(text))
    except tomllib.TOMLDecodeError as failure:
        reason = str(failure).replace("at end of document", f"at the end, line {text.count(chr(10)) + 1}")
        raise FileUnreadable(str(path), f"TOML syntax: {reason}") from None
    except (ValueError, RecursionError) as failure:
        raise FileUnreadable(str(path), f"TOML cannot be read: {str(failure)[:120]}") from None
    return doc


def _with_tuples(value: Any) -> Any:
    """TOML lists as tuples, as the strict models ask."""
    if isinstance(value, dict):
        return {k: _with_tuples(v) for k, v in value.items()}
    if isinstance(value, list):
        return tuple(_with_tuples(v) for v in value)
    return value


def _refuse_other_kind(path: Path, model: type[Model], doc: Document) -> None:
    """Raise ConfigInvalid when the file is plainly of another kind than the one asked for."""
    kinds: dict[str, type[Model]] = {"CELL": CellFile, "JOB": JobFile}
    asked = next(word for word, kind in kinds.items() if kind is model)
    if any(key in doc for key in _own_keys(model, kinds)):
        return
    for word, kind in kinds.items():
        found = sorted(key for key in _own_keys(kind, kinds) if key in doc)
        if found:
            raise _wrong_kind(path, f"this is a {word} file (it has {', '.join(found)}); a {asked} file is wanted here")
    wanted = ", ".join(sorted(_own_keys(model, kinds)))
    raise _wrong_kind(path, f"this is not a {asked} file: it has none of {wanted}")


def _wrong_kind(path: Path, text: str) -> ConfigInvalid:
    return ConfigInvalid(str(path), (f"{text}. The arguments are CELL, then JOB.",))


def _own_keys(model: type[Model], kinds: dict[str, type[Model]]) -> set[str]:
    """Required keys of this kind of file that no other kind has."""
    others = {key for kind in kinds.values() if kind is not model for key in kind.model_fields}
    return {key for key, field in model.model_fields.items() if field.is_required() and key not in others}
