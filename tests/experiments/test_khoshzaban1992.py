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


def test_an_error_of_another_size_is_no_agreement():
    """A chain whose held links drift five times as much does not agree with Table 4."""
    cases = {}
    more = {
        n: s._replace(drift={k: 5.0 * d for k, d in s.drift.items()})
        for n, s in thesis.SWEEPS.items()
    }
    before = thesis.SWEEPS
    thesis.SWEEPS = more
    try:
        assert not thesis.table_4(cases, LOOP).ok
    finally:
        thesis.SWEEPS = before
