"""Field types that the cell and job models share: strict, finite, units in the names."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

LARGEST = 1e9
"""No quantity of a cell is larger; the bound keeps the arithmetic of the checks finite."""

Finite = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, le=LARGEST, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, le=LARGEST, allow_inf_nan=False)]
Fraction = Annotated[float, Field(gt=0.0, le=1.0, allow_inf_nan=False)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]{0,31}$")]
Vector3 = tuple[Finite, Finite, Finite]
PoseVector = tuple[Finite, Finite, Finite, Finite, Finite, Finite]
"""[x_mm, y_mm, z_mm, alpha_deg, beta_deg, gamma_deg], R = Rz(gamma) Ry(beta) Rx(alpha)."""


class Model(BaseModel):
    """Base of all file models: frozen, unknown keys refused, NaN and infinity refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)
