"""Config -> running cell, real or simulated. The only room that imports drivers and simulated devices.

What is named here is loaded when it is asked for: the motion process needs none but `run_motion`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from docking.assemble.motion_process import run_motion
    from docking.assemble.relieving import ReliefRequest, relieve
    from docking.assemble.requests import RunRequest, WireChoice
    from docking.assemble.runs import dry_run, run_on_wires
    from docking.assemble.serving import serve

__all__ = ["ReliefRequest", "RunRequest", "WireChoice", "dry_run", "relieve", "run_motion", "run_on_wires", "serve"]


def __getattr__(name: str) -> Any:
    if name == "run_motion":
        from docking.assemble import motion_process

        return motion_process.run_motion
    if name in ("ReliefRequest", "relieve"):
        from docking.assemble import relieving

        return getattr(relieving, name)
    if name == "serve":
        from docking.assemble import serving

        return serving.serve
    if name in __all__:
        from docking.assemble import runs

        return getattr(runs, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
