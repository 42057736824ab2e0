"""Computed forces along a plan, and what they are worth."""

import json

import numpy as np
import pytest

from hydrotele.control.feedforward import compute_force_references
from hydrotele.control.plan import Plan
from hydrotele.core.errors import InputError
from hydrotele.machine.machine_file import load_machine, save_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Servo, load_scenario


def swinging(machine, axes, middle, wide=0.05, seconds=6.0):
    """Plan of slow sines about a pose."""
    time = np.arange(0.0, seconds, 0.005)
    turn = 2.0 * np.pi / 3.0
    shape = np.ones((1, len(axes)))
    return Plan(
        time, tuple(axes), np.zeros((len(time), len(axes))),
        np.array(middle) + wide * np.sin(turn * time)[:, None] * shape,
        wide * turn * np.cos(turn * time)[:, None] * shape, np.ones(len(axes), bool),
    )  # fmt: skip


def test_a_slide_needs_mass_times_acceleration_friction_and_offset():
    machine = load_machine("emps")
    plan = swinging(machine, ["slide"], [0.0])
    found = compute_force_references(machine, plan, Servo(force_model="nominal"))
    (axis,), (link,) = machine.axes.values(), machine.links.values()
    friction = axis.force.friction
    rate = plan.rate[:, 0]
    expected = (
        -link.mass * (2 * np.pi / 3) ** 2 * plan.reference[:, 0] + friction.viscous * rate
        + friction.coulomb * np.tanh(rate / friction.smoothing_velocity) + axis.force.offset
    )  # fmt: skip
    inner = slice(200, -200)  # the filter's ends
    assert np.abs(found.force[inner, 0] - expected[inner]).max() < 0.02 * np.abs(expected).max()


def test_without_a_model_nothing_is_expected():
    machine = load_machine("emps")
    found = compute_force_references(machine, swinging(machine, ["slide"], [0.0]), Servo())
    assert not found.is_computed and not found.force.any() and not found.rate.any()


def test_an_excavator_at_rest_holds_its_load():
    machine = load_machine("cat215")
    plan = swinging(machine, ["swing", "boom", "stick"], [0.1, 0.45, -1.6], wide=1e-6)
    found = compute_force_references(machine, plan, Servo(force_model="nominal"))
    swing, boom, stick = found.force[len(plan.time) // 2]
    assert abs(swing) < 100.0 and 5e4 < boom < 3e5 and abs(stick) < 3e4  # weight is on the boom


@pytest.mark.nightly
def test_a_model_makes_a_plain_drive_follow(tmp_path):
    """The given model, a wrong one and none: each better than the next."""
    errors = []
    wrong = load_machine("emps")
    links = {n: li.model_copy(update={"mass": 0.7 * li.mass}) for n, li in wrong.links.items()}
    (tmp_path / "wrong").mkdir()
    save_machine(wrong.model_copy(update={"links": links}), tmp_path / "wrong" / "machine.yaml")
    for model in ("nominal", str(tmp_path / "wrong"), None):
        text = {"servo.force_model": json.dumps(model)} if model else {}
        run = run_scenario(load_scenario("emps_track", text))
        away = run.measured["position.slide"] - np.interp(run.measured.time, run.plan.time, run.plan.reference[:, 0])
        errors.append(np.std(away[run.measured.time > 1.0]))
    assert errors[0] < 0.5 * errors[1] < 0.5 * errors[2]


def test_refusals():
    machine = load_machine("emps")
    plan = swinging(machine, ["slide"], [0.0])
    with pytest.raises(InputError):
        compute_force_references(machine, plan, Servo(force_model="no_such_machine"))
    with pytest.raises(InputError, match="has the axes"):
        compute_force_references(machine, plan, Servo(force_model="ec20"))
    opened = Plan(plan.time, plan.axes, plan.command, plan.reference, plan.rate, np.zeros(1, bool))
    with pytest.raises(InputError, match="slide has none"):
        compute_force_references(machine, opened, Servo(force_model="nominal"))
