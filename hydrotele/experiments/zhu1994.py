"""Zhu 1994: force-reflecting resolved motion control of an excavator and a feller-buncher.

Chapters 2 to 5 are computed from the models. The machine experiments of chapter 6 are repeated with
one simulated operator of the published population per repetition. In the thesis, each figure shows
one operator, whose parameters are unknown.
"""

from hydrotele.experiments import (
    zhu_control,
    zhu_false_force,
    zhu_felling,
    zhu_forces,
    zhu_identification,
    zhu_motion,
    zhu_tables,
)
from hydrotele.experiments.comparison import Experiment, Series

EXPERIMENTS: tuple[Experiment, ...] = (
    *zhu_control.EXPERIMENTS,
    zhu_tables.TABLE_COMPARISON,
    *zhu_identification.EXPERIMENTS,
    zhu_motion.STEERING,
    *zhu_motion.LINES,
    *zhu_forces.STIFFNESS_FEEDBACK,
    *zhu_felling.TIP_OVER,
    *zhu_motion.HANDLE_RAMPS,
    *zhu_forces.FORCE_TRACKING,
    *zhu_felling.FELLING,
    *zhu_motion.STEPS,
    *zhu_false_force.FALSE_FORCE,
    *zhu_forces.UNSTABLE_FEEDBACK,
)
"""Experiments in the order of the document."""

SERIES = Series(
    "zhu1994",
    "Zhu 1994, Master-slave force-reflecting resolved motion control of hydraulic mobile machines",
    20,
    EXPERIMENTS,
    items_without_result=zhu_control.DRAWINGS | zhu_identification.DRAWINGS,
)
