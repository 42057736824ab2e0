"""Valves, chambers, pump and relief valve change the flows and pressures that they should."""

import mujoco
import numpy as np
import pytest

from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.hydraulics.circuit import ACTIVATIONS_PER_AXIS
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.plant import build_plant, rest_state
from hydrotele.simulate.true_values import compute_state_flows_and_forces

BOOM = 1  # place of the boom among the axes of the CAT 215
NOMINAL = load_machine("cat215")


def flows(machine, spool):
    """Supply pressure, and flow into the head side of the boom, with its spool held there."""
    plant = build_plant(machine, ground=False)
    data = rest_state(plant)
    data.act[ACTIVATIONS_PER_AXIS * BOOM] = spool
    count = plant.hydraulic
    user = plant.model.actuator_user.ravel()
    table = compute_state_flows_and_forces(user, count, data.act[None], np.full((1, count), 0.5), np.zeros((1, count)))
    return table[0, 0], table[0, 4 * BOOM + 1]


def pressure_rate(machine, velocity=0.0, difference=0.0):
    """Rate of the boom's head pressure with its valve closed [Pa/s], over the first microsecond."""
    plant = build_plant(machine, timestep=1e-6, ground=False)
    data = rest_state(plant)
    data.act[ACTIVATIONS_PER_AXIS * BOOM + 2] = data.act[ACTIVATIONS_PER_AXIS * BOOM + 3] + difference
    data.qvel[plant.drive_dof[BOOM]] = velocity
    mujoco.mj_forward(plant.model, data)
    x = data.qpos[plant.rod_qpos[BOOM]]
    return data.act_dot[ACTIVATIONS_PER_AXIS * BOOM + 2], float(x)


def test_gain_scales_the_flow():
    wide = apply_effect(NOMINAL, "valve_gain", "boom", {"ratio": 1.25})
    assert flows(wide, 0.3)[1] == pytest.approx(1.25 * flows(NOMINAL, 0.3)[1], rel=1e-12)


def test_dead_band_moves_the_opening():
    """Flow goes as (s - d) / (1 - d) of the opening; inside the band there is none."""
    tight = apply_effect(NOMINAL, "valve_deadband", "boom", {"deadband": 0.1})
    assert flows(tight, 0.09)[1] == 0.0 < flows(NOMINAL, 0.09)[1]
    ratio = (0.3 - 0.1) / 0.9 / ((0.3 - 0.04) / 0.96)
    assert flows(tight, 0.3)[1] == pytest.approx(ratio * flows(NOMINAL, 0.3)[1], rel=1e-12)


def test_a_slow_spool_follows_on_a_slower_clock():
    """Half the bandwidth: the same step response, stretched by two.

    1e-6: `spool_step` promises 1e-8 a step.
    """
    slow = apply_effect(NOMINAL, "spool_lag", "boom", {"bandwidth": NOMINAL.axes["boom"].valve.bandwidth / 2})
    responses = []
    for machine in (NOMINAL, slow):
        plant = build_plant(machine, ground=False)
        data = rest_state(plant)
        data.ctrl[BOOM], spool = 0.5, []
        for _ in range(200):
            mujoco.mj_step(plant.model, data)
            spool.append(data.act[ACTIVATIONS_PER_AXIS * BOOM])
        responses.append(np.array(spool))
    np.testing.assert_allclose(responses[1][1::2], responses[0][:100], atol=1e-6)


def test_leakage_flows_from_side_to_side():
    """Extra rate = - beta / V times extra leakage times pressure difference.

    1e-4: over the microsecond the pressure itself changes.
    """
    more, dp = 5e-11, 10e6
    leaky = apply_effect(NOMINAL, "internal_leakage", "boom", {"leakage": 2e-12 + more})
    (rate, x), (nominal, _) = pressure_rate(leaky, 0.0, dp), pressure_rate(NOMINAL, 0.0, dp)
    volume = NOMINAL.axes["boom"].cylinder.chamber_volumes(np.array(x))[0]
    stiffness = NOMINAL.supply.bulk_modulus / volume
    assert rate - nominal == pytest.approx(-stiffness * more * dp, rel=1e-4)


def test_spool_leakage_leaves_for_the_tank():
    """Extra rate = - beta / V times leakage times pressure above tank; 1e-4 as above."""
    leak = 2e-11
    leaky = apply_effect(NOMINAL, "tank_leakage", "boom", {"leakage": leak})
    (rate, x), (nominal, _) = pressure_rate(leaky), pressure_rate(NOMINAL)
    volume = NOMINAL.axes["boom"].cylinder.chamber_volumes(np.array(x))[0]
    plant = build_plant(NOMINAL, ground=False)
    above = rest_state(plant).act[ACTIVATIONS_PER_AXIS * BOOM + 3] - NOMINAL.supply.tank_pressure
    wanted = -NOMINAL.supply.bulk_modulus / volume * leak * above
    assert rate - nominal == pytest.approx(wanted, rel=1e-4)


def test_hoses_and_oil_soften_the_chamber():
    """dp/dt = - A v / (V / beta + C); 1e-4 as above."""
    v, soft = 0.2, 2e-11
    cylinder, beta = NOMINAL.axes["boom"].cylinder, NOMINAL.supply.bulk_modulus
    hosed = apply_effect(NOMINAL, "hose_compliance", "boom", {"compliance": soft})
    airy = apply_effect(NOMINAL, "bulk_modulus", "all", {"bulk_modulus": 0.5 * beta})
    for machine, modulus, hose in ((NOMINAL, beta, 0.0), (hosed, beta, soft),
                                   (airy, 0.5 * beta, 0.0)):  # fmt: skip
        rate, x = pressure_rate(machine, v)
        volume = cylinder.chamber_volumes(np.array(x))[0]
        wanted = -cylinder.area_head * v / (volume / modulus + hose)
        assert rate == pytest.approx(wanted, rel=1e-4)


def test_supply_stops_at_its_relief_setting_and_pump_flow():
    low = apply_effect(NOMINAL, "relief_pressure", "supply", {"relief_pressure": 20e6})
    assert flows(low, 0.0)[0] == 20e6
    weak = apply_effect(NOMINAL, "pump_flow_limit", "", {"pump_flow": 1e-3})
    supply, flow = flows(weak, 1.0)
    assert flow == pytest.approx(1e-3, rel=1e-9) and supply < 28e6
    assert flows(NOMINAL, 1.0)[1] > 2e-3


def test_the_viscosity_of_the_oil_acts_on_all_drives():
    """Viscous friction is proportional to the viscosity, laminar leakage to its reciprocal."""
    ratio = 0.7
    warm = apply_effect(NOMINAL, "oil_viscosity", "all", {"ratio": ratio})
    for name, axis in NOMINAL.axes.items():
        viscous, leakage = axis.drive.friction.viscous, axis.hydraulic_drive.leakage
        assert viscous > 0.0 and leakage > 0.0
        assert warm.axes[name].drive.friction.viscous == pytest.approx(ratio * viscous)
        assert warm.axes[name].hydraulic_drive.leakage == pytest.approx(leakage / ratio)
    same = apply_effect(warm, "oil_viscosity", "all", {"ratio": 1.0})
    assert same == warm, "a ratio is relative to the given machine"
    emps = load_machine("emps")  # no oil
    assert EFFECTS["oil_viscosity"].locations(emps) == ()
