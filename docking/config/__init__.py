"""Cell and job files: strict models, loading with all errors at once, cross checks, JSON schema."""

from docking.config.cell import CellFile
from docking.config.job import JobFile

__all__ = ["CellFile", "JobFile"]
