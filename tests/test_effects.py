"""Each effect changes what it says and nothing else, everywhere it can sit."""

import functools
import math

import mujoco
import numpy as np
import pytest

from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.errors import InputError
from hydrotele.machine_file import load_machine, save_machine, shipped_machines
from hydrotele.run import run_scenario
from hydrotele.scenario import Scenario
from hydrotele.simulate.plant import build_plant, rest_state

MACHINES = [("cat215", "none"), ("cat215", "bucket"), ("rig", None), ("ec20", None), ("emps", None)]

# Numbers of the machine that each effect may change, as paths; {a} is the location, {d} its drive.
CHANGES = {
    "payload": {
        f"links.payload.{k}" for k in ("parent", "position", "joint", "mass", "com", "inertia")
    },
    "coulomb_friction": {"axes.{a}.{d}.friction.coulomb"},
    "viscous_friction": {"axes.{a}.{d}.friction.viscous"},
    "stribeck_friction": {"axes.{a}.{d}.friction.stribeck_extra"},
    "valve_deadband": {"axes.{a}.valve.deadband"},
    "valve_gain": {"axes.{a}.valve.rated_flow"},
    "spool_lag": {"axes.{a}.valve.bandwidth"},
    "internal_leakage": {"axes.{a}.{d}.leakage"},
    "bulk_modulus": {"supply.bulk_modulus"},
    "pump_flow_limit": {"supply.pump_flow"},
    "relief_pressure": {"supply.relief_pressure"},
}
CASES = [
    (machine, tool, name, place)
    for machine, tool in MACHINES
    for name, effect in EFFECTS.items()
    for place in effect.locations(load_machine(machine, tool))
]


def middle(name: str) -> dict[str, float]:
    """Values well inside the range of every parameter, and no machine's own."""
    return {k: p.low + 0.317 * (p.high - p.low) for k, p in EFFECTS[name].parameters.items()}


def numbers(data, path="") -> dict[str, object]:
    """A machine as path -> value, lists as wholes."""
    if not isinstance(data, dict):
        return {path: data}
    found = {}
    for key, value in data.items():
        found |= numbers(value, f"{path}.{key}" if path else key)
    return found


@pytest.mark.parametrize(("machine", "tool", "name", "place"), CASES)
def test_changes_what_it_says_and_nothing_else(machine, tool, name, place):
    before = load_machine(machine, tool)
    after = apply_effect(before, name, place, middle(name))
    assert before == load_machine(machine, tool)  # the caller's machine is untouched
    old, new = numbers(before.model_dump()), numbers(after.model_dump())
    assert old.keys() <= new.keys()
    changed = {path for path in new if path not in old or old[path] != new[path]}
    drive = "".join(d for d in ("cylinder", "motor", "force")
                    if place in before.axes and getattr(before.axes[place], d))  # fmt: skip
    assert changed and changed <= {p.format(a=place, d=drive) for p in CHANGES[name]}


def test_every_effect_is_listed_here():
    assert CHANGES.keys() == EFFECTS.keys()
    for name, effect in EFFECTS.items():
        assert effect.name == name and effect.sentence
        for parameter in effect.parameters.values():
            assert parameter.low < parameter.high and parameter.unit


@pytest.mark.parametrize("name", EFFECTS)
def test_values_are_taken_as_given(name):
    """All but the gain put their number itself into the machine."""
    machine, given = load_machine("cat215"), middle(name)
    place = EFFECTS[name].locations(machine)[0]
    new = numbers(apply_effect(machine, name, place, given).model_dump())
    old, value = numbers(machine.model_dump()), next(iter(given.values()))
    if name == "payload":
        assert new["links.payload.mass"] == value
        return
    path = next(p for p in new if new[p] != old[p])
    if name == "valve_gain":
        assert new[path] == old[path] * value
    else:
        assert new[path] == value


def test_limits_belong_to_the_range():
    machine = load_machine("cat215", "bucket")
    for name, effect in EFFECTS.items():
        place = effect.locations(machine)[0]
        for key, p in effect.parameters.items():
            apply_effect(machine, name, place, {key: p.low})
            apply_effect(machine, name, place, {key: p.high})
            for value in (math.nextafter(p.low, -math.inf) or -1e-300, p.high * 1.001, math.nan):
                with pytest.raises(InputError, match=f"effect {name}: {key}: .* is outside"):
                    apply_effect(machine, name, place, {key: value})


@pytest.mark.parametrize(
    ("name", "place", "given", "message"),
    [
        ("payloat", "", {"mass": 1}, "did you mean 'payload'.*bulk_modulus"),
        ("valve_gain", "bom", {"ratio": 1}, "'bom'; did you mean 'boom'"),
        ("valve_gain", "", {"ratio": 1}, "cannot sit at ''; valid: boom, bucket, stick, swing"),
        ("payload", "boom", {"mass": 1}, "cannot sit at 'boom'; valid: tool"),
        ("payload", "", {}, "exactly the parameters mass"),
        ("payload", "", {"mass": 1, "colour": 2}, "exactly the parameters mass: 'colour'"),
    ],
)
def test_refused(name, place, given, message):
    with pytest.raises(InputError, match=message):
        apply_effect(load_machine("cat215", "bucket"), name, place, given)


