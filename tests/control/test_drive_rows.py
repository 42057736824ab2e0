"""Tabulated drive references are those of the servo."""

import numpy as np
import pytest

from hydrotele.control.plan import Plan
from hydrotele.control.servo import (
    compute_drive_references,
    interpolate_drive_reference,
    tabulate_drive_geometry,
)
from hydrotele.machine.machine_file import load_machine
from hydrotele.scenario.scenario import Servo


@pytest.mark.parametrize(("name", "tool"), [("cat215", "bucket"), ("cat325", None)])
def test_drive_row_is_the_servos(name, tool):
    """1e-6 of the largest: tables of 4001 rows, interpolated linearly."""
    machine = load_machine(name, tool) if tool else load_machine(name)
    axes, rng, n = tuple(machine.axes), np.random.default_rng(1), 200
    ranges = [machine.joints[machine.axes[a].joint].range or (-1.0, 1.0) for a in axes]
    reference = np.array([rng.uniform(*r, n) for r in ranges]).T
    rate = rng.uniform(-0.5, 0.5, reference.shape)
    closed = np.array([machine.axes[a].is_hydraulic is not None for a in axes])
    plan = Plan(np.arange(n) / 200.0, axes, np.zeros((n, len(axes))), reference, rate, closed)
    servo = Servo(feedforward=0.9, lead=0.0)
    wanted = compute_drive_references(machine, plan, servo)
    grid, table = tabulate_drive_geometry(machine, axes)
    k = len(axes)
    for tick in range(n):
        got = [np.zeros(k) for _ in range(4)]
        interpolate_drive_reference(grid, table, reference[tick], rate[tick], servo.feedforward, *got)
        for made, name_of in zip(got, ("velocity", "arm", "volume_head", "volume_rod"), strict=True):
            full = getattr(wanted, name_of)
            near = 1e-6 * np.abs(full).max(axis=0) + 1e-12
            assert np.all(np.abs(made - full[tick])[closed] <= near[closed]), name_of
