"""The library as a whole: names, places, sizes, round trips; a new file is an effect by itself."""

import functools
import math
import sys

import numpy as np
import pytest

import hydrotele.effects as library
from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS, Effect, apply_effect
from hydrotele.machine.machine_file import load_machine, save_machine, shipped_machines
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario

MACHINES = [("cat215", "none"), ("cat215", "bucket"), ("cat215", "grapple"), ("rig", None),
            ("ec20", None), ("emps", None), ("cat325", None), ("eha", "load_30_bar"),
            ("calibrator", None)]  # fmt: skip
LAWS = {"force", "flow", "valve", "supply", "geometry", "timing", "sensor"}
ARM = {"swing", "boom", "stick"}
# Names are fixed, because scripts read them; with them the places on the CAT 215 without a tool.
PLACES = {
    "payload": {"tool"}, "coulomb_friction": ARM, "viscous_friction": ARM, "stribeck_friction": ARM,
    "friction_asymmetry": ARM, "backlash": {"swing"}, "joint_flexibility": ARM, "com_offset": ARM,
    "inertia_error": ARM, "base_tilt": {"base"}, "link_length": {"boom", "stick"},
    "pin_offset": {"boom", "stick"}, "valve_deadband": ARM, "valve_gain": ARM, "spool_lag": ARM,
    "internal_leakage": ARM, "tank_leakage": ARM, "hose_compliance": ARM, "bulk_modulus": {"all"},
    "entrained_air": {"all"},
    "pump_flow_limit": {"supply"}, "relief_pressure": {"supply"}, "command_delay": {"all", *ARM},
    "angle_offset": ARM, "angle_drift": ARM, "angle_scale": ARM, "angle_delay": ARM,
    "length_offset": {"boom", "stick"},
    "pressure_offset": {f"{axis}.{side}" for axis in ARM for side in ("head", "rod")},
    "pressure_delay": ARM, "external_force": ARM, "force_pulse": ARM,
    "speed_dependent_force": ARM, "load_dependent_friction": ARM,
    "position_dependent_friction": ARM, "orifice_leakage": ARM, "warming": {"all"}, "oil_viscosity": {"all"},
    "command_offset": ARM, "valve_gain_direction": ARM, "valve_deadband_direction": ARM,
    "metering_edges": ARM, "flow_curve": ARM, "spool_slew": ARM, "load_compensation": ARM,
    "load_holding": {f"{axis}.{side}" for axis in ARM for side in ("head", "rod")},
    "pump_droop": {"supply"}, "end_stop_stiffness": {"boom", "stick"},
    "pump_lag": {"supply"}, "presliding": ARM,
    "angle_lag": ARM, "pressure_lag": ARM,
    "pressure_scale": {f"{axis}.{side}" for axis in ARM for side in ("head", "rod")},
    "clock_offset": {"positions", "pressures"},
}  # fmt: skip
PUMPED = {
    "pump_displacement": {"piston"}, "pump_leakage": {"piston"}, "pump_torque_loss": {"piston"},
    "motor_constant": {"piston"}, "motor_inertia": {"piston"}, "motor_drag": {"piston"},
    "motor_viscous_drag": {"piston"}, "line_compliance": {"piston.head", "piston.rod"},
    "accumulator_pressure": {"piston"}, "load_relief": {"piston"}, "load_friction": {"piston"},
}  # fmt: skip
MERGED = {"merging_valve": {"boom", "stick", "tilt"}}  # of the CAT 325, which has two pumps
SENSED = {"joint_bending", "sensor_misalignment", "sensor_backlash"}  # of a calibrator's joints
machine_of = functools.cache(load_machine)
untouched = functools.cache(lambda name, tool: load_machine(name, tool))  # no test gets hold of it
CASES = [
    (name, tool, effect.name, place)
    for name, tool in MACHINES
    for effect in EFFECTS.values()
    for place in effect.locations(machine_of(name, tool))
]
# Their axes and valves are of the same kinds as those of the CAT 215 with its bucket.
ALIKE = [("cat215", "none"), ("cat215", "grapple"), ("ec20", None), ("cat325", None)]
PLACED = [  # every effect of every machine, with all its places
    pytest.param(name, tool, effect.name,
                 marks=[pytest.mark.nightly] if (name, tool) in ALIKE else [])
    for name, tool in MACHINES for effect in EFFECTS.values()
    if effect.locations(machine_of(name, tool))
]  # fmt: skip
LATER = {"load_holding", "end_stop_stiffness"}  # felt on the way back and at the ends: test_valve
FELT = [  # daily at the last of its places, which all of them change, at the first one nightly
    case if place == -1 else pytest.param(*case, marks=pytest.mark.nightly)
    for place in (-1, 0)
    for case in CASES
    if case[2] not in LATER and case[:2] in (("cat215", "bucket"), ("emps", None))
    and case[3] == EFFECTS[case[2]].locations(machine_of(*case[:2]))[place]
    and (place == -1 or case[3] != EFFECTS[case[2]].locations(machine_of(*case[:2]))[-1])
]  # fmt: skip


