"""The strip of soil beside which a bucket may swing."""

import numpy as np

from hydrotele.machine.machine_file import load_machine
from hydrotele.scenario.surrounding_objects import SoilGround
from hydrotele.simulate.soil_bed import SoilBed
from hydrotele.soil.parameters import CARRIED_VOLUME


def test_a_bucket_that_returns_to_the_strip_cuts_nothing_between():
    bed = SoilBed(load_machine("cat215", "bucket"), SoilGround(kind="soil"))
    ahead, still = np.array([0.0, 0.0, -1.0]), np.zeros(3)
    bed.step(np.array([7.0, 0.0, -0.2]), still, ahead, 1e-3)
    bed.step(np.array([6.5, 0.0, -0.2]), still, ahead, 1e-3)
    carried, surface = bed.state[CARRIED_VOLUME], bed.surface.copy()
    assert carried > 0.0 and surface.min() < -0.1  # the bucket cuts between 7 and 6.5 m
    bed.step(np.array([0.0, 6.5, -0.2]), still, ahead, 1e-3)
    assert not bed.force.any() and bed.state[CARRIED_VOLUME] == carried
    bed.step(np.array([4.0, 0.0, -0.2]), still, ahead, 1e-3)
    between = (bed.cell_radii > 4.2) & (bed.cell_radii < 6.0)
    assert np.array_equal(bed.surface[between], surface[between])
    assert bed.state[CARRIED_VOLUME] <= carried
    assert not bed.force.any()  # springs start undeflected, and the bucket rests
