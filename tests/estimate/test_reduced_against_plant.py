"""Free runs of the reduced model against the MuJoCo plant, with every part that drives can have."""

import json
from pathlib import Path

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.estimate.reduced_model import predicted_channels, simulate_rows, state_names
from hydrotele.hydraulics.actuator_layout import SLOT_COUNT, Slot
from hydrotele.hydraulics.laws import ATMOSPHERE
from hydrotele.machine.drives import EndStop
from hydrotele.machine.machine import Engine
from hydrotele.machine.machine_file import load_machine, save_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario
from hydrotele.terms.term import Term

PERIOD = 0.02
ROWS = 50  # 1 s
ANGLE, LENGTH, PRESSURE = np.radians(0.01), 0.2e-3, 0.1 * 25 * 6894.757
CASES = {
    "cat215/none": (),
    "cat215/bucket": (),
    "command_delay": (("command_delay", "all", {"delay": 0.0337}),),
    "sensors": (
        ("angle_offset", "boom", {"offset": 0.02}),
        ("angle_scale", "stick", {"ratio": 1.01}),
        ("angle_delay", "swing", {"delay": 0.0133}),
        ("angle_drift", "swing", {"drift": 0.03, "time_constant": 1.0}),
        ("angle_drift", "boom", {"drift": -0.02, "time_constant": 2.0}),
        ("pressure_offset", "boom.head", {"offset": 60e3}),
        ("pressure_delay", "stick", {"delay": 0.0275}),
    ),
    "backlash": (("backlash", "swing", {"gap": 0.02}),),
    "joint_flexibility": (
        ("joint_flexibility", "swing", {"compliance": 2e-7}),
        ("joint_flexibility", "boom", {"compliance": 2e-8}),
    ),
    "forces of terms": (
        ("external_force", "stick", {"force": 9e3}),
        ("force_pulse", "boom", {"size": -3e4, "start": 0.3, "duration": 0.4}),
        ("speed_dependent_force", "swing", {"coefficient": 2e4}),
        ("load_dependent_friction", "boom", {"coefficient": 0.05}),
        ("position_dependent_friction", "stick", {"coulomb": 1e4, "centre": 0.6, "width": 0.1}),
    ),
    "tank_leakage": (
        ("tank_leakage", "boom", {"leakage": 2e-11}),
        ("tank_leakage", "swing", {"leakage": 1e-11}),
    ),
    "flows of terms": (
        ("orifice_leakage", "boom", {"flow": 4e-4}),
        ("warming", "all", {"ratio": 0.2, "time_constant": 2.0}),
    ),
    "commands of terms": (("command_offset", "stick", {"offset": 0.08}),),
    "terms on a flexible drive": (
        ("joint_flexibility", "boom", {"compliance": 2e-8}),
        ("load_dependent_friction", "boom", {"coefficient": 0.05}),
        ("external_force", "boom", {"force": 2e4}),
    ),
    "valves": (
        ("valve_gain_direction", "boom", {"positive": 1.3, "negative": 0.6}),
        ("valve_deadband_direction", "stick", {"positive": 0.02, "negative": 0.09}),
        ("flow_curve", "swing", {"positive": 0.5, "negative": -0.4}),
        ("metering_edges", "stick", {"p_a": 0.8, "b_t": 0.5, "p_b": 1.2, "a_t": 1.4}),
        ("spool_slew", "boom", {"travel_time": 0.6}),
    ),
    "load_compensation": (
        ("load_compensation", "boom", {"regulation": 0.9}),
        ("load_compensation", "stick", {"regulation": 0.7}),
    ),
    "load_holding": (("load_holding", "boom.head", {"setting": 40e6}),),
    "pump_droop": (("pump_droop", "supply", {"droop": 7e-11}),),
    "relief_override": (("relief_pressure", "supply", {"relief_pressure": 20e6, "relief_override": 9e8}),),
    "presliding": (
        ("presliding", "swing", {"compliance": 5e-7}),
        ("presliding", "boom", {"compliance": 1e-7}),
    ),
    "presliding on a flexible drive": (
        ("joint_flexibility", "boom", {"compliance": 2e-8}),
        ("presliding", "boom", {"compliance": 1e-7}),
    ),
    "pump_lag": (("pump_lag", "supply", {"time_constant": 0.15}),),
}