def usual(machine, name, place, size=1.0):
    """Parameters `size` typical deviations away from those of the machine, inside their range."""
    numbers = EFFECTS[name].parameters(machine, place)
    return {k: float(np.clip(p.nominal + size * p.prior_std, p.lower_bound, p.upper_bound))
            for k, p in numbers.items()}  # fmt: skip


def test_names_and_places_are_those_agreed():
    machine = machine_of("cat215", "none")
    found = {name: set(effect.locations(machine)) for name, effect in EFFECTS.items()}
    assert {name: places for name, places in found.items() if places} == PLACES
    pumped = machine_of("eha", "load_30_bar")
    others = set(found) - set(PLACES) - SENSED - set(MERGED)
    assert {n: set(EFFECTS[n].locations(pumped)) for n in others} == PUMPED
    assert {n: set(EFFECTS[n].locations(machine_of("cat325", None))) for n in MERGED} == MERGED
    calibrator = machine_of("calibrator", None)
    own = set(calibrator.undriven_sensed_joints)  # the others are the arm's
    assert own and all(set(EFFECTS[name].locations(calibrator)) == own for name in SENSED)
    # its length is its position, and where its pins sit across the slide changes nothing
    for geometric in ("pin_offset", "length_offset"):
        assert not EFFECTS[geometric].locations(pumped)
    assert {m for m, _ in MACHINES} == set(shipped_machines())


@pytest.mark.parametrize(("machine", "tool", "name"), PLACED)
def test_sizes_are_in_order(machine, tool, name):
    effect, facts = EFFECTS[name], machine_of(machine, tool)
    assert effect.name == name and effect.description and effect.model_part in LAWS
    numbers = [effect.parameters(facts, place) for place in effect.locations(facts)]
    assert all(numbers)
    for p in (p for here in numbers for p in here.values()):
        assert p.unit and p.lower_bound <= p.nominal <= p.upper_bound and p.lower_bound < p.upper_bound
        assert 0 < p.min_relevant_change <= p.prior_std <= p.upper_bound - p.lower_bound
        assert all(p.lower_bound <= start <= p.upper_bound for start in p.start_values)
        if not p.lower_bound < p.nominal:  # one-sided: the least one must fit on the other side
            assert p.nominal + p.min_relevant_change <= p.upper_bound


@pytest.mark.parametrize(("machine", "tool", "name"), PLACED)
def test_nominal_values_change_nothing_and_others_something(machine, tool, name):
    for place in EFFECTS[name].locations(machine_of(machine, tool)):
        check_change(machine, tool, name, place)


def check_change(machine, tool, name, place):
    before = machine_of(machine, tool)
    nominal = {k: p.nominal for k, p in EFFECTS[name].parameters(before, place).items()}
    assert apply_effect(before, name, place, nominal) == before
    changed = usual(before, name, place)
    after = apply_effect(before, name, place, changed)
    assert after != before
    assert before == untouched(machine, tool), "the caller's machine is untouched"
    type(after).model_validate(after.model_dump())  # still a possible machine
    if name not in ("payload", "com_offset", "inertia_error", "base_tilt", "link_length",
                    "pin_offset", "valve_gain", "valve_gain_direction", "flow_curve", "oil_viscosity"):  # fmt: skip
        again = {k: p.nominal for k, p in EFFECTS[name].parameters(after, place).items()}
        assert again == pytest.approx(changed, rel=1e-12), "the machine shows what was set"


