"""Drives with a gap or a spring: statics, the way through the gap, stiff friction, convergence."""

import json
import math

import mujoco
import numpy as np
import pytest

from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.effects.transmission import load_inertia, raise_to_resolvable_inertia
from hydrotele.hydraulics.circuit import SLOT_COUNT, actuator_friction, implicit_friction
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.replay import replay_log
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario
from hydrotele.simulate.closed_loops import holding_forces, independent_dofs
from hydrotele.simulate.plant import build_plant, initial_state, rest_state
from hydrotele.simulate.record import positions_one_step_earlier, start_leapfrog

MACHINE = load_machine("cat215")
GAP = 0.02


def with_gap(gap=GAP, machine=MACHINE):
    return apply_effect(machine, "backlash", "swing", {"gap": gap})


def joint_mass(machine, joint):
    """Entry of the mass matrix of a joint at home."""
    plant = build_plant(machine, ground=False)
    data = rest_state(plant)
    mujoco.mj_forward(plant.model, data)
    full = np.zeros((plant.model.nv, plant.model.nv))
    mujoco.mj_fullM(plant.model, data, full)
    dof = plant.model.joint(joint).dofadr[0]
    return full[dof, dof]


def test_the_rotor_takes_its_inertia_from_the_link():
    machine = with_gap()
    whole = joint_mass(MACHINE, "swing")
    rotor, load = joint_mass(machine, "swing_drive"), joint_mass(machine, "swing")
    # 1e-6: the speck of mass that MuJoCo asks for
    assert rotor + load == pytest.approx(whole, rel=1e-6)
    assert rotor == pytest.approx(machine.axes["swing"].transmission.inertia, rel=1e-6)
    # without tubes and rods, which turn with the house too: 400 kg of 10 t, half-way out
    assert load_inertia(MACHINE, "swing") == pytest.approx(whole, rel=0.1)
    assert rotor == pytest.approx(0.03 * load_inertia(MACHINE, "swing"), rel=1e-6)


def test_the_rotor_crosses_the_gap_before_the_load_moves():
    """From the middle, driven one way: half a gap alone, then both, a whole gap on reversal."""
    plant = build_plant(with_gap(), ground=False)
    data = rest_state(plant)
    rotor, ring = plant.drive_qpos[0], plant.qpos[0]
    assert data.qpos[rotor] == pytest.approx(data.qpos[ring], abs=1e-15)
    start_leapfrog(plant.model, data)
    lead, load, alone = [], [], True
    for step in range(4000):
        data.ctrl[0] = 0.4 if step < 2000 else -0.4
        mujoco.mj_step(plant.model, data)
        q = positions_one_step_earlier(plant.model, data)
        lead.append(q[rotor] - q[ring])
        load.append(q[ring])
        if alone and lead[-1] < GAP / 2:
            # inside the gap only the damper carries the load along, by a small part of the gap
            assert abs(load[-1]) < 0.15 * GAP
        else:
            alone = False
    assert not alone
    assert lead[1900] == pytest.approx(GAP / 2, rel=0.05), "teeth closed, wound up a little"
    assert lead[-1] == pytest.approx(-GAP / 2, rel=0.05)
    # 0.5 rad/s onto teeth on which the rotor swings with 40 Hz: wound up by 2 mrad
    assert max(np.abs(lead)) < GAP / 2 + 2.5e-3
    assert load[1999] > 0.1


def test_backlash_shows_between_port_and_resolver():
    """The motor swallows oil for rotor and ring; over one reversal they differ by the gap."""
    plant = build_plant(with_gap(), ground=False)
    data = rest_state(plant)
    start_leapfrog(plant.model, data)
    lead = []
    for sign in (1, -1, 1):
        data.ctrl[0] = 0.4 * sign
        mujoco.mj_step(plant.model, data, nstep=1500)
        lead.append(data.qpos[plant.drive_qpos[0]] - data.qpos[plant.qpos[0]])
    assert np.diff(lead) == pytest.approx([-GAP, GAP], rel=0.05)


@pytest.mark.parametrize("compliance", [5e-9, 2e-8, 7e-8])
def test_a_flexible_cylinder_gives_by_force_times_compliance(compliance):
    """At rest: piston minus rod end = F c, held by the same pressures as the rigid one's.

    1e-6 of the deflection is below the rounding of the closed loops.
    """
    machine = apply_effect(MACHINE, "joint_flexibility", "boom", {"compliance": compliance})
    plant = build_plant(machine, ground=False)
    data = rest_state(plant)
    i = plant.axes.index("boom")
    rod = data.qpos[plant.model.joint("boom_rod").qposadr[0]]
    force = holding_forces(machine, plant.model, data)[i]
    assert force > 50e3
    assert data.qpos[plant.rod_qpos[i]] - rod == pytest.approx(force * compliance, rel=1e-6)
    rigid = build_plant(MACHINE, ground=False)
    still = rest_state(rigid)
    np.testing.assert_allclose(data.act, still.act, rtol=1e-9)
    mujoco.mj_forward(plant.model, data)
    mujoco.mj_forward(rigid.model, still)
    # it stands: what accelerates is the softness of the pins, as on the rigid machine
    assert np.abs(data.qacc).max() < 1.5 * np.abs(still.qacc).max()
    assert list(independent_dofs(machine, plant.model)) == sorted(plant.dof)


