"""Inertial sensors by grade: what a data sheet of each kind promises."""

from __future__ import annotations

from docking.tracking.types import InertialModel

GRADES = {
    "tactical": InertialModel(3e-4, 1.5e-5, 0.005, 5e-5, 2e-5, 5e-7),
    "mems": InertialModel(1e-3, 1e-4, 0.03, 3e-4, 5e-5, 5e-6),
    "adis16448": InertialModel(2e-3, 1.7e-4, 0.05, 1e-3, 5e-4, 2e-5),
    "consumer": InertialModel(3e-3, 3e-4, 0.1, 5e-3, 1e-3, 5e-5, rate_slip=1e-3),
}
"""tactical: fibre gyroscope or the best MEMS; mems: a good industrial MEMS unit, whose
walks over 100 s make the in-run stability of 0.05 mg and 10 deg/h of such data sheets; adis16448: as in flying cameras;
consumer: as in telephones and motion suits."""