@pytest.mark.parametrize(("machine", "tool", "name"), PLACED)
def test_limits_belong_to_the_range(machine, tool, name):
    for place in EFFECTS[name].locations(machine_of(machine, tool)):
        check_limits(machine, tool, name, place)


def check_limits(machine, tool, name, place):
    facts = machine_of(machine, tool)
    given = usual(facts, name, place)
    for key, p in EFFECTS[name].parameters(facts, place).items():
        for value in (p.lower_bound, p.upper_bound):
            after = apply_effect(facts, name, place, given | {key: value})
            type(after).model_validate(after.model_dump())
        for value in (
            math.nextafter(p.lower_bound, -math.inf),
            p.upper_bound * 1.001 + 1e-30,
            math.nan,
        ):
            with pytest.raises(InputError, match=f"effect {name}: {key}: .* is outside"):
                apply_effect(facts, name, place, given | {key: value})


@pytest.mark.parametrize(
    ("name", "place", "given", "message"),
    [
        ("payloat", "", {"mass": 1}, "did you mean 'payload'.*bulk_modulus"),
        ("valve_gain", "bom", {"ratio": 1}, "'bom'; did you mean 'boom'"),
        ("valve_gain", "", {"ratio": 1}, "has no location ''; valid: boom, bucket, stick, swing"),
        ("payload", "boom", {"mass": 1}, "has no location 'boom'; valid: tool"),
        ("payload", "", {}, "has the parameters mass; 'mass' is missing"),
        (
            "payload",
            "",
            {"mass": 1, "colour": 2},
            "has the parameters mass; 'colour' is not one of them",
        ),
        ("base_tilt", "", {"roll": 0.1}, "has the parameters roll, pitch; 'pitch' is missing"),
        ("pressure_offset", "boom", {"offset": 1.0}, "valid: .*boom.head, boom.rod"),
    ],
)
def test_refused(name, place, given, message):
    with pytest.raises(InputError, match=message):
        apply_effect(machine_of("cat215", "bucket"), name, place, given)


def test_no_place_on_a_machine_without_oil_or_arm():
    for name in ("bulk_modulus", "valve_gain", "payload", "internal_leakage", "backlash"):
        with pytest.raises(InputError, match=r"valid: \(none\)"):
            apply_effect(machine_of("emps", None), name, "", {})


def short(machine, tool, effects=()):
    """0.2 s with every drive at half command."""
    axes = machine_of(machine, tool).axes
    commands = {a: 0.5 * (axis.force.command_limit if axis.force else 1) for a, axis in axes.items()}
    return Scenario(
        name="t", machine=machine, tool=tool, duration=0.2, ground=False, effects=tuple(effects),
        pilot={"kind": "constant", "commands": commands},
    )  # fmt: skip


@functools.cache
def plain_run(machine, tool):
    return run_scenario(short(machine, tool))


@pytest.mark.daily(
    "cat215-bucket-internal_leakage-bucket",
    "cat215-bucket-command_delay-bucket",
    "cat215-bucket-coulomb_friction-bucket",
    "cat215-bucket-link_length-bucket",
    "cat215-bucket-payload-tool",
    "cat215-bucket-angle_offset-bucket",
    "cat215-bucket-pressure_offset-bucket.rod",
    "cat215-bucket-pump_lag-supply",
    "cat215-bucket-valve_deadband-bucket",
    "cat215-bucket-spool_lag-bucket",
)
@pytest.mark.parametrize(("machine", "tool", "name", "place"), FELT)
def test_is_felt(machine, tool, name, place):
    """A machine that has it moves, or is seen, and not as the one without it."""
    given = usual(machine_of(machine, tool), name, place)
    if name == "pump_droop":  # felt only where the pump's flow is short
        given["droop"] = 0.9 * EFFECTS[name].parameters(machine_of(machine, tool), place)["droop"].upper_bound
    if name == "pump_flow_limit":  # felt only where it is less than what the valves ask for
        given["pump_flow"] = 0.3 * machine_of(machine, tool).pumps[place.removeprefix("supply.")].pump_flow
    if name == "force_pulse":  # the usual one comes after the end of this run
        given["start"] = 0.05
    planted = {"name": name, "location": place, "parameters": given}
    plain, run = plain_run(machine, tool), run_scenario(short(machine, tool, [planted]))
    seen = EFFECTS[name].model_part == "sensor"
    old, new = (plain.measured, run.measured) if seen else (plain.truth, run.truth)
    assert any(not np.array_equal(old[c], new[c]) for c in old.columns)
    assert all(np.isfinite(v).all() for v in run.truth.columns.values())
    if seen:
        assert all(np.array_equal(v, run.truth[c]) for c, v in plain.truth.columns.items())


