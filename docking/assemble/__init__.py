"""Config -> running cell, real or simulated. The only room that imports drivers and simulated devices."""

from docking.assemble.runs import RunRequest, WireChoice, dry_run, run_on_wires, serve

__all__ = ["RunRequest", "WireChoice", "dry_run", "run_on_wires", "serve"]
