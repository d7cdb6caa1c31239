"""Which epochs of a tracker's session are bad, by nothing but the distances within a rigid body.

A body's distances are compared with their medians over the session; an epoch that leaves one of them by more than
0.1 mm, or has a reading of (0, 0, 0), is bad. Nothing of the product is used: this is what its screening is judged by.

    python tests/data_truth/faro_bad_epochs.py ../shared/data/faro_epochs
"""

import sys
from pathlib import Path

import numpy as np

BODIES = {"floor": ("base_1", "base_2", "base_3"), "tool": ("SMR_1", "SMR_2", "SMR_3")}
LIMIT_MM = 0.1


def bad_epochs(folder: Path) -> dict[str, dict[str, list[int]]]:
    """For each body the epochs with a lost beam, and those whose distances are off without one."""
    found = {}
    for body, names in BODIES.items():
        xyz = np.stack([np.loadtxt(folder / f"measured_{name}.txt") for name in names])
        lost = np.any(np.all(xyz == 0.0, axis=2), axis=0)
        sides = np.array([np.sqrt(((xyz[a] - xyz[b]) ** 2).sum(axis=1)) for a, b in ((0, 1), (1, 2), (2, 0))])
        off = np.abs(sides - np.median(sides, axis=1, keepdims=True)).max(axis=0)
        found[body] = {
            "lost": np.flatnonzero(lost).tolist(),
            "wrong": np.flatnonzero((off > LIMIT_MM) & ~lost).tolist(),
        }
    return found


if __name__ == "__main__":
    for body, rows in bad_epochs(Path(sys.argv[1])).items():
        print(f"{body}: lost beam {rows['lost']}, wrong distances {rows['wrong']}")
