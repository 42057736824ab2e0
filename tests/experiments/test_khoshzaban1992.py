"""Khoshzaban's simulations: facts of the machine, and errors in kind."""

from hydrotele.calibrate.loop import loop_of
from hydrotele.experiments import khoshzaban1992 as thesis
from hydrotele.machine.machine_file import load_machine

MACHINE = load_machine("calibrator")
LOOP = loop_of(MACHINE)


def test_facts_of_the_machine():
    for found in (thesis.plates(MACHINE), thesis.triangles(MACHINE), thesis.mobility(LOOP),
                  thesis.chain(LOOP), thesis.pressure_errors(MACHINE)):  # fmt: skip
        assert found.ok, found.simulated


def test_tables_4_to_6_in_kind():
    """Four seeds; the command takes twenty."""
    cases = {}
    for found in (thesis.without_errors(cases, LOOP), thesis.table_4(cases, LOOP),
                  thesis.table_5(cases, LOOP, 4), thesis.table_6(cases, LOOP, 4),
                  thesis.iterations(cases)):  # fmt: skip
        assert found.ok, found.simulated


def test_held_links_that_stay_still_are_no_agreement(monkeypatch):
    """Without drift Table 4 does not come out."""
    monkeypatch.setattr(thesis, "SWEEPS", thesis.STILL)
    assert not thesis.table_4({}, LOOP).ok
