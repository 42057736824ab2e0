"""Laws: values by hand, refusals that teach, and compiled calls that no wrong table can harm."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine, Supply
from hydrotele.machine.machine_file import load_machine
from hydrotele.terms import law as laws
from hydrotele.terms.drive_state import NO_DRIVES, VARIABLES, Drives, DriveState
from hydrotele.terms.law import LAWS, encode_formula, law
from hydrotele.terms.table import (
    ANY_DRIVE,
    COMMAND,
    FLOW_HEAD,
    FLOW_ROD,
    FLOW_SUPPLY,
    FORCE,
    NO_TERMS,
    encode_terms_table,
    has_term,
    sum_flow_terms,
    sum_terms,
    sum_terms_with_slope,
    update_term_state,
)
from hydrotele.terms.term import Play, Term

STATE = DriveState(
    time=1.7, position=0.43, velocity=-0.21, spool=0.3, spool_rate=-2.0, pressure_head=9.0e6,
    pressure_rod=4.0e6, pressure_supply=2.0e7, command=0.4, force=1.2e5,
    play_output=0.0, play_difference=0.0,
)  # fmt: skip
USED = {
    "constant": {"value": 12.0},
    "pulse": {"size": 5.0, "start": 1.6, "duration": 1.0, "edge": 0.4},
    "ramp": {"rate": 3.0, "start": 0.2},
    "exponential_drift": {"value": 7.0, "time_constant": 2.0},
    "linear_table": {"variable": "velocity", "points": [-1, -0.2, 0.5], "values": [4, 1, -2]},
    "bilinear_table": {
        "row_variable": "position", "column_variable": "velocity", "row_points": [0, 0.5, 1],
        "column_points": [-1, 0], "values": [[1, 2], [3, 5], [7, 11]],
    },
    "scaled_table": {
        "variable": "position", "points": [0.0, 0.5], "values": [-1.0, -6.0], "product": "sign(velocity, 0.1)",
    },
    "formula": {"1": 2.0, "velocity * abs(velocity)": -3.0, "above(position, 0.4) ** 2": 1e3},
    "quadratic_drag": {"coefficient": 40.0},
    "load_friction": {"coefficient": 0.04, "smoothing_velocity": 0.1},
    "friction_bump": {"coulomb": 900.0, "centre": 0.5, "width": 0.1, "smoothing_velocity": 0.1},
    "orifice_leakage": {"flow_gain": 1e-8, "smoothing": 5e4},
    "viscous_drift": {"viscous": 6e3, "ratio": 0.4, "time_constant": 3.0},
    "leakage_drift": {"leakage": 2e-12, "ratio": 0.4, "time_constant": 3.0},
}  # fmt: skip


def force_term(law, parameters, **more):
    return Term(name="t", axis="a", balance="force", law=law, parameters=parameters, **more)


def by_hand(name, p):
    """Every law written anew, with NumPy."""
    s, warm = STATE, 1 - math.exp(-1.7 / 3.0)
    drop, m = s.pressure_head - s.pressure_rod, 1 - 0.6 * warm
    return {
        "constant": 12.0,
        "pulse": 5.0 * 0.5 * (1 + math.sin(math.pi / 2 * 0.1 / 0.2)),
        "ramp": 3.0 * 1.5,
        "exponential_drift": 7.0 * (1 - math.exp(-0.85)),
        "linear_table": np.interp(-0.21, [-1, -0.2, 0.5], [4, 1, -2]),
        "bilinear_table": 0.14 * (0.21 * 1 + 0.79 * 2) + 0.86 * (0.21 * 3 + 0.79 * 5),
        "scaled_table": (1.0 + 5.0 * 0.86) * math.tanh(2.1),
        "formula": 2.0 + 3.0 * 0.21**2 + 1e3 * 0.03**2,
        "quadratic_drag": 40.0 * 0.21**2,
        "load_friction": 0.04 * 1.2e5 * math.tanh(2.1),
        "friction_bump": 900.0 * math.exp(-0.5 * 0.7**2) * math.tanh(2.1),
        "orifice_leakage": 1e-8 * math.sqrt(drop),
        "viscous_drift": 6e3 * (m - 1) * 0.21,
        "leakage_drift": 2e-12 * (1 / m - 1) * drop,
    }[name]


def test_every_law_of_the_package_is_tried_here():
    assert {name for name, known in LAWS.items() if not known.source} == set(USED)


@pytest.mark.parametrize("name", USED)
def test_compiled_laws_are_those_by_hand(name):
    table = encode_terms_table([force_term(name, USED[name])], ["a"])
    # smoothing of the orifice over its pressure drop squared: 1e-4 / 4
    assert sum_terms(table, FORCE, 0, STATE, NO_DRIVES) == pytest.approx(by_hand(name, USED[name]), rel=3e-5)
    assert sum_terms(table, FORCE, 1, STATE, NO_DRIVES) == 0.0, "another axis"
    assert sum_terms(table, FLOW_ROD, 0, STATE, NO_DRIVES) == 0.0, "another balance"
    assert sum_terms(NO_TERMS, FORCE, 0, STATE, NO_DRIVES) == 0.0


@pytest.mark.parametrize("text", [
    "sign(velocity, 0.1)", "root(pressure_head - pressure_rod, 2e6)", "bump(position, 0.5, 0.2)",
    "below(position, 0.9)", "rise(time, 2.0)", "sin(position, 0.3)", "cos(position, 0.3) ** 3",
    "abs(velocity) * command * spool_rate", "force ** 2 * pressure_supply",
])  # fmt: skip
def test_basic_functions_of_formulas(text):
    s, tanh, sin, cos, exp = STATE._asdict(), math.tanh, math.sin, math.cos, math.exp
    functions = {
        "sign": lambda e, w: tanh(e / w), "root": lambda e, d: e / (e * e + d * d) ** 0.25,
        "bump": lambda e, c, w: exp(-((e - c) ** 2) / (2 * w * w)),
        "below": lambda e, a: max(0, a - e), "rise": lambda e, t: 1 - exp(-e / t),
        "sin": lambda e, n: sin(2 * math.pi * e / n), "cos": lambda e, n: cos(2 * math.pi * e / n),
        "abs": abs,
    }  # fmt: skip
    table = encode_terms_table([force_term("formula", {text: -2.5})], ["a"])
    expected = -2.5 * eval(text, functions, s)
    assert sum_terms(table, FORCE, 0, STATE, NO_DRIVES) == pytest.approx(expected, rel=1e-12)
    assert expected != 0.0


def test_terms_add_up_and_know_their_slopes():
    terms = [
        force_term("quadratic_drag", {"coefficient": 40.0}),
        force_term("constant", USED["constant"]),
    ]
    value, slope = sum_terms_with_slope(encode_terms_table(terms, ["a"]), FORCE, 0, STATE, NO_DRIVES)
    assert value == pytest.approx(12.0 + 40.0 * 0.21**2)
    assert slope == pytest.approx(-80.0 * 0.21, rel=1e-4)  # a forward difference of 1e-6
    leak = [
        Term(name="t", axis="a", balance=b, law="orifice_leakage",
             parameters={"flow_gain": k, "smoothing": 1e3})
        for b, k in (("flow_rod", 1e-8), ("flow_head", -1e-8))
    ]  # fmt: skip
    head, rod, by_head, by_rod = sum_flow_terms(encode_terms_table(leak, ["a"]), 0, STATE, NO_DRIVES)
    assert -head == rod == pytest.approx(1e-8 * math.sqrt(5e6))
    exact = -0.5e-8 / math.sqrt(5e6)
    assert [by_head, by_rod] == pytest.approx([exact, exact], rel=1e-4)  # differences of 100 Pa


def test_balances_and_drives_that_terms_act_on():
    terms = [
        Term(name="t", axis=axis, balance=balance, law="constant", parameters={"value": 1.0})
        for axis, balance in (("a", "force"), ("b", "flow_rod"), ("b", "force"))
    ]
    table = encode_terms_table(terms, ["a", "b", "c"])
    told = {
        (balance, drive)
        for balance in (FORCE, FLOW_HEAD, FLOW_ROD, COMMAND, FLOW_SUPPLY)
        for drive in (0, 1, 2, ANY_DRIVE)
        if has_term(table, balance, drive)
    }
    assert told == {
        (FORCE, 0),
        (FORCE, 1),
        (FORCE, ANY_DRIVE),
        (FLOW_ROD, 1),
        (FLOW_ROD, ANY_DRIVE),
    }
    assert not has_term(NO_TERMS, FORCE, ANY_DRIVE)


def test_beyond_its_domain_a_variable_counts_with_the_nearer_end():
    law_ = ("formula", {"velocity": 1.0, "position": 10.0})
    bounded = force_term(*law_, domain={"velocity": (-0.1, 0.1), "position": (0.0, 1.0)})
    table = encode_terms_table([bounded], ["a"])
    assert sum_terms(table, FORCE, 0, STATE, NO_DRIVES) == pytest.approx(-0.1 + 4.3)
    assert sum_terms(table, FORCE, 0, STATE._replace(velocity=0.05), NO_DRIVES) == pytest.approx(0.05 + 4.3)


def test_with_a_window_a_term_acts_for_a_while():
    table = encode_terms_table([force_term("constant", {"value": 4.0}, window=(2.0, 3.0))], ["a"])
    at = {t: sum_terms(table, FORCE, 0, STATE._replace(time=t), NO_DRIVES)
          for t in (1.9, 1.975, 2.0, 2.5, 3.0, 3.1)}  # fmt: skip
    assert list(at.values()) == pytest.approx([0.0, 1.0, 2.0, 4.0, 2.0, 0.0])
    with pytest.raises(ValidationError, match=r"window: \[3, 2\] must be increasing"):
        force_term("constant", {"value": 1.0}, window=(3.0, 2.0))


def test_a_law_may_see_variables_of_another_drive():
    law_ = ("formula", {"velocity": 1.0, "pressure_rod": 1e-6, "position": 10.0})
    term = force_term(*law_, variables_from={"velocity": "b", "pressure_rod": "b"}, domain={"velocity": (0, 2)})
    drives = Drives(2, np.arange(8.0) * 1e6, np.array([0.1, 0.2]), np.array([-0.3, 0.5]), np.zeros(2))
    table = encode_terms_table([term], ["a", "b"])
    assert sum_terms(table, FORCE, 0, STATE, drives) == pytest.approx(0.5 + 7.0 + 4.3)
    faster = drives._replace(velocity=np.array([0.0, 3.0]))
    assert sum_terms(table, FORCE, 0, STATE, faster) == pytest.approx(2.0 + 7.0 + 4.3)
    assert sum_terms_with_slope(table, FORCE, 0, STATE, drives)[1] == 0.0, "not its own velocity"
    lone = force_term(*law_, variables_from={"velocity": "b"})
    assert sum_terms(encode_terms_table([lone], ["a", "b"]), FORCE, 0, STATE, NO_DRIVES) == 4.0 + 4.3
    with pytest.raises(ValidationError, match="variables_from: 'time'"):
        force_term(*law_, variables_from={"time": "b"})


def test_a_law_may_see_the_force_of_another_drive():
    term = force_term("formula", {"force": 2.0}, variables_from={"force": "b"})
    act = np.array([0.0, 0.0, 9e6, 9e6, 0.0, 0.0, 3e6, 1e6])
    drives = Drives(2, act, np.zeros(2), np.zeros(2), np.zeros(2))
    table = encode_terms_table([term], ["a", "b"], areas={"a": (1.0, 1.0), "b": (0.01, 0.006)})
    assert sum_terms(table, FORCE, 0, STATE, drives) == pytest.approx(2.0 * (30e3 - 6e3))
    none = drives._replace(count=1)
    assert sum_terms(table, FORCE, 0, STATE, none) == 0.0, "b has no chambers"


def carried(term, values):
    """What a term of axis a remembers along values of its variable."""
    table, held, told = encode_terms_table([term], ["a"], 4), 0.0, []
    for value in values:
        held = update_term_state(table, 0, value, held)
        told.append(held)
    return table, told


def test_a_play_follows_half_a_width_behind():
    play = {"variable": "velocity", "half_width": 0.2}
    term = force_term("formula", {"play_output": 10.0, "velocity": 1.0}, play=play)
    table, told = carried(term, [0.1, 0.5, 0.4, 0.2, 0.0, -0.3])
    assert 0.2 * np.array(told) == pytest.approx([0.0, 0.3, 0.3, 0.3, 0.2, -0.1])
    drives = Drives(1, np.array([0.0, 0, 0, 0, 1.5]), np.zeros(1), np.zeros(1), np.zeros(1))
    assert sum_terms(table, FORCE, 0, STATE, drives) == pytest.approx(10.0 * 0.3 - 0.21)
    assert sum_terms(table, FORCE, 0, STATE, NO_DRIVES) == pytest.approx(-0.21), "nothing keeps it"
    other, _ = carried(force_term("formula", {"play_difference": 10.0}, play=play), [])
    assert sum_terms(other, FORCE, 0, STATE, drives) == pytest.approx(10.0 * (-0.21 - 0.3))
    place_at = 13
    table[place_at] = 1e9  # as anyone may write it into a model
    assert sum_terms(table, FORCE, 0, STATE, drives) == pytest.approx(-0.21)


@pytest.mark.parametrize(
    ("on", "off", "values", "shares"),
    [
        (8.0, 4.0, [0, 6, 9, 6, 5, 3, 6], [0, 0, 1, 1, 1, 0, 0]),
        (4.0, 8.0, [9, 6, 3, 6, 7, 9, 6], [0, 0, 1, 1, 1, 0, 0]),
        (8.0, 4.0, [0, 8, 8.1, 7, 4, 3.9], [0, 0.5, 0.75, 0.75, 0.5, 0.25]),  # over 0.4 around each
    ],
)
def test_a_switch_has_a_hysteresis(on, off, values, shares):
    switch = {"variable": "spool", "on": on, "off": off}
    table, told = carried(force_term("constant", {"value": 5.0}, switch=switch), values)
    assert told == pytest.approx(shares)
    for share in shares:
        act = np.array([0.0, 0, 0, 0, share])
        drives = Drives(1, act, np.zeros(1), np.zeros(1), np.zeros(1))
        assert sum_terms(table, FORCE, 0, STATE, drives) == pytest.approx(5.0 * share)


def test_memories_that_cannot_be_are_refused():
    play, switch = (
        {"variable": "spool", "half_width": 0.1},
        {"variable": "spool", "on": 1, "off": 0},
    )
    for memory, message in (
        ({"play": play, "switch": switch}, "a term can have only one of them"),
        ({"play": play | {"half_width": 0.0}}, "greater than 0"),
        ({"play": play | {"variable": "play_output"}}, "play: 'play_output' is not a variable"),
        ({"switch": switch | {"variable": "sppol"}}, "did you mean 'spool'"),
        ({"switch": switch | {"off": 1}}, "they must be different"),
    ):
        with pytest.raises(ValidationError, match=message):
            force_term("constant", {"value": 1.0}, **memory)
    emps = load_machine("emps")
    term = Term(name="t", axis="slide", balance="force", law="constant", parameters={"value": 1.0},
                play=Play(variable="velocity", half_width=0.1))  # fmt: skip
    with pytest.raises(ValidationError, match="needs a machine with hydraulic axes"):
        Machine.model_validate(emps.model_dump() | {"terms": [term.model_dump()]})


def test_a_wrong_place_or_the_place_of_another_law_adds_nothing():
    """As in a file that another process has exported."""
    table = encode_terms_table([force_term("constant", {"value": 12.0})], ["a"])
    law_at, checksum_at = 4, 5
    assert sum_terms(table, FORCE, 0, STATE, NO_DRIVES) == 12.0
    for place in (-1.0, 500.0, 1023.0, 1024.0, 1e9, -1e9):
        wrong = table.copy()
        wrong[law_at] = place
        assert sum_terms(wrong, FORCE, 0, STATE, NO_DRIVES) == 0.0
    wrong = table.copy()
    wrong[checksum_at] += 1
    assert sum_terms(wrong, FORCE, 0, STATE, NO_DRIVES) == 0.0


@pytest.mark.parametrize(
    ("law_", "parameters", "message"),
    [
        ("puls", {}, "law 'puls' is not known; did you mean 'pulse'"),
        ("pulse", {"size": 1.0}, "law pulse: missing parameters start, duration"),
        ("constant", {"value": 1.0, "vlaue": 2.0}, "parameter 'vlaue'; did you mean 'value'"),
        ("constant", {"value": [1.0, 2.0]}, "must be a finite number, not"),
        ("constant", {"value": "much"}, "must be a finite number, not 'much'"),
        ("linear_table", {"variable": "speed", "points": [0, 1], "values": [0, 1]},
         "'speed' is not a variable; .*valid: command"),
        ("linear_table", {"variable": "velocity", "points": [0, 1, 1], "values": [0, 1, 2]},
         "must be at least two increasing numbers"),
        ("linear_table", {"variable": "velocity", "points": [0, 1], "values": [0, 1, 2]},
         "values must have as many numbers as points, 2"),
        ("bilinear_table", USED["bilinear_table"] | {"values": [1.0, 2.0]}, "must be 3 rows of 2 numbers"),
        ("table2", USED["bilinear_table"], "law 'table2' is not known; it is now called 'bilinear_table'"),
        ("formula", {"played": 1.0}, "'played' is not a variable; it is now called 'play_output'"),
        ("linear_table", {"variable": "ahead", "points": [0, 1], "values": [0, 1]},
         "'ahead' is not a variable; it is now called 'play_difference'"),
        ("load_friction", {"coefficient": 0.02, "smoothing_velocity": 0.0}, "smoothing_velocity must be positive"),
        ("exponential_drift", {"value": 1.0, "time_constant": -1.0}, "time_constant must be positive, not -1.0"),
        ("formula", {}, "at least one product"),
        ("formula", {"velocity +": 1.0}, "it cannot be parsed"),
        ("formula", {"speed": 1.0}, "'speed' is not a variable"),
        ("formula", {"velocity ** 9": 1.0}, "whole number from 1 to 6"),
        ("formula", {"bump(position, 0.1)": 1.0}, r"the function is bump\(e, c, w\)"),
        ("formula", {"sign(velocity, 0)": 1.0}, "must be positive"),
        ("formula", {"__import__('os')": 1.0}, "is not a function; .*abs"),
        ("formula", {"velocity": "fast"}, "the coefficient 'fast' is not a number"),
        ("formula", {"velocity" + "*velocity" * 20000: 1.0}, "it has 180008 characters, at most 1000"),
        ("formula", {"velocity" + "*velocity" * 90: 1.0, "-" * 900 + "velocity": 1.0},
         "(is not a variable|nested too deeply)"),
        ("formula", {"(" * 400 + "velocity" + ")" * 400: 1.0}, "cannot be parsed|nested too deeply"),
        ("formula", {"bump(position, {[]: 1}, 1)": 1.0},
         r"'\{\[\]: 1\}' is not a number from -1e\+20 to 1e\+20"),
        ("formula", {f"bump(position, {'9' * 400}, 1)": 1.0}, "'9+' is not a number from -1e"),
        ("formula", {f"bump(position, {'9' * 5000}, 1)": 1.0}, "it has 5019 characters"),
        ("formula", {"bump(position, 1e999, 1)": 1.0}, "'1e999' is not a number from -1e"),
        ("formula", {"velocity ** True": 1.0}, "whole number from 1 to 6"),
        ("formula", {"velocity ** [1]": 1.0}, "whole number from 1 to 6"),
        ("formula", {"\0": 1.0}, "it cannot be parsed"),
        ("formula", {"velocity": 10**400}, "finite number|valid"),
    ],
)  # fmt: skip
def test_refused_with_what_is_valid(law_, parameters, message):
    with pytest.raises(ValidationError, match=message):
        force_term(law_, parameters)


@pytest.mark.parametrize(("machine", "axis"), [("emps", "slide"), ("eha", "piston"), ("cat215", "boom")])
def test_a_flow_of_the_pump_needs_valves_and_a_pump_that_gives_so_much(machine, axis):
    facts = load_machine(machine)
    term = Term(name="more", axis=axis, balance="flow_supply", law="constant",
                parameters={"value": 1e-4})  # fmt: skip
    if machine == "cat215":
        Machine.model_validate({**dict(facts), "terms": (term,)})
        held = Supply(kind="constant_pressure", relief_pressure=2e7, tank_pressure=0.0,
                      bulk_modulus=1e9)  # fmt: skip
        facts = facts.model_copy(update={"supply": held})
    with pytest.raises(ValueError, match="flow_supply adds to|has no chambers for"):
        Machine.model_validate({**dict(facts), "terms": (term,)})


def test_domains_are_checked():
    with pytest.raises(ValidationError, match="domain: 'speed' is not a variable; .*velocity"):
        force_term("constant", {"value": 1.0}, domain={"speed": (0.0, 1.0)})
    with pytest.raises(ValidationError, match="must be increasing"):
        force_term("constant", {"value": 1.0}, domain={"velocity": (1.0, 0.0)})


def test_a_taken_name_or_an_unknown_kind_of_argument_is_refused():
    def constant(s, value):
        return value

    def odd(s, value: dict):
        return 0.0

    with pytest.raises(InputError, match="already defined by hydrotele"):
        law(constant)
    with pytest.raises(InputError, match="not float, Variable or Numbers"):
        law(odd)
    assert LAWS["constant"].function is laws.constant


def test_a_power_may_be_written_as_a_decimal_number():
    assert encode_formula({"velocity ** 2.0": 1.0}) == encode_formula({"velocity ** 2": 1.0})
    assert encode_formula({"bump(position, -0.5, 1)": 1.0})["numbers"][-3:] == [-0.5, 1.0, 1]


def test_formulas_have_as_many_numbers_as_they_say():
    numbers = encode_formula({"1": 1.0, "velocity * sin(position - velocity, 2)": 2.0})
    assert numbers["numbers"] == [
        2, 1.0, 0, 2.0, 2,
        0, VARIABLES["velocity"], -1, 0.0, 0.0, 1,
        8, VARIABLES["position"], VARIABLES["velocity"], 2.0, 0.0, 1,
    ]  # fmt: skip
