"""Khoshzaban 1992: kinematic and dynamic calibration of a hydraulic arm, repeated in simulation.

Chapters 2 and 3.3 to 3.6 are in `khoshzaban_machine`, section 3.7 in `khoshzaban_arm`, section 3.8
in `khoshzaban_experiment`.
"""

from hydrotele.experiments import (
    khoshzaban_arm,
    khoshzaban_experiment,
    khoshzaban_machine,
    khoshzaban_outlook,
)
from hydrotele.experiments.comparison import Comparison, Experiment, Series

# Chapter 4 (Tables 13 to 17, Figs 30 to 37): khoshzaban_dynamics.EXPERIMENTS and .UNAVAILABLE.
DYNAMICS: tuple[Experiment, ...] = ()
UNAVAILABLE: tuple[Comparison, ...] = ()

DRAWINGS = {
    "Fig. 1": "block diagram of a controller", "Fig. 2": "drawing of the excavator",
    "Fig. 3": "drawing of the excavator with grapple", "Fig. 8": "coordinate frame of a link",
    "Fig. 11": "convention of the link frames", "Fig. 12": "drawing of a cylinder's triangle",
    "Fig. 13": "drawing of the calibrator", "Fig. 14": "drawing of machine and calibrator",
    "Fig. 26": "location vectors of a link", "Fig. 27": "forces on a link",
    "Fig. 28": "drawing of a cylinder with its piston", "Fig. 29": "forces on a cylinder",
    "Fig. 34": "block diagram of the measurement",
}  # fmt: skip
"""Items that show no result."""

SERIES = Series(
    "khoshzaban1992",
    "Khoshzaban-Zavarehi, Kinematic and dynamic calibration of hydraulically actuated manipulators,"
    " 1992",
    20,
    (
        *khoshzaban_machine.EXPERIMENTS, *khoshzaban_arm.EXPERIMENTS,
        *khoshzaban_experiment.EXPERIMENTS, *DYNAMICS, *khoshzaban_outlook.EXPERIMENTS,
    ),
    UNAVAILABLE,
    DRAWINGS,
)  # fmt: skip
