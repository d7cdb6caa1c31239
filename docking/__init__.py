"""Docking-cell controller: what the cell knows and decides. Start with `docking.types`, then `docking.cell`."""

import os

# The arrays of a cell are small: threads of the linear algebra would only take a core from the tick or a second worker.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
