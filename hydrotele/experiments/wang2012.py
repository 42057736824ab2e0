"""Wang 2012: kinematic calibration of the serial-parallel robot IWR, repeated in simulation.

The available text of the thesis ends with section 3.1.2 (page 34). Only the captions of the later
tables and figures are known; their rows have simulated values and no verdict. Dimensions, sensor
noise and parameter errors are assumptions (models/iwr/README.md).
"""

from hydrotele.experiments import wang_calibration, wang_identification, wang_models
from hydrotele.experiments.comparison import Series

SERIES = Series(
    "wang2012",
    "Y. Wang, Novel methods for error modeling and parameter identification of a redundant"
    " serial-parallel hybrid robot, thesis, Lappeenranta 2012",
    20,
    (*wang_models.EXPERIMENTS, *wang_identification.EXPERIMENTS, *wang_calibration.EXPERIMENTS),
    items_without_result={
        "Fig. 1": "picture of the fusion reactor ITER",
        "Fig. 2": "photograph of the robot",
        "Fig. 3": "drawing of a SCARA robot",
        "Fig. 4": "drawing of the Denavit-Hartenberg convention",
        "Fig. 5": "drawing of the carriage's frames",
        "Fig. 6": "drawing of the hexapod's frames",
        "Fig. 7": "drawing of the robot",
        "Fig. 8": "drawing of the reference configuration",
        "Fig. 9": "flowchart of differential evolution",
        "Fig. 22": "drawing of the 3-2-1 wire measurement",
        "Fig. 23": "drawing of the trilateration",
        "Fig. 24": "picture of the 3-2-1 wire measurement in the CAD model",
    },
)  # fmt: skip
"""All tables and figures of Wang 2012."""