def scenario(name, axes, effects, timestep, size=0.4, shape=np.sin):
    """All axes driven by held sines, or waves of another shape.

    They are shut at first, so that late commands have a past.
    """
    time = PERIOD * np.arange(ROWS)
    wave = np.where(np.arange(ROWS) > 3, size, 0.0)
    columns = {a: (wave * shape(5.0 * time + i)).tolist() for i, a in enumerate(axes)}
    machine, _, tool = name.partition("/")
    keys = {
        "name": "t",
        "machine": machine,
        "control_rate": 50,
        "log_rate": 50,
        "duration": ROWS * PERIOD,
        "ground": False,
        "timestep": timestep,
        "pilot": {
            "kind": "table",
            "quantity": "command",
            "interpolate": "hold",
            "time": time.tolist(),
            "columns": columns,
        },
        "effects": [dict(zip(("name", "location", "parameters"), e, strict=True)) for e in effects],
    }
    return Scenario.model_validate(keys | ({"tool": tool} if tool else {}))


def begin(machine, model, z, state):
    """Write a log's initial state into a state of the reduced model."""
    joints = {axis.joint: name for name, axis in machine.axes.items()}
    renamed = {"position": "angle", "rate": "velocity"}
    for s, name in enumerate(state_names(machine)):
        kind, _, where = name.partition(".")
        axis = joints.get(where, where)
        if kind in ("drive", "drive_rate", "bristle", "delivery", "added_delivery", "memory"):
            z[s] = state[kind.replace("rate", "velocity")][axis]
        else:
            z[s] = state[renamed.get(kind, kind)][state["order"].index(axis)]


def differences(reduced_of, machine, plan, steps):
    """Readings of plant and reduced model: channel -> (largest difference, travel)."""
    return differences_of(reduced_of, machine, run_scenario(plan), steps)


def differences_of(reduced_of, machine, run, steps):
    """The same of a run of the plant."""
    channels = predicted_channels(machine)
    model, space, z = reduced_of(machine, channels)
    begin(machine, model, z, json.loads(run.truth.metadata["initial_state"]))
    command = np.column_stack([run.truth[f"command.{a}"] for a in run.plant.axes])
    out, states = np.zeros((ROWS, len(channels))), np.zeros((ROWS, len(z)))
    simulate_rows(model, space, z, command, PERIOD, steps, out, states)
    read = [run.measured[c] for c in channels]
    return {c: (np.abs(out[:, i] - read[i]).max(), np.ptp(read[i])) for i, c in enumerate(channels)}


def beyond(found):
    """Channels that are off by more than a tenth of 0.1 deg, 2 mm or 25 psi."""
    bounds = {"angle": ANGLE, "position": LENGTH, "length": LENGTH}
    return {
        c: error / bounds.get(c.partition(".")[0], PRESSURE)
        for c, (error, _) in found.items()
        if error > bounds.get(c.partition(".")[0], PRESSURE)
    }


@pytest.mark.daily("tank_leakage", "valves", "presliding")
@pytest.mark.parametrize("case", CASES)
def test_readings_are_those_of_the_plant(case, machine_of, reduced_of):
    name = case if "/" in case else "cat215/none"
    machine = machine_of(name)
    for effect in CASES[case]:
        machine = apply_effect(machine, *effect)
    plan = scenario(name, machine.axes, CASES[case], 1.25e-4)  # its own error is of first order
    found = differences(reduced_of, machine, plan, 40)
    assert not beyond(found)
    for axis in machine.axes:
        assert found[f"angle.{axis}"][1] > 50 * ANGLE, "a machine at rest would prove nothing"
    if CASES[case]:
        nominal = differences(reduced_of, machine_of(name), plan, 40)
        assert beyond(nominal), "without the effect it would be seen"


def test_two_pumps_with_merging_priority_and_engine(reduced_of, tmp_path):
    """At full commands, so that pumps and engine limit the flows."""
    two = load_machine(Path(__file__).parents[1] / "data" / "two_pumps")
    machine = two.model_copy(update={"engine": Engine(power=60e3)})
    save_machine(machine, tmp_path / "machine.yaml")
    plan = scenario("cat215/none", machine.axes, (), 1.25e-4, 1.0).model_copy(update={"machine": str(tmp_path)})
    assert not beyond(differences(reduced_of, machine, plan, 80))
    for without in ({"merging": {}}, {"engine": None}):
        assert beyond(differences(reduced_of, machine.model_copy(update=without), plan, 80))


