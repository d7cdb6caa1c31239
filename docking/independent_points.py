"""What a fit is checked against, and never made from: check points, and the docking features where they can be seen.

They find what the fit's own residuals cannot: a deformed part, a wrong coordinate of a feature in the job file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from docking.errors import CheckPointDisagrees, FeatureDisagrees, TargetLost, TooFewPoints
from docking.ports import Journal
from docking.pose import check_points_agree
from docking.survey import Survey
from docking.types import Fit

FEWEST_CHECK_POINTS = 2
"""Check points that must remain and agree when one is set aside."""


@dataclass
class IndependentPoints:
    """Judges the points kept out of the fits. `gross_mm`: farther off than this a reflector does not sit.

    Each judgement answers False while more passes may help: measuring moves nothing, and one bad reading must not end
    a docking. `last` says that the passes are spent, so that a disagreement is raised.
    """

    survey: Survey
    journal: Journal
    gross_mm: float
    told: Callable[[CheckPointDisagrees], None]

    def check_points(self, fit: Fit, *, last: bool) -> bool:
        """Whether the check points lie where the component's fit puts them.

        A single one that is grossly off while two or more agree is named and set aside.
        Raises CheckPointDisagrees, or TooFewPoints where too few are seen, when the passes are spent.
        """
        nominal, seen = self.survey.check_points()
        expected = len(self.survey.nominals.checks)
        if expected == 0:
            return True
        needed = min(FEWEST_CHECK_POINTS, expected)
        if len(seen) < needed:
            if last:
                raise TooFewPoints("check points", "The fit cannot be checked.", value=len(seen), limit=needed)
            return False
        try:
            off_mm, limit_mm = check_points_agree(fit, nominal, seen)
        except CheckPointDisagrees as error:
            gross = isinstance(error.value, float) and error.value > self.gross_mm
            if gross and len(seen) > FEWEST_CHECK_POINTS:
                self._set_aside(error)
                return self.check_points(fit, last=last)
            if last:
                raise
            return False
        body = {"error_mm": np.linalg.norm(off_mm, axis=1).tolist(), "limit_mm": limit_mm.tolist()}
        self.journal.write("check_points", {"names": list(seen.names), **body})
        return True

    def _set_aside(self, error: CheckPointDisagrees) -> None:
        self.survey.leave_out(error.where)
        self.journal.write("set_aside", {"name": error.where, "error_mm": error.value, "limit_mm": error.limit})
        self.told(error)

    def features(self, component: Fit, mate: Fit, *, last: bool) -> bool:
        """Whether the measured docking features of both sides are where the job file puts them; asked until they are.

        Raises FeatureDisagrees, or TargetLost for one that is never seen, when the passes are spent.
        """
        if self.survey.features_confirmed:
            return True
        expected = self.survey.nominals.features, self.survey.nominals.mate_features
        for fit, wanted, (nominal, seen) in zip((component, mate), expected, self.survey.seen_features(), strict=True):
            unseen = [name for name in wanted.names if name not in seen.names]
            if unseen:
                if last:
                    raise TargetLost(unseen[0], "the job says that this feature is measured at the first station")
                return False
            if not len(seen):
                continue
            try:
                off_mm, limit_mm = check_points_agree(fit, nominal, seen)
            except CheckPointDisagrees as error:
                if not last:
                    return False
                raise FeatureDisagrees(error.where, error.cause, value=error.value, limit=error.limit) from error
            body = {"error_mm": np.linalg.norm(off_mm, axis=1).tolist(), "limit_mm": limit_mm.tolist()}
            self.journal.write("features_measured", {"names": list(seen.names), **body})
        self.survey.features_confirmed = True
        return True