def test_no_place_on_a_machine_without_oil_or_arm():
    emps = load_machine("emps")
    for name in ("bulk_modulus", "valve_gain", "payload", "internal_leakage"):
        given = middle(name)
        with pytest.raises(InputError, match=r"valid: \(none\)"):
            apply_effect(emps, name, "", given)


def short(machine, tool, effects=()):
    """0.4 s with every drive at half command."""
    axes = load_machine(machine, tool).axes
    commands = {
        a: 0.5 * (axis.force.command_limit if axis.force else 1) for a, axis in axes.items()
    }
    return Scenario(
        name="t", machine=machine, tool=tool, duration=0.4, ground=False, effects=tuple(effects),
        pilot={"kind": "constant", "commands": commands},
    )  # fmt: skip


@functools.cache
def plain_run(machine, tool):
    return run_scenario(short(machine, tool))


@pytest.mark.parametrize(("machine", "tool", "name", "place"), CASES)
def test_is_felt(machine, tool, name, place):
    """A machine that has it moves, and not as the one without it."""
    given = middle(name)
    if name == "pump_flow_limit":  # felt only where it is less than what the valves ask for
        given["pump_flow"] = 0.3 * load_machine(machine, tool).supply.pump_flow
    planted = {"name": name, "location": place, "parameters": given}
    plain = plain_run(machine, tool).truth
    moved = run_scenario(short(machine, tool, [planted])).truth
    assert any(not np.array_equal(plain[c], moved[c]) for c in plain.columns)
    assert all(np.isfinite(v).all() for v in moved.columns.values())


@pytest.mark.parametrize(("machine", "tool"), MACHINES)
def test_patched_machine_is_a_file_that_runs_the_same(machine, tool, tmp_path):
    """Every effect that has a place, all at once, through save_machine and load_machine."""
    nominal = load_machine(machine, tool)
    planted = [
        {"name": n, "location": e.locations(nominal)[-1], "parameters": middle(n)}
        for n, e in EFFECTS.items() if e.locations(nominal)
    ]  # fmt: skip
    first = run_scenario(short(machine, tool, planted))
    save_machine(first.plant.machine, tmp_path / "machine.yaml")
    loaded = load_machine(tmp_path / "machine.yaml")
    where = {"folder": first.plant.machine.folder, "mjcf": first.plant.machine.mjcf}
    names = {"tools": first.plant.machine.tools}
    assert loaded.model_copy(update=where | names) == first.plant.machine
    scenario = short(machine, tool).model_copy(
        update={"machine": str(tmp_path / "machine.yaml"), "tool": None}
    )
    again = run_scenario(scenario)
    assert all(np.array_equal(v, again.truth[c]) for c, v in first.truth.columns.items())


@pytest.mark.parametrize("tool", ["none", "bucket"])
def test_payload_is_a_mass_welded_to_the_tip(tool):
    """Mass matrix of the loaded machine: that of the empty one plus `m J^T J` of the tip.

    1e-6 of the largest added entry: the radius of gyration of 1 mm that a body must have.
    """
    machine, mass = load_machine("cat215", tool), 1234.5
    loaded = apply_effect(machine, "payload", "tool", {"mass": mass})
    inertia, loads = [], []
    for one in (machine, loaded):
        plant = build_plant(one, ground=False)
        data = rest_state(plant)
        mujoco.mj_forward(plant.model, data)
        full = np.zeros((plant.model.nv, plant.model.nv))
        mujoco.mj_fullM(plant.model, data, full)
        inertia.append(full)
        loads.append(data.qfrc_bias.copy())
        jac = np.zeros((3, plant.model.nv))
        mujoco.mj_jacSite(plant.model, data, jac, None, plant.model.site("tip").id)
    added = mass * jac.T @ jac
    np.testing.assert_allclose(inertia[1] - inertia[0], added, atol=1e-6 * added.max())
    weight = mass * 9.81 * jac[2]
    np.testing.assert_allclose(loads[1] - loads[0], weight, atol=1e-9 * np.abs(weight).max())


def test_payloads_add_up():
    machine = load_machine("cat215")
    once = apply_effect(machine, "payload", "", {"mass": 500.0})
    first = apply_effect(machine, "payload", "", {"mass": 200.0})
    assert apply_effect(first, "payload", "", {"mass": 300.0}) == once
    for nothing in (0.0, 5e-324):
        assert apply_effect(machine, "payload", "", {"mass": nothing}) == machine


def test_machines_here_are_the_shipped_ones():
    assert {m for m, _ in MACHINES} == set(shipped_machines())
