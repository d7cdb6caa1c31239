"""The report of a run, made from nothing but the records of its journal."""

from docking.report.page import write_report
from docking.report.run import summary

__all__ = ["summary", "write_report"]
