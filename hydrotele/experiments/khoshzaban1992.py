"""Khoshzaban 1992: kinematic and dynamic calibration of a hydraulic arm, repeated in simulation.

Chapter 2 and sections 3.3 to 3.6 are in `khoshzaban_machine`, section 3.7 in `khoshzaban_arm` and
section 3.8 in `khoshzaban_calibration_claims`. Chapter 4 is in `khoshzaban_dynamics`, and the
proposals of the thesis are in `khoshzaban_proposals`.
"""

from hydrotele.experiments import (
    khoshzaban_arm,
    khoshzaban_calibration_claims,
    khoshzaban_dynamics,
    khoshzaban_machine,
    khoshzaban_proposals,
)
from hydrotele.experiments.comparison import Series

DRAWINGS = {
    "Fig. 1": "block diagram of a controller", "Fig. 2": "drawing of the excavator",
    "Fig. 3": "drawing of the excavator with grapple", "Fig. 8": "coordinate frame of a link",
    "Fig. 11": "convention of the link frames", "Fig. 12": "drawing of a cylinder's triangle",
    "Fig. 13": "drawing of the calibrator", "Fig. 14": "drawing of machine and calibrator",
}  # fmt: skip
"""Figures without a result."""

SERIES = Series(
    "khoshzaban1992",
    "Khoshzaban-Zavarehi, Kinematic and dynamic calibration of hydraulically actuated manipulators,"
    " 1992",
    20,
    (
        *khoshzaban_machine.EXPERIMENTS, *khoshzaban_arm.EXPERIMENTS,
        *khoshzaban_calibration_claims.EXPERIMENTS, *khoshzaban_dynamics.EXPERIMENTS,
        *khoshzaban_proposals.EXPERIMENTS,
    ),
    khoshzaban_dynamics.UNAVAILABLE,
    DRAWINGS | khoshzaban_dynamics.DRAWINGS,
)  # fmt: skip
