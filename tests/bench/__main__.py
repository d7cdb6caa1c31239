"""`python -m tests.bench [P11 ...] [--tiny]`: measure product and peers back to back and print the table.

The exit code is 0 whether the targets are met or not: a busy machine is no defect.
"""

from __future__ import annotations

import argparse

from tests.bench.metric import TINY, Metric, Sizes
from tests.bench.registry import GROUPS
from tests.bench.table import machine, table


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description="Targets as ratios to named peers.")
    parser.add_argument("groups", nargs="*", metavar="P", help=f"which groups (default all): {', '.join(GROUPS)}")
    parser.add_argument("--tiny", action="store_true", help="tiny sizes: see that it runs, ratios mean nothing")
    given = parser.parse_args(arguments)
    unknown = [key for key in given.groups if key not in GROUPS]
    if unknown:
        parser.error(f"no such group: {', '.join(unknown)}; there are {', '.join(GROUPS)}")
    print(machine())
    sizes = TINY if given.tiny else Sizes()
    metrics: list[Metric] = []
    for key in given.groups or GROUPS:
        print(f"{key} ...", flush=True)
        metrics += GROUPS[key](sizes)
    print(table(metrics))


if __name__ == "__main__":
    main()
