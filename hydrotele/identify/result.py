"""What an identification found."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from hydrotele.identify.estimators import Estimate
from hydrotele.identify.identifiability import Identifiability


@dataclass(frozen=True)
class HeldOut:
    """Force of one drive on the run that was not fitted, in the band of the equations.

    Attributes:
        rms: of measured less predicted force [N] or [N m].
        unit: its unit.
        noise_rms: what a perfect model would show with these sensors; NaN if not known.
        relative: the error's norm over the force's [1].
        nominal_rms: the same as rms, with the given parameters.
    """

    rms: float
    unit: str
    noise_rms: float
    relative: float
    nominal_rms: float


@dataclass(frozen=True)
class Forces:
    """Forces of the held-out run in the band of the equations; n rows, k drives [N] or [N m].

    Attributes:
        run: its name.
        drives: the k drives.
        time: (n,) [s] from its start.
        measured: (n, k), NaN where unknown.
        predicted: (n, k) with the identified parameters.
        nominal: (n, k) with the given parameters.
    """

    run: str
    drives: tuple[str, ...]
    time: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    nominal: np.ndarray


@dataclass(frozen=True)
class Identification:
    """Result; m parameters, r of them in the base.

    Attributes:
        names: the m parameters.
        units: (m,) SI units.
        nominal: (m,) as given.
        value: (m,) identified; what the data do not tell stays as given.
        told: what these data tell in spite of their noise.
        structure: what this motion would tell without noise, and the base parameters.
        estimate: of the base parameters, with covariance and residuals.
        bias: (r,) that the positions' noise would have left in them, taken off.
        heldout: drive -> prediction of the held-out run.
        forces: of the held-out run.
        band: of the equations [Hz].
        whiteness: drive -> correlation of a residual with the one before it.
        status: `ok`, or what is wrong and what to do about it.
        notes: one sentence each.
        seconds: that it took.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: np.ndarray
    value: np.ndarray
    told: Identifiability
    structure: Identifiability
    estimate: Estimate
    bias: np.ndarray
    heldout: dict[str, HeldOut]
    forces: Forces
    band: float
    whiteness: dict[str, float]
    status: str
    notes: tuple[str, ...]
    seconds: float

    def distance(self, value: np.ndarray) -> tuple[float, float]:
        """How far other parameters are from the estimate: the test by its confidence ellipsoid.

        Args:
            value: (m,) parameters.

        Returns:
            Squared distance in standard deviations, and what 95 % of right ones stay below.
        """
        limit = float(chi2.ppf(0.95, self.estimate.rank))
        return self.estimate.ellipsoid(self.told.combination @ value), limit