def test_a_spring_may_be_shaped_by_its_drives_inertia_and_damping():
    """Left out, they are what the library takes; with the compliance none, nothing changes."""
    plain = apply_effect(MACHINE, "joint_flexibility", "swing", {"compliance": 1e-7})
    usual = plain.axes["swing"].transmission
    ratio = usual.damping / (2.0 * math.sqrt(usual.stiffness * usual.inertia))
    values = {"compliance": 1e-7, "drive_inertia": 0.5 * usual.inertia, "damping_ratio": 3 * ratio}
    shaped = apply_effect(MACHINE, "joint_flexibility", "swing", values).axes["swing"].transmission
    assert (shaped.stiffness, shaped.backlash) == (usual.stiffness, 0.0)
    assert shaped.inertia == pytest.approx(0.5 * usual.inertia)
    assert shaped.damping == pytest.approx(3 * math.sqrt(0.5) * usual.damping)
    rigid = apply_effect(MACHINE, "joint_flexibility", "swing", {**values, "compliance": 0.0})
    assert rigid == MACHINE


@pytest.mark.parametrize("compliance", [2e-8, 3e-7, 1e-6])
def test_a_drive_as_heavy_as_usual_need_not_be_stated(compliance):
    """The rig's rod, 3 kg, is lighter than what its oil can be stepped with: 23 kg, then usual."""
    machine = load_machine("rig")
    table = EFFECTS["joint_flexibility"].parameters(machine, "slide")
    least = raise_to_resolvable_inertia(machine, "slide", 0.0, 0.0)
    assert table["drive_inertia"].nominal == table["drive_inertia"].lower_bound == least > 20.0
    given = {"compliance": compliance}
    stated = {**given, **{key: table[key].nominal for key in ("drive_inertia", "damping_ratio")}}
    short, long = (apply_effect(machine, "joint_flexibility", "slide", v) for v in (given, stated))
    assert short == long


@pytest.mark.parametrize("frequency", [20.0, 80.0])
def test_teeth_ring_with_the_frequency_of_their_contact(frequency):
    teeth = apply_effect(
        MACHINE, "backlash", "swing", {"gap": GAP, "contact_frequency": frequency}
    ).axes["swing"].transmission  # fmt: skip
    assert math.sqrt(teeth.stiffness / teeth.inertia) == pytest.approx(2 * math.pi * frequency)


def test_length_reads_the_piston_and_angle_the_load():
    """Half-open valve: length minus what the angle says is the deflection under the load."""
    effect = {"name": "joint_flexibility", "location": "boom", "parameters": {"compliance": 3e-8}}
    pilot = {"kind": "constant", "commands": {"boom": 0.3}}
    run = run_scenario(Scenario(name="t", machine="cat215", duration=1.0, ground=False,
                                pilot=pilot, effects=[effect]))  # fmt: skip
    plant, truth = run.plant, run.truth
    rigid = build_plant(MACHINE, ground=False)
    force = truth["truth.force.boom"]
    for row in (30, 40, 49):
        pose = {a: truth[f"angle.{a}"][row] for a in ("swing", "boom", "stick")}
        length = rest_state(rigid, pose).qpos[rigid.rod_qpos[1]]
        # 10 %: the piston's own acceleration and the damper
        given = truth["length.boom"][row] - length
        assert given == pytest.approx(3e-8 * force[row], rel=0.1)
    assert plant.rod_qpos[1] == plant.drive_qpos[1]
    balance = run.summary["balance"]
    # the bounds of runs on the rigid machine: oil and energy get lost in no spring
    assert balance["flow_balance"] < 1e-4 and balance["energy_balance"] < 1e-4


def test_a_run_with_a_gap_replays_from_its_initial_state():
    effect = {"name": "backlash", "location": "swing", "parameters": {"gap": GAP}}
    pilot = {"kind": "constant", "commands": {"swing": 0.5}}
    run = run_scenario(Scenario(name="t", machine="cat215", duration=1.0, control_rate=50,
                                ground=False, pilot=pilot, effects=[effect]))  # fmt: skip
    state = json.loads(run.truth.metadata["initial_state"])
    assert state["drive"].keys() == state["drive_velocity"].keys() == {"swing"}
    replay = replay_log(run.truth, run.plant.machine)
    np.testing.assert_allclose(replay.simulated["angle.swing"], run.truth["angle.swing"],
                               rtol=1e-12, atol=1e-15)  # fmt: skip
    moved = initial_state(run.plant, state | {"drive": {"swing": 0.123}})
    assert moved.qpos[run.plant.drive_qpos[0]] == 0.123


