"""Docking-cell controller: what the cell knows and decides. Start with `docking.types`, then `docking.cell`."""
