"""Positions and forces of the drives from logs."""

import dataclasses

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.identify.record import build_records
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.logs.dataset import make_dataset
from hydrotele.logs.log import Log
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.log_channels import default_channel_unit
from hydrotele.machine.machine_file import load_machine
from hydrotele.machine.sensors import SensorError

ROWS = 600
AXES = {"swing": 0.1, "boom": 0.45, "stick": -1.6}


def made_up(drop=(), noise=1.0):
    """Logs of two runs with known angles and pressures, and sensors' noise."""
    machine, rng = load_machine("cat215"), np.random.default_rng(0)
    time, runs = 0.02 * np.arange(ROWS), []
    for name in ("a", "b"):
        columns = {}
        for k, (axis, middle) in enumerate(AXES.items()):
            angle = middle + 0.2 * np.sin((0.5 + 0.2 * k) * time)
            columns[f"command.{axis}"] = 0.3 * np.cos((0.5 + 0.2 * k) * time)
            columns[f"angle.{axis}"] = angle + noise * 1e-3 * rng.normal(size=ROWS)
            if axis != "swing":
                cylinder = machine.axes[axis].cylinder
                x = axis_linkage(machine, axis).length(angle) - cylinder.closed_length
                columns[f"length.{axis}"] = x + noise * 1.2e-3 * rng.normal(size=ROWS)
            for side, level in (("head", 9e6), ("rod", 4e6)):
                wave = 1e6 * np.sin(0.3 * time + k)
                columns[f"pressure_{side}.{axis}"] = level + wave + noise * 1e5 * rng.normal(size=ROWS)
        kept = {c: v for c, v in columns.items() if c not in drop}
        units = {c: default_channel_unit(c) for c in kept}
        runs.append(RunFiles(name, (Log(time, kept, units, {"machine": "cat215"}, name),)))
    return make_dataset(runs, machine, "khoshzaban1992")


def test_angle_and_length_are_weighted_by_their_noise():
    both, (angle, length) = (
        made_up(), [made_up(drop=[f"{kind}.boom"]) for kind in ("length", "angle")]
    )  # fmt: skip
    boom = 1
    noises = [build_records(d)[0][0].position_noise[boom] for d in (angle, length)]
    fit, _, _ = build_records(both)
    combined = (noises[0] ** -2 + noises[1] ** -2) ** -0.5
    assert fit[0].position_noise[boom] == pytest.approx(combined, rel=1e-6)
    true = 0.45 + 0.2 * np.sin(0.7 * 0.02 * np.arange(ROWS))
    errors = [np.std(build_records(d)[0][0].position[:, boom] - true) for d in (both, angle, length)]
    # drawn noise: sigma of a standard deviation from 600 samples is 3 %
    assert errors[0] < 0.95 * min(errors[1:])
    assert errors[0] == pytest.approx(fit[0].position_noise[boom], rel=0.1)


@pytest.mark.parametrize("unknown", [["length.boom"], ["angle.boom", "length.boom"]])
def test_a_sensor_without_stated_noise_fills_the_gaps_of_the_other(unknown):
    data = made_up()
    noise, reading = data.noise.copy(), data.fit[0].reading.copy()
    noise[[data.channels.index(channel) for channel in unknown]] = np.nan
    reading[100:110, data.channels.index("angle.boom")] = np.nan
    run = dataclasses.replace(data.fit[0], reading=reading)
    fit, _, _ = build_records(dataclasses.replace(data, noise=noise, fit=(run, *data.fit[1:])))
    true = 0.45 + 0.2 * np.sin(0.7 * 0.02 * np.arange(ROWS))
    error = fit[0].position[:, 1] - true
    assert np.isfinite(error).all() and np.isnan(fit[0].position_noise[1]) == (len(unknown) == 2)
    assert np.abs(error).max() < 5 * 1.5e-3  # five times the larger noise of both, over 600 rows
    outside = np.r_[0:100, 110:ROWS]
    np.testing.assert_allclose(fit[0].position[outside, 1], reading[outside, data.channels.index("angle.boom")])


def test_forces_are_areas_times_pressures():
    data = made_up(noise=0.0)
    fit, _, _ = build_records(data)
    cylinder, time = data.machine.axes["stick"].cylinder, 0.02 * np.arange(ROWS)
    wave = 1e6 * np.sin(0.3 * time + 2)
    expected = cylinder.area_head * (9e6 + wave) - cylinder.area_rod * (4e6 + wave)
    np.testing.assert_allclose(fit[0].force[:, 2], expected, rtol=1e-12)
    sigma = data.noise[data.channels.index("pressure_head.stick")]
    noise = np.hypot(cylinder.area_head, cylinder.area_rod) * sigma
    assert fit[0].force_noise[2] == pytest.approx(noise)


def test_sensor_errors_that_the_machine_states_are_taken_out():
    data = made_up(noise=0.0)
    plain, _, _ = build_records(data)
    errors = {"pressure_head.stick": SensorError(offset=2e5), "angle.swing": SensorError(scale=2.0)}
    other = dataclasses.replace(data, machine=data.machine.model_copy(update={"sensor_errors": errors}))
    fit, _, _ = build_records(other)
    area = data.machine.axes["stick"].cylinder.area_head
    np.testing.assert_allclose(plain[0].force[:, 2] - fit[0].force[:, 2], area * 2e5)
    np.testing.assert_allclose(plain[0].position[:, 0] / fit[0].position[:, 0], 2.0)


def test_a_missing_side_leaves_the_force_unknown_and_says_so():
    fit, heldout, notes = build_records(made_up(drop=["pressure_rod.boom"]))
    assert np.isnan(fit[0].force[:, 1]).all() and np.isfinite(fit[0].force[:, 0]).all()
    assert any("boom has no pressure sensor at one side" in note for note in notes)
    assert heldout.name == "b"


def test_what_nothing_can_be_told_of_is_refused():
    with pytest.raises(InputError, match="position of swing is not in the logs"):
        build_records(made_up(drop=["angle.swing"]))
    pressures = [f"pressure_{side}.{axis}" for side in ("head", "rod") for axis in AXES]
    with pytest.raises(InputError, match="no force is known"):
        build_records(made_up(drop=pressures))


def test_ends_without_a_position_are_cut():
    data = made_up()
    late = {"angle.swing": SensorError(delay=0.05)}
    other = dataclasses.replace(data, machine=data.machine.model_copy(update={"sensor_errors": late}))
    fit, _, _ = build_records(other)
    # the last readings of a late sensor tell of earlier times: 2.5 rows
    assert len(fit[0].position) == len(fit[0].force) == ROWS - 3
    assert np.isfinite(fit[0].position).all()