def run_into(phase):
    """A wave that goes one way only over these rows."""
    return np.sign(np.sin(0.5 * phase))


@pytest.mark.parametrize("size", [1.0, -1.0])
def test_a_cylinder_that_runs_into_its_end(machine_of, reduced_of, size):
    """Two programs, one spring: MuJoCo's soft limit and the reduced model's force."""
    machine = machine_of("rig")
    plan = scenario("rig", machine.axes, (), 1.25e-4, size, run_into)
    found = differences(reduced_of, machine, plan, 160)
    assert not beyond(found)
    run = run_scenario(plan)
    end = run.truth["length.slide"][-1]
    depth = end - machine.axes["slide"].cylinder.stroke if size > 0 else -end
    rest = {side: run.truth[f"pressure_{side}.slide"][-1] for side in ("head", "rod")}
    head, rod = machine.axes["slide"].cylinder.effective_areas
    push = abs(head * rest["head"] - rod * rest["rod"])
    # pressed in by the force over the stiffness; 150 N of dry friction may hold some of it back
    stiffness = machine.end_stop("slide").stiffness
    assert depth == pytest.approx(push / stiffness, abs=200.0 / stiffness)
    without = machine.model_copy(update={"axes": {"slide": machine.axes["slide"].model_copy(
        update={"end_stop": EndStop(stiffness=1e-6, damping=0.0)})}})  # fmt: skip
    assert beyond(differences_of(reduced_of, without, run, 40)), "without it, it leaves the stroke"


def drawn_empty(run):
    """Largest lack of pressure below atmosphere in a run of the plant [Pa]."""
    names = [c for c in run.truth.columns if c.startswith("pressure_")]
    return -min(run.truth[c].min() for c in names)


def test_a_chamber_that_is_drawn_empty(machine_of, reduced_of):
    """The wind takes the swing: its motor draws faster than the make-up valve fills."""
    effect = ("force_pulse", "swing", {"size": 1.5e5, "start": 0.3, "duration": 0.4})
    machine = apply_effect(machine_of("cat215/none"), *effect)
    run = run_scenario(scenario("cat215/none", machine.axes, (effect,), 1.25e-4))
    assert 0.3 * ATMOSPHERE < drawn_empty(run) < ATMOSPHERE
    assert not beyond(differences_of(reduced_of, machine, run, 40))

    def without_air(machine, channels):
        model, space, z = reduced_of(machine, channels)
        user = model.user.copy()
        user[Slot.AIR_RELEASE :: SLOT_COUNT] = 0.0
        return model._replace(user=user), space, z

    assert beyond(differences_of(without_air, machine, run, 40)), "the air would not be missed"


def test_the_plant_converges_to_the_reduced_model_in_hammering_chambers(machine_of, reduced_of):
    """Torn by 1.1 MN a chamber empties, is filled and slams shut at 45 MPa."""
    effect = ("force_pulse", "boom", {"size": 1.1e6, "start": 0.3, "duration": 0.4})
    machine, errors = apply_effect(machine_of("cat215/none"), *effect), []
    for timestep in (2.5e-4, 1.25e-4):
        run = run_scenario(scenario("cat215/none", machine.axes, (effect,), timestep))
        assert 0.7 * ATMOSPHERE < drawn_empty(run) < ATMOSPHERE
        found = differences_of(reduced_of, machine, run, 160)
        errors.append([found[c][0] for c in ("angle.boom", "pressure_head.boom")])
    ratio = np.array(errors[1]) / errors[0]
    assert np.all((ratio > 0.4) & (ratio < 0.6)), errors  # first order, as everywhere


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (
            ("command_offset", "slide", {"offset": 0.3}),
            ("force_pulse", "slide", {"size": -60.0, "start": 0.4, "duration": 0.3}),
            ("speed_dependent_force", "slide", {"coefficient": 150.0}),
        ),
    ],
)
def test_a_plain_force_drive(effects, machine_of, reduced_of):
    machine = machine_of("emps")
    for effect in effects:
        machine = apply_effect(machine, *effect)
    plan = scenario("emps", machine.axes, effects, 2.5e-4, size=2.0)
    found = differences(reduced_of, machine, plan, 40)
    error, travel = found["position.slide"]
    assert error < 1e-3 * travel  # three times what the plant's first-order step leaves
    assert travel > 1e-3


