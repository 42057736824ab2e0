"""Channel names, units and their limits."""

import ast
import doctest
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hydrotele.core import errors
from hydrotele.core.errors import InputError
from hydrotele.machine import log_channels

AXES = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)


def test_doctests_run():
    assert doctest.testmod(log_channels).failed == 0


def test_imports_nothing_of_ours():
    tree = ast.parse(Path(str(log_channels.__file__)).read_text())
    names = [alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names]
    names += [str(n.module) for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    assert not [name for name in names if name.startswith("hydrotele")]


@given(
    st.booleans().flatmap(
        lambda t: st.tuples(
            st.sampled_from(list(log_channels.TRUTH_KINDS if t else log_channels.MEASURED_KINDS)), st.just(t)
        )
    ),
    AXES,
)
def test_every_kind_survives_naming_and_parsing(kind_and_truth, axis):
    kind, truth = kind_and_truth
    axes = (log_channels.TRUTH_KINDS if truth else log_channels.MEASURED_KINDS)[kind].axes
    axis = {"free": axis, "optional": axis, "xyz": "z", "none": ""}[axes]
    name = log_channels.channel_name(kind, axis, truth=truth)
    assert log_channels.parse_channel(name) == (kind, axis, truth)
    assert log_channels.parse_channel(name).name == name
    assert log_channels.default_channel_unit(name) in log_channels.allowed_channel_units(name)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("angel.boom", "angle.boom"),
        ("boom.angle", "angle.boom"),
        ("angle_boom", "angle.boom"),
        ("Angle.Boom", "angle.boom"),
        ("presure_head.stick", "pressure_head.stick"),
        ("truth.flowhead.boom", "truth.flow_head.boom"),
        ("supply_pressure", "pressure_supply"),
        ("position", "position.boom"),
        ("angle.Boom", "lower case"),
        ("angle.boom.x", "lower case"),
        ("time.boom", "write time"),
        ("valid.boom", "write valid"),
        ("truth.tip.w", "x, y and z"),
        ("truth.command.boom", "truth.flow_head.<axis>"),
        ("acceleration.boom", "truth.acceleration.<axis>"),
        ("", "angle.<axis>"),
    ],
)
def test_a_wrong_name_is_answered_with_the_right_one(name, hint):
    with pytest.raises(ValueError, match=".") as caught:
        log_channels.parse_channel(name)
    assert hint in str(caught.value)


@given(st.text(max_size=30))
def test_any_text_parses_or_is_a_value_error(name):
    log_channels.suggest_channel_names(name)
    try:
        assert log_channels.parse_channel(name).name == name
    except ValueError:
        pass


@pytest.mark.parametrize(
    ("name", "units"),
    [
        ("command.boom", ("1", "V", "N")),
        ("angle.swing", ("rad",)),
        ("position.carriage", ("m",)),
        ("pressure_supply", ("Pa",)),
        ("velocity.joint1", ("rad/s", "m/s")),
        ("force.slide", ("N",)),
        ("truth.force.swing", ("N", "N m")),
        ("truth.acceleration.boom", ("rad/s^2", "m/s^2")),
        ("truth.contact_force.x", ("N",)),
        ("truth.object_contact.tree_0_x", ("N",)),
        ("truth.flow_supply", ("m^3/s",)),
    ],
)
def test_allowed_units(name, units):
    assert log_channels.allowed_channel_units(name) == units


def test_usual_unit_follows_the_joint():
    assert log_channels.default_channel_unit("reference.slide") == "rad"
    assert log_channels.default_channel_unit("reference.slide", ["position.slide"]) == "m"
    assert log_channels.default_channel_unit("truth.velocity.slide", ["truth.position.slide"]) == "m/s"
    assert log_channels.default_channel_unit("command.slide", ["position.slide"]) == "1"


def test_limits_are_wider_where_the_unit_is_stated():
    for unit in ("rad", "rad/s", "m", "m/s", "Pa", "N"):
        stated = log_channels.plausible_magnitude_limits("angle.boom", unit)
        unstated = log_channels.plausible_magnitude_limits("angle.boom", unit, stated=False)
        assert stated.min_magnitude <= unstated.min_magnitude
        assert stated.max_magnitude >= unstated.max_magnitude


def test_input_error_says_where_and_survives_pickling():
    import pickle

    error = InputError("a.csv, row 3", "is NaN: remove the row")
    assert str(error) == "a.csv, row 3: is NaN: remove the row"
    copy = pickle.loads(pickle.dumps(error))
    assert (copy.where, copy.message) == (error.where, error.message)
    assert issubclass(errors.InputError, ValueError)
