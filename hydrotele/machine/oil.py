"""Oil of a machine: its viscosity as a function of temperature."""

import math
from typing import Annotated

from pydantic import Field, model_validator

from hydrotele.core.datafile import PositiveFloat, StrictModel

_ZERO_CELSIUS = 273.15  # K
_WALTHER_OFFSET = 0.7  # mm^2/s
MIN_TEMPERATURE, MAX_TEMPERATURE = -40.0, 130.0
"""Range of the viscosity law for hydraulic oil [degC]: pour point to the limit of its additives."""

Temperature = Annotated[float, Field(ge=MIN_TEMPERATURE, le=MAX_TEMPERATURE)]


class Oil(StrictModel):
    """Oil with kinematic viscosities [m^2/s] at 40 and 100 degC; the defaults are ISO VG 46.

    Viscous friction and laminar leakage of the machine file are those at `temperature` [degC].
    """

    temperature: Temperature = 40.0
    viscosity_40: PositiveFloat = 46.0e-6
    viscosity_100: PositiveFloat = 6.8e-6

    @model_validator(mode="after")
    def _check(self):
        if self.viscosity_100 >= self.viscosity_40:
            raise ValueError("viscosity_100 must be smaller than viscosity_40")
        return self


def kinematic_viscosity(oil: Oil, temperature: float) -> float:
    """Return the kinematic viscosity of an oil [m^2/s] at a temperature [degC].

    `log10 log10 (v + 0.7) = a - b log10 T`, with v in mm^2/s, T in K, and a, b from the viscosities
    at 40 and 100 degC. It is valid for v of 2 mm^2/s or more.

    Source: Walther's equation, ASTM D341-20, Eq. 1 and Annex.

    >>> round(1e6 * kinematic_viscosity(Oil(), 40.0), 3), round(1e6 * kinematic_viscosity(Oil(), 60.0), 1)
    (46.0, 20.6)
    """

    def double_log(viscosity: float) -> float:
        return math.log10(math.log10(1e6 * viscosity + _WALTHER_OFFSET))

    low, high = (math.log10(t + _ZERO_CELSIUS) for t in (40.0, 100.0))
    thick, thin = double_log(oil.viscosity_40), double_log(oil.viscosity_100)
    share = (math.log10(temperature + _ZERO_CELSIUS) - low) / (high - low)
    return 1e-6 * (10.0**10.0 ** (thick + share * (thin - thick)) - _WALTHER_OFFSET)
