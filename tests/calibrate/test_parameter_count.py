"""Counting formulas of kinematic parameters against ranks of identification Jacobians."""

import numpy as np
import pytest

from hydrotele.calibrate.parameter_count import (
    Mechanism,
    count_parallel_parameters,
    count_serial_parameters,
    delta_mechanism,
    hexapod_mechanism,
    identifiable_rank,
    serial_mechanism,
)
from hydrotele.experiments.wang_models import STRAIGHT_HEXAPOD, build_iwr_mechanism

HINGES = ("revolute", "revolute")


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("mechanism", "count"),
    [
        (serial_mechanism("PPRR", ("prismatic", "prismatic", *HINGES)), 18),
        (hexapod_mechanism("6-SPS", ("spherical", "prismatic", "spherical")), 48),
        (hexapod_mechanism("6-UPS", (*HINGES, "prismatic", "spherical")), 84),
        (delta_mechanism(), 54),  # "model 54" of Vischer and Clavel 1998
    ],
    ids=lambda value: getattr(value, "name", str(value)),
)
def test_the_rank_is_the_count_of_equation_5(mechanism: Mechanism, count: int):
    assert mechanism.count_parameters() == count
    assert identifiable_rank(mechanism, np.random.default_rng(3), poses=25) == count


def test_without_loops_equation_5_is_equation_4():
    for revolute, prismatic in ((6, 0), (2, 2), (3, 1)):
        assert count_serial_parameters(revolute, prismatic) == count_parallel_parameters(
            revolute=revolute, prismatic=prismatic, spherical_pairs=0,
            encoders=revolute + prismatic, loops=0, frames=2,
        )  # fmt: skip


def test_slides_through_both_joints_lose_one_parameter_per_leg():
    rng = np.random.default_rng(4)
    assert identifiable_rank(STRAIGHT_HEXAPOD, rng, poses=20) == 42
    assert build_iwr_mechanism(straight=True).count_parameters() == 60
    assert identifiable_rank(build_iwr_mechanism(straight=True), rng, poses=20) == 54


def test_too_few_poses_and_a_joint_that_never_moves_lower_the_rank():
    carriage = serial_mechanism("PPRR", ("prismatic", "prismatic", *HINGES))
    rng = np.random.default_rng(5)
    assert identifiable_rank(carriage, rng, poses=2) == 12  # six equations per pose
    assert identifiable_rank(carriage, rng, fixed_joints=frozenset({"joint0"})) == 16  # 2 of a slide
