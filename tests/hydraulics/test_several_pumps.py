"""Several pumps: steady states by hand, limit cases, and machine files that cannot be."""

from pathlib import Path

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.hydraulics.actuator_layout import actuator_order, actuator_parameters
from hydrotele.hydraulics.circuit import FEED, Slot, circuit_scratch, solve_state_supplies
from hydrotele.hydraulics.supply import LINE_FLOW
from hydrotele.machine.machine import Engine
from hydrotele.machine.machine_file import load_machine, save_machine
from tools.validation.two_pumps import equal_pump_errors, priority_errors, steady_state_errors

FILE = Path(__file__).parents[1] / "data" / "two_pumps"
TWO = load_machine(FILE)


def test_steady_state_of_three_axes_is_that_by_hand():
    """Flows, pressures and engine power; after 10 s the transients are below 1e-9."""
    for name, (hand, simulated) in steady_state_errors().items():
        assert simulated == pytest.approx(hand, rel=1e-9), name


def test_priority_keeps_the_rated_pressure_drop():
    """Published as 2e-5 in docs/validation/two_pumps.md: the slower axis still approaches its speed after 10 s."""
    for name, (hand, simulated) in priority_errors().items():
        assert simulated == pytest.approx(hand, rel=1e-4), name


def test_equal_pumps_are_one_pump_of_double_size():
    """From rest on, with leakage, lag and override; the issue asks for 1e-9."""
    assert max(equal_pump_errors().values()) < 1e-9


def supplies(machine, act):
    """Pressure that feeds each axis [Pa], and power of all pumps [W], by axis name."""
    user, scratch = np.concatenate(list(actuator_parameters(machine).values())), circuit_scratch()
    solve_state_supplies(user, 0, len(machine.hydraulic_axes), np.array(act, float), scratch)
    return dict(zip(actuator_order(machine), scratch[FEED:], strict=False)), scratch


ACT = [1.0, 0, 9e6, 4e6, 0.6, 0, 8e6, 6e6, -0.7, 0, 5e6, 7e6]  # boom, swing, stick


def test_engine_limits_the_power_of_all_pumps():
    free, _ = supplies(TWO, ACT)
    fed, scratch = supplies(TWO.model_copy(update={"engine": Engine(power=25e3, efficiency=0.8)}), ACT)
    power = scratch[LINE_FLOW] * fed["boom"] + scratch[LINE_FLOW + 1] * fed["swing"]
    assert power == pytest.approx(20e3, rel=1e-12)
    assert all(fed[axis] < free[axis] for axis in fed)
    assert supplies(TWO.model_copy(update={"engine": Engine(power=1e9)}), ACT)[0] == free


def test_merging_moves_its_share():
    """At full travel of the boom the front line has 1.7 and the rear line 0.3 of a pump's flow."""
    _, scratch = supplies(TWO, ACT)
    assert scratch[LINE_FLOW : LINE_FLOW + 2] == pytest.approx([1.7 * 2.5e-3, 0.3 * 2.5e-3], rel=1e-12)
    stuck = apply_effect(TWO, "merging_valve", "boom", {"scale": 0.0})
    assert supplies(stuck, ACT)[1][LINE_FLOW] == 2.5e-3


def test_axes_of_a_pump_follow_one_another_and_priority_comes_first():
    assert list(TWO.hydraulic_axes) == ["boom", "swing", "stick"]
    numbers = actuator_parameters(TWO)
    assert [numbers[n][Slot.GROUP_SIZE] for n in TWO.hydraulic_axes] == [1, 2, 2]
    assert TWO.sensed_channels[-2:] == ("pressure_supply.front", "pressure_supply.rear")
    for name in ("pump_flow_limit", "pump_droop", "pump_lag", "relief_pressure"):
        assert EFFECTS[name].locations(TWO) == ("supply.front", "supply.rear")
    slow = apply_effect(TWO, "pump_flow_limit", "supply.rear", {"pump_flow": 2e-3})
    assert slow.pumps["rear"].pump_flow == 2e-3 and slow.pumps["front"].pump_flow == 2.5e-3


def test_saved_machine_is_the_same(tmp_path):
    saved = TWO.model_copy(update={"engine": Engine(power=75e3)})
    save_machine(saved, tmp_path / "machine.yaml")
    loaded = load_machine(tmp_path / "machine.yaml")
    assert (loaded.pumps, loaded.merging, loaded.engine) == (saved.pumps, saved.merging, saved.engine)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("axes: [swing, stick]", "axes: [swing]", "exactly one pump"),
        ("axes: [boom]", "axes: [boom, stick]", "exactly one pump"),
        ("priority: swing", "priority: boom", "'boom' is not known"),
        ("to_supply: front", "to_supply: rear", "must be different pumps"),
        ("to_supply: front", "to_supply: middle", "'middle' is not known"),
        ("share: [0.0, 0.7]", "share: [0.0, 1.7]", "less than or equal to 1"),
        ("travel: [0.3, 0.8]", "travel: [0.8, 0.3]", "travel must increase"),
        ("axes: [boom]", "axes: [boom], pump_droop: 1.0e-6", "supplies.front.*reduces pump_flow"),
        ("axes: [boom]", "axes: [boom], bulk_modulus: 1.0e+9", "bulk_modulus"),
        ("  front: {", "  swing: {", "neither `supply` nor an axis"),
    ],
)
def test_wrong_pumps_are_refused(old, new, message, tmp_path):
    text = (FILE / "machine.yaml").read_text()
    assert old in text
    (tmp_path / "machine.yaml").write_text(text.replace(old, new))
    with pytest.raises(InputError, match=f"(?s){message}"):
        load_machine(tmp_path)