@pytest.mark.nightly
def test_terms_with_variables_of_another_drive(machine_of, reduced_of, tmp_path):
    """Force, flows and command of one drive that go with another's motion, pressure and command."""
    nominal = machine_of("cat215/none")
    laws = (
        ("boom", "force", {"velocity": 1.5e5}, {"velocity": "swing"}),
        ("stick", "flow_head", {"position * pressure_rod": -4e-11},
         {"position": "boom", "pressure_rod": "boom"}),
        ("swing", "command", {"command": 0.15, "spool": 0.1},
         {"command": "stick", "spool": "stick"}),
        ("boom", "flow_supply", {"velocity": 4e-3, "pressure_supply": -4e-11},
         {"velocity": "swing"}),
    )  # fmt: skip
    terms = tuple(
        Term(name="t", axis=axis, balance=balance, law="formula", parameters=law, variables_from=of)
        for axis, balance, law, of in laws
    )
    plan = scenario("cat215/none", nominal.axes, (), 1.25e-4)
    for k in range(len(terms)):
        (tmp_path / f"{k}").mkdir()
        machine = nominal.model_copy(update={"terms": terms[k : k + 1]})
        save_machine(machine, tmp_path / f"{k}" / "machine.yaml")
        own = plan.model_copy(update={"machine": str(tmp_path / f"{k}" / "machine.yaml")})
        run = run_scenario(own.model_copy(update={"tool": None}))
        assert not beyond(differences_of(reduced_of, machine, run, 40))
        assert beyond(differences_of(reduced_of, nominal, run, 40)), "without it it would be seen"


@pytest.mark.nightly
def test_terms_with_a_memory(machine_of, reduced_of, tmp_path):
    """Force, flow and command that see a variable through a play, or that a relay switches."""
    nominal = machine_of("cat215/none")
    laws = (
        ("boom", "force", {"play_output": -2e5}, {},
         {"play": {"variable": "velocity", "half_width": 0.02}}),
        ("stick", "flow_head", {"1": 4e-4}, {"pressure_rod": "boom"},
         {"switch": {"variable": "pressure_rod", "on": 3.0e6, "off": 1.5e6}}),
        ("swing", "command", {"play_output": 0.3}, {},
         {"play": {"variable": "command", "half_width": 0.1}}),
        ("swing", "force", {"1": 3e3}, {"position": "boom"},
         {"switch": {"variable": "position", "on": 0.81, "off": 0.795}}),
    )  # fmt: skip
    terms = tuple(
        Term.model_validate({
            "name": "t", "axis": axis, "balance": balance, "law": "formula", "parameters": law,
            "variables_from": of, **memory,
        })
        for axis, balance, law, of, memory in laws
    )  # fmt: skip
    plan = scenario("cat215/none", nominal.axes, (), 1.25e-4)
    for k, term in enumerate(terms):
        (tmp_path / f"{k}").mkdir()
        machine = nominal.model_copy(update={"terms": (term,)})
        save_machine(machine, tmp_path / f"{k}" / "machine.yaml")
        own = plan.model_copy(update={"machine": str(tmp_path / f"{k}" / "machine.yaml")})
        run = run_scenario(own.model_copy(update={"tool": None}))
        held = run.truth["truth.memory.term_1"]
        assert np.ptp(held) > 0.9, "it was moved"
        # what is remembered counts from the next step on: the plant's step
        assert not beyond(differences_of(reduced_of, machine, run, 160)), k
        assert beyond(differences_of(reduced_of, nominal, run, 40)), "without it it would be seen"
        law = {"velocity" if k == 0 else "command": v for v in term.parameters.values()}
        forgetful = term.model_copy(update={"play": None, "switch": None} | (
            {"parameters": law} if term.play else {}))  # fmt: skip
        other = nominal.model_copy(update={"terms": (forgetful,)})
        assert beyond(differences_of(reduced_of, other, run, 40)), "nor is it a law without memory"


def test_the_plant_converges_to_the_reduced_model(machine_of, reduced_of):
    """What is left between the two is the plant's step, not another machine."""
    machine = machine_of("cat215/none")
    errors = []
    for timestep in (1e-3, 5e-4, 2.5e-4):
        plan = scenario("cat215/none", machine.axes, (), timestep)
        found = differences(reduced_of, machine, plan, 80)
        errors.append(np.linalg.norm([found[f"angle.{a}"][0] for a in machine.axes]))
    ratios = np.array(errors[1:]) / errors[:-1]
    # first order or better
    assert np.all((ratios > 0.2) & (ratios < 0.6)), errors