@pytest.mark.parametrize(("machine", "tool"), MACHINES)
def test_patched_machine_is_a_file_that_runs_the_same(machine, tool, tmp_path):
    """Every effect that has a place, all at once, through save_machine and load_machine."""
    patched = machine_of(machine, tool)
    for name, effect in EFFECTS.items():
        if places := effect.locations(patched):
            place = places[-1]
            given = usual(patched, name, place, 0.5)
            patched = apply_effect(patched, name, place, given)
    save_machine(patched, tmp_path / "machine.yaml")
    loaded = load_machine(tmp_path / "machine.yaml")
    where = {
        "folder": patched.folder, "mjcf": patched.mjcf, "tools": patched.tools,
        "attached": patched.attached,
    }  # fmt: skip
    assert loaded.model_copy(update=where) == patched
    here = {"machine": str(tmp_path / "machine.yaml"), "tool": None}
    run = run_scenario(short(machine, tool).model_copy(update=here))
    assert run.plant.machine == loaded
    assert all(np.isfinite(v).all() for v in run.truth.columns.values())


NEW = """
from hydrotele.effects.effect import valve_axes
from hydrotele.effects.effect import Effect, Parameter, with_value

EFFECT = Effect(
    "sticky_makeup", "make-up valves that hardly open", "flow", valve_axes,
    lambda machine, place: {"gain": Parameter("m^3/(s Pa)", 5e-9, 0, 5e-9, 2e-9, 1e-10)},
    lambda machine, place, v: with_value(machine, f"axes.{place}.valve.makeup_gain", v["gain"]),
)
"""


def test_one_new_file_is_a_new_effect(tmp_path, monkeypatch):
    (tmp_path / "sticky_makeup.py").write_text(NEW)
    (tmp_path / "_helper.py").write_text("raise RuntimeError('helpers are not effects')")
    monkeypatch.setattr(library, "__path__", [*library.__path__, str(tmp_path)])
    found = library._discover_effects()
    monkeypatch.delitem(sys.modules, "hydrotele.effects.sticky_makeup")
    monkeypatch.setattr(library, "EFFECTS", found)
    assert found.keys() - EFFECTS.keys() == {"sticky_makeup"}
    after = apply_effect(machine_of("cat215", "none"), "sticky_makeup", "boom", {"gain": 1e-9})
    assert after.axes["boom"].valve.makeup_gain == 1e-9


@pytest.mark.parametrize(("text", "message"), [("X = 1", "neither EFFECT nor EFFECTS"), (NEW + "\n", "exists already")])
def test_an_empty_file_or_a_taken_name_is_refused(tmp_path, monkeypatch, text, message):
    (tmp_path / "zz_new.py").write_text(text.replace("sticky_makeup", "payload"))
    monkeypatch.setattr(library, "__path__", [*library.__path__, str(tmp_path)])
    with pytest.raises(RuntimeError, match=message):
        library._discover_effects()
    sys.modules.pop("hydrotele.effects.zz_new", None)


def test_every_effect_is_of_the_one_type():
    assert all(isinstance(effect, Effect) for effect in EFFECTS.values())
    assert all(name == effect.name for name, effect in EFFECTS.items())
