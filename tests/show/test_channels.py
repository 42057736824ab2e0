"""Units, groups and differences of channels."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.logs.log import Log
from hydrotele.machine.log_channels import MEASURED_KINDS, TRUTH_KINDS
from hydrotele.show.channels import (
    TITLES,
    assign_axis_colours,
    compute_channel_difference,
    group_channels,
    padded_range,
    scale_channel_for_plot,
)


def test_every_kind_has_a_title():
    assert set(TITLES) == {*MEASURED_KINDS, *TRUTH_KINDS} - {"time"}


@pytest.mark.parametrize(
    "name, unit, factor",
    [
        ("angle.boom", "deg", 180 / np.pi),
        ("length.boom", "mm", 1e3),
        ("pressure_supply", "MPa", 1e-6),
        ("truth.flow_head.boom", "L/min", 6e4),
        ("command.boom", "1", 1.0),
    ],
)
def test_channels_are_shown_in_the_units_of_the_field(log, name, unit, factor):
    trace = scale_channel_for_plot(log, name)
    assert trace.unit == unit
    assert trace.values == pytest.approx(factor * log[name], rel=1e-12)


def test_truth_stands_back_where_it_was_measured():
    names = ["angle.boom", "truth.angle.boom", "truth.angle.grapple_pitch"]
    assert group_channels(names) == {"angle": ["angle.boom", "truth.angle.grapple_pitch"]}


def test_an_axis_keeps_its_colour_with_more_recorded(log):
    assert assign_axis_colours([log]).items() >= assign_axis_colours([log.without_truth()]).items()


def test_a_log_does_not_differ_from_itself(log):
    time, trace = compute_channel_difference(log, log, "angle.boom")
    assert np.array_equal(time, log.time) and not trace.values.any()


def test_difference_is_taken_on_the_first_clock(make):
    first, other = make(0.1 * np.arange(40)), make(0.05 + 0.01 * np.arange(300), offset=0.1)
    time, trace = compute_channel_difference(first, other, "angle.boom")
    assert time[0] == pytest.approx(0.1) and time[-1] == pytest.approx(3.0)
    # linear interpolation is off by h^2/8 times the curvature: 1e-4 / 8 * 0.8 rad
    assert trace.values == pytest.approx(np.degrees(-0.1), abs=np.degrees(2e-5))


def test_logs_without_common_time_are_refused(log):
    later = Log(log.time + 100, log.columns, log.units)
    with pytest.raises(InputError, match="common clock"):
        compute_channel_difference(log, later, "angle.boom")


def test_a_constant_is_not_blown_up_to_noise():
    low, high = padded_range([np.full(10, 5.0)], "MPa")
    assert high - low == pytest.approx(0.5) and low < 5.0 < high
