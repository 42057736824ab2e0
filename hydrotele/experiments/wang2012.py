"""Wang 2012: kinematic calibration of the serial-parallel robot IWR, repeated in simulation.

The text of the thesis that is available ends with section 3.1.2 (page 34). Of the tables and
figures that follow only the captions are known, so that their rows have simulated values and no
verdict. Dimensions, sensor noise and errors are assumptions (models/iwr/README.md).
"""

from collections.abc import Sequence

import numpy as np

from hydrotele.calibrate.estimation import Prior
from hydrotele.calibrate.hybrid import (
    Calibration,
    Equations,
    calibrate,
    equations,
    null_directions,
    redundancy,
    subset,
)
from hydrotele.calibrate.posterior import evolve, sample_posterior
from hydrotele.experiments.comparison import (
    Changes,
    Check,
    Claim,
    Experiment,
    Judgement,
    Marginals,
    Panel,
    Sample,
    Series,
)
from hydrotele.experiments.intervals import (
    check_fraction,
    check_mean,
    check_statistic,
    collect,
    format_values,
)
from hydrotele.experiments.wang_models import EXPERIMENTS as MODEL_EXPERIMENTS
from hydrotele.experiments.wang_models import MAX_ROUNDING
from hydrotele.experiments.wang_robots import (
    REQUIRED_ACCURACY,
    SENSOR_NOISE,
    DrawnClaim,
    Drawing,
    SimulatedRobot,
    caption_claim,
    change_settings,
    pose_errors_at_test_poses,
    root_mean_square,
    simulate_robot,
)
from hydrotele.kinematics.hybrid import (
    Hybrid,
    document_parameters,
    error_model,
    forward,
    inverse,
    leg_readings,
    load_hybrid,
    pose_difference,
)
from hydrotele.kinematics.wires import pose_covariance, pose_of_wires, wire_lengths
from hydrotele.simulate.hybrid import TILT, random_poses, shipped_wires
