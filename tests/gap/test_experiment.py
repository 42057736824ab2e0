"""Proposed experiments: they run, stay inside the machine's ranges, and do what they are for."""

import functools

import numpy as np
import pytest
import yaml

from hydrotele.effects import EFFECTS
from hydrotele.gap.experiment import MOTIONS, OF_EFFECT, OF_LAW, next_experiment
from hydrotele.kinematics.arm import forward_kinematics
from hydrotele.kinematics.arm_dimensions import arm_geometry
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario

CAT = load_machine("cat215")
EXAMPLES = {  # motion -> two effects that it separates
    "sweeps": (("pin_offset", "boom"), ("length_offset", "boom")),
    "steps": (("command_delay", "stick"), ("spool_lag", "stick")),
    "shakes": (("backlash", "swing"), ("joint_flexibility", "swing")),
    "reversals": (("coulomb_friction", "boom"), ("viscous_friction", "boom")),
    "poses": (("payload", "tool"), ("com_offset", "stick")),
    "slews": (("base_tilt", "base"),),
    "stairs": (("bulk_modulus", "all"), ("hose_compliance", "stick")),
    "holds": (("internal_leakage", "boom"),),
    "surges": (("pump_flow_limit", "supply"), ("relief_pressure", "supply")),
}


@functools.cache
def run(machine, effects, folder):
    """The run of a proposed experiment, through a file as a user would."""
    proposed = next_experiment(load_machine(machine), "Open.", effects)
    assert proposed["reason"].startswith("Open. ")
    path = folder / f"{proposed['scenario']['name']}.yaml"
    path.write_text(yaml.safe_dump(proposed["scenario"]))
    return run_scenario(load_scenario(path))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("experiments")


def test_every_effect_and_every_law_has_a_motion():
    assert OF_EFFECT.keys() == EFFECTS.keys()
    assert OF_LAW.keys() >= {effect.model_part for effect in EFFECTS.values()}
    used = {name for names in (*OF_EFFECT.values(), *OF_LAW.values()) for name in names}
    assert used == MOTIONS.keys() == EXAMPLES.keys()


@pytest.mark.daily("poses", "steps")
@pytest.mark.parametrize("motion", EXAMPLES)
def test_experiment_runs_inside_the_ranges_and_above_the_ground(motion, folder):
    done = run("cat215", EXAMPLES[motion], folder)
    assert done.scenario.duration < 180.0 and not done.plan.notes
    truth = done.truth
    for name in CAT.axes:
        low, high = CAT.joints[name].range or (-np.inf, np.inf)
        angle = truth[f"angle.{name}"]
        assert low < angle.min() and angle.max() < high, name
    geometry = arm_geometry(CAT)
    poses = np.column_stack([truth[f"angle.{a}"] for a in ("swing", "boom", "stick")])
    # 0.4 m are planned; servos overshoot and ways between two poses bend.
    assert min(forward_kinematics(geometry, q)[2] for q in poses[::10]) > 0.1


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("machine", "effects"),
    [
        ("emps", (("viscous_friction", "slide"), ("command_delay", "slide"))),
        ("rig", (("hose_compliance", "slide"), ("bulk_modulus", "all"))),
        ("ec20", (("valve_deadband", "boom"), ("command_delay", "all"))),
    ],
)
def test_experiment_runs_on_other_machines(machine, effects, folder):
    done = run(machine, effects, folder)
    facts = load_machine(machine)
    assert not done.plan.notes
    for axis, facts_of_axis in facts.axes.items():
        channel = f"{facts.position_kind(axis)}.{axis}"
        low, high = facts.joints[facts_of_axis.joint].range
        assert low <= done.truth[channel].min() and done.truth[channel].max() <= high
        assert np.ptp(done.truth[channel]) > 0.02 * (high - low)


@pytest.mark.parametrize("effects", [(("force", "boom"),), (("flow", "stick"),), (), (("x", "y"),)])
def test_unknown_effects_get_motions_too(effects, tmp_path):
    proposed = next_experiment(CAT, "", effects)
    path = tmp_path / "scenario.yaml"
    path.write_text(yaml.safe_dump(proposed["scenario"]))
    moved = load_scenario(path).pilot.columns  # type: ignore[union-attr]
    # The stick's whole stroke is free with the boom at home.
    assert set(moved) == ({"stick"} if ("flow", "stick") in effects else set(CAT.axes))


def test_only_the_axes_in_question_move():
    proposed = next_experiment(CAT, "", EXAMPLES["steps"])
    assert set(proposed["scenario"]["pilot"]["columns"]) == {"stick"}
    head = next_experiment(CAT, "", [("pressure_delay", "boom"), ("spool_lag", "boom")])
    assert set(head["scenario"]["pilot"]["columns"]) == {"boom"}


def test_steps_have_sharp_edges_of_several_sizes(folder):
    command = run("cat215", EXAMPLES["steps"], folder).measured["command.stick"]
    jumps = np.abs(np.diff(command))
    # A sixth of the valve's range from one row to the next; slow motions change by a hundredth.
    assert (jumps > 0.15).sum() >= 12
    assert np.ptp(np.log10(jumps[jumps > 0.15])) > 0.3


@pytest.mark.nightly
def test_reversals_creep_and_run(folder):
    run_ = run("cat215", EXAMPLES["reversals"], folder)
    speed = np.abs(run_.truth["truth.velocity.boom"])
    limit = speed.max()
    for low, high in ((0.01, 0.07), (0.07, 0.25), (0.25, 1.01)):
        share = np.mean((speed > low * limit) & (speed <= high * limit))
        assert share > 0.05, (low, high)


def test_sweep_covers_the_stroke(folder):
    length = run("cat215", EXAMPLES["sweeps"], folder).truth["length.boom"]
    # The ground takes the lower half of the boom's range, even with the stick drawn in.
    assert np.ptp(length) > 0.5 * CAT.axes["boom"].cylinder.stroke


@pytest.mark.nightly
def test_stairs_fill_and_empty_the_chambers(folder):
    length = run("cat215", EXAMPLES["stairs"], folder).truth["length.stick"]
    assert np.ptp(length) > 0.6 * CAT.axes["stick"].cylinder.stroke


def test_surge_reaches_both_limits_of_the_supply(folder):
    supply = run("cat215", EXAMPLES["surges"], folder).truth["pressure_supply"]
    relief = CAT.supply.relief_pressure
    # At rest the pump's flow goes over the relief valve; with all axes running it does not.
    assert np.mean(supply > 0.999 * relief) > 0.1 and np.mean(supply < 0.9 * relief) > 0.03


def test_holds_rest_with_closed_valves(folder):
    done = run("cat215", EXAMPLES["holds"], folder)
    command, deadband = done.measured["command.boom"], CAT.axes["boom"].valve.deadband
    closed = np.abs(command) < deadband
    assert closed.mean() > 0.5
    assert abs(np.diff(np.percentile(done.truth["length.boom"], [20, 80]))[0]) > 0.1
