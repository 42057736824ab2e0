"""Zhu 1994: force-reflecting resolved motion control of an excavator and a feller-buncher.

Chapters 2 to 5 are computed from the models. The machine experiments of chapter 6 are repeated with
one simulated operator of the published population per repetition. In the thesis, each figure shows
one operator, whose parameters are unknown.
"""

from hydrotele.experiments import (
    zhu_contact_forces,
    zhu_false_force,
    zhu_felling,
    zhu_free_motion,
    zhu_identification,
    zhu_tables,
    zhu_theory,
)
from hydrotele.experiments.comparison import Experiment, Series

EXPERIMENTS: tuple[Experiment, ...] = (
    *zhu_theory.EXPERIMENTS,
    zhu_tables.TABLE_COMPARISON,
    *zhu_identification.EXPERIMENTS,
    zhu_free_motion.STEERING,
    *zhu_free_motion.LINES,
    *zhu_contact_forces.STIFFNESS_FEEDBACK,
    *zhu_felling.TIP_OVER,
    *zhu_free_motion.HANDLE_RAMPS,
    *zhu_contact_forces.FORCE_TRACKING,
    *zhu_felling.FELLING,
    *zhu_free_motion.STEPS,
    *zhu_false_force.FALSE_FORCE,
    *zhu_contact_forces.UNSTABLE_FEEDBACK,
)
"""Experiments in the order of the document."""

SERIES = Series(
    "zhu1994",
    "Zhu 1994, Master-slave force-reflecting resolved motion control of hydraulic mobile machines",
    20,
    EXPERIMENTS,
    items_without_result=zhu_theory.DRAWINGS | zhu_identification.DRAWINGS,
)