def motion(machine, timestep, seconds=3.0):
    """Joint positions every 20 ms of a machine with all valves worked."""
    plant = build_plant(machine, timestep, ground=False)
    data = rest_state(plant)
    start_leapfrog(plant.model, data)
    rows = []
    for row in range(round(seconds / 0.02)):
        rows.append(positions_one_step_earlier(plant.model, data)[plant.qpos])
        data.ctrl[:] = 0.35 * np.sin(1.5 * 0.02 * row * np.array([1.7, 2.3, 2.9][: len(data.ctrl)]))
        mujoco.mj_step(plant.model, data, nstep=round(0.02 / timestep))
    return np.array(rows)


@pytest.mark.daily("cat215-joint_flexibility-boom-given1", "rig-joint_flexibility-slide-given4")
@pytest.mark.parametrize(
    ("name", "effect", "place", "given"),
    [
        ("cat215", "backlash", "swing", {"gap": 0.01}),
        ("cat215", "joint_flexibility", "boom", {"compliance": 2e-8}),
        ("cat215", "joint_flexibility", "stick", {"compliance": 5e-9}),
        ("ec20", "joint_flexibility", "stick", {"compliance": 3e-8}),
        ("rig", "joint_flexibility", "slide", {"compliance": 3e-7}),
    ],
)
def test_one_millisecond_resolves_it(name, effect, place, given):
    """1 ms against 0.25 ms: as near as the rigid machine is (3e-5 rad, a fortieth of a reading)."""
    machine = apply_effect(load_machine(name), effect, place, given)
    coarse, fine = motion(machine, 1e-3), motion(machine, 2.5e-4)
    assert np.sqrt(np.mean((coarse - fine) ** 2, axis=0)).max() < 3e-5
    assert np.ptp(fine, axis=0).min() > 0.01


def test_a_light_rod_on_stiff_seals_settles():
    """Friction of 9e5 N s/m on 100 kg: an explicit step would throw it to and fro at 500 Hz."""
    machine = apply_effect(MACHINE, "joint_flexibility", "stick", {"compliance": 3e-8})
    machine = apply_effect(machine, "coulomb_friction", "stick", {"coulomb": 15000.0})
    plant = build_plant(machine, ground=False)
    data = rest_state(plant)
    start_leapfrog(plant.model, data)
    data.ctrl[2] = 0.3
    mujoco.mj_step(plant.model, data, nstep=500)
    data.ctrl[2], speeds = 0.0, []
    for _ in range(1500):
        mujoco.mj_step(plant.model, data)
        speeds.append(data.qvel[plant.drive_dof[2]])
    assert np.abs(speeds[1000:]).max() < 5e-3
    assert np.abs(np.diff(speeds[1000:])).max() < 1e-5


def test_settled_friction_is_that_of_the_new_velocity():
    plant = build_plant(MACHINE, ground=False)
    user = plant.model.actuator_user.ravel()
    u, dt = 1 * SLOT_COUNT, 1e-3
    for inertia in (10.0, 100.0, 1e6):
        for v in (-0.3, -1e-3, 0.0, 2e-3, 0.5):
            for push in (-50e3, -1e3, 0.0, 4e3, 200e3):
                force = implicit_friction(user, u, v, push, inertia, dt)
                new = v + dt / inertia * (push - force)
                assert force == pytest.approx(actuator_friction(user, u, new), rel=1e-6, abs=1e-6 * (1 + abs(push)))
                if push == 0.0:
                    assert abs(new) <= abs(v) and new * v >= 0.0, "friction never turns a motion"


def test_effects_of_one_transmission_combine_in_any_order():
    gap, spring = ("backlash", {"gap": GAP}), ("joint_flexibility", {"compliance": 2e-7})
    results = []
    for order in ((gap, spring), (spring, gap)):
        machine = MACHINE
        for name, given in order:
            machine = apply_effect(machine, name, "swing", given)
        results.append(machine)
    for machine in results:
        facts = machine.axes["swing"].transmission
        assert facts.backlash == GAP and facts.stiffness == pytest.approx(1 / 2e-7)
        assert math.isclose(facts.inertia, results[0].axes["swing"].transmission.inertia)


def test_a_tiny_gap_or_spring_is_none():
    assert with_gap(1e-9) == MACHINE
    assert apply_effect(MACHINE, "joint_flexibility", "boom", {"compliance": 1e-12}) == MACHINE
