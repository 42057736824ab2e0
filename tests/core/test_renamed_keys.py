"""Keys that files had in earlier versions: refused, and the message names the present key."""

import dataclasses

import pytest

from hydrotele.calibrate.hybrid_measurement import SensorNoise
from hydrotele.core.datafile import StrictModel, validate_data
from hydrotele.core.errors import InputError
from hydrotele.identify.mechanism import ColumnMapping
from hydrotele.machine.drives import ElectricMotor, LoadCylinder
from hydrotele.machine.joystick import AxisGains, Detent, Joystick
from hydrotele.scenario.pilots import TablePilot
from hydrotele.scenario.scenario import load_scenario
from hydrotele.scenario.surrounding_objects import LogOnGround, StandingTree
from hydrotele.scenario.teleoperation import (
    ButtonCommand,
    Channel,
    OperatorSettings,
    SafetyLimits,
    SensorFault,
    TeleopPilot,
    TipOver,
)
from hydrotele.teleop.case_file import ImpedanceRange, MapRange, StiffnessFeedbackAxis, TeleopCaseFile
from hydrotele.teleop.operator_parameters import ArmParameters, Operator
from hydrotele.terms.term import Term

STIFFNESS = "nominal: nominal_stiffness, least: min_stiffness, most: max_stiffness"
RENAMED = {
    StandingTree: "kerf: cut_height, energy: cutting_energy, closed: closed_angle",
    LogOnGround: "closed: closed_angle, open: open_angle",
    TablePilot: "of: quantity",
    Channel: "lost: loss_probability, lost_from: loss_start",
    SafetyLimits: "silence: packet_timeout, frozen: frozen_time",
    TipOver: "behind: centre_of_mass_behind, edge: tipping_edge, share: moment_fraction",
    SensorFault: "at: start",
    ButtonCommand: "at: start",
    TeleopPilot: "coordinating: coordinating_position, wave: wave_impedance",
    OperatorSettings: (
        "drawn: sample, reaction: visual_delay, skill: max_crossover_frequency, force_noise: force_weber,"
        " crossover: max_crossover_frequency, placing_margin: positioning_margin, sight: visual_threshold,"
        " sight_noise: display_noise, touch: haptic_delay, muscle: handle_position_gain, largest_force: max_force,"
        " usual_speed: expected_speed, usual_scale: expected_scale, surprise: new_gain_log_std,"
        " memory: memory_time, imagination: unfelt_gain_std, dwell: correction_interval"
    ),
    ArmParameters: "usual: reference_posture",
    StiffnessFeedbackAxis: STIFFNESS,
    AxisGains: STIFFNESS,
    Detent: "outside: slope",
    Joystick: "alone: closed_loop",
    MapRange: "longest_delay: max_delay, least_factor: min_factor, most_factor: max_factor",
    ImpedanceRange: "least: min, most: max",
    TeleopCaseFile: "wave: wave_impedance",
    ElectricMotor: "emf: torque_constant",
    LoadCylinder: "override: relief_override, void: unfilled_travel, void_pressure: air_pressure",
    ColumnMapping: "alike: equal_parameters, absent: zero_parameters, uncertainty: relative_uncertainty",
    SensorNoise: "slide: prismatic, turn: revolute",
    Term: "of: variables_from",
}
CASES = [(model, *pair.split(": ")) for model, pairs in RENAMED.items() for pair in pairs.split(", ")]


@pytest.mark.parametrize(("model", "old", "new"), CASES, ids=[f"{m.__name__}.{old}" for m, old, _ in CASES])
def test_a_former_key_is_refused_and_the_present_one_named(model: type[StrictModel], old: str, new: str):
    assert new in model.model_fields and old not in model.model_fields
    with pytest.raises(InputError) as refused:
        validate_data(model, {old: 1.0}, "my.yaml", {(): 1})
    assert str(refused.value) == f"my.yaml:1: (top): unknown key {old!r}: it is now called {new!r}"


def test_a_former_key_keeps_its_unit_and_its_place_in_the_file(tmp_path):
    path = tmp_path / "old.yaml"
    path.write_text(
        "name: old\nduration: 2.0\npilot:\n  kind: teleop\n  operator: {kind: follow}\n  safety: {silence_ms: 150}\n"
    )
    with pytest.raises(InputError) as refused:
        load_scenario(path)
    where = f"{path}:6: pilot.teleop.safety"
    assert str(refused.value) == f"{where}: unknown key 'silence_ms': it is now called 'packet_timeout_ms'"


def test_a_setting_with_a_former_key_is_refused():
    with pytest.raises(InputError, match="unknown key 'drawn': it is now called 'sample'"):
        load_scenario("steer", {"pilot.perception.drawn": "3"})


def test_every_parameter_of_the_operator_has_a_name_that_is_not_a_former_one():
    names = {field.name for field in dataclasses.fields(Operator)}
    former = {old for old in OperatorSettings.renamed if old != "drawn"}
    present = {OperatorSettings.renamed[old] for old in former} | {"cocontraction_stiffness_factor"}
    assert not former & names and present <= names
