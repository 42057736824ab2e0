"""The workflow on public records of real machines; a full run is `tools/real_machines.py`."""

from pathlib import Path

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.gap.dataset import load_dataset
from hydrotele.gap.find import find_gap
from hydrotele.gap.levels import find_levels
from hydrotele.gap.stretches import busiest
from hydrotele.machine_file import load_machine
from tools.real_machines import force_error, velocity_fit

REAL = Path(__file__).resolve().parents[3] / "shared" / "real"
pytestmark = pytest.mark.skipif(not REAL.is_dir(), reason="../shared/real is absent")


def test_emps_names_friction_that_depends_on_the_direction():
    machine = load_machine("emps")
    data = load_dataset(REAL / "emps" / "main.parquet", machine)
    gap = find_gap(data)
    (effect,) = gap.effects
    assert (gap.verdict, effect.name) == ("named", "friction_asymmetry")
    # published: 166.7 and 240.4 N s/m, which differ by 0.181 of their mean
    found = effect.parameters["viscous_asymmetry"]
    assert found.low < (166.7 - 240.4) / (166.7 + 240.4) < found.high
    assert gap.size.noise_floor is None  # the encoder's accuracy is not stated
    assert gap.size.after < 0.6 * gap.size.before
    # published 4.08 % before and 3.11 % after, all samples fitted; here none of these was
    assert force_error(machine, data.heldout, 20.0) > 3.5
    assert force_error(gap.patched, data.heldout, 20.0) < 3.2


def test_ec20_names_delay_and_dead_band_of_a_valve_without_them():
    """Two minutes of the record, and the effects in question with their nearest rivals."""
    machine = load_machine("ec20")
    for axis in ("boom", "stick"):
        machine = apply_effect(machine, "valve_deadband", axis, {"deadband": 0.0})
    data = busiest(load_dataset(REAL / "volvo_ec20" / "long.parquet", machine), 120.0)
    names = ("command_delay", "valve_deadband", "valve_gain", "spool_lag", "viscous_friction")
    gap = find_gap(data, effects=names)
    found = {(e.name, e.location): e for e in gap.effects}
    delay = found["command_delay", "all"].parameters["delay"].value
    assert 0.12 <= delay <= 0.22  # the band that the issue states for boom and stick
    assert ("valve_deadband", "boom") in found
    judged = find_levels(data)
    before, after = (velocity_fit(m, judged, 2.0) for m in (machine, gap.patched))
    assert after["boom"] > before["boom"] + 12.0


def test_long_records_are_cut_to_where_the_commands_change():
    data = load_dataset(REAL / "emps" / "main.parquet", load_machine("emps"))
    short = busiest(data, 6.0)
    (run,), (whole,) = short.fit, data.fit
    assert len(run.command) == 6000 and short.heldout is data.heldout
    first = round((run.start - whole.start) / run.period)
    assert np.array_equal(run.reading, whole.reading[first : first + 6000])
    assert any("fitted from" in note for note in short.notes)
    assert busiest(data, 60.0) is data
