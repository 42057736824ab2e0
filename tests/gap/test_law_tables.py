"""A table over one or two variables is the term that simulates it."""

import itertools

import numpy as np
import pytest

from hydrotele.gap.law_tables import OWN_VARIABLES, Table
from hydrotele.terms.drive_state import Drives, DriveState
from hydrotele.terms.table import FORCE, encode_terms_table, sum_terms
from hydrotele.terms.term import Term

_NAMES = tuple(name for name in OWN_VARIABLES if name != "pump_speed")  # a valve drive has none
_POINTS = {1: 7, 2: 4}  # of each variable


@pytest.mark.parametrize("variables", [*itertools.combinations(_NAMES, 1), *itertools.permutations(_NAMES, 2)])
def test_every_table_is_a_term_that_adds_what_its_columns_say(variables):
    rng = np.random.default_rng(1)
    values = {name: rng.normal(size=40) for name in _NAMES}
    points = tuple(tuple(np.sort(rng.normal(size=_POINTS[len(variables)])).tolist()) for _ in variables)
    table = Table(variables, points)
    entries = rng.normal(size=table.size)
    term = Term(name="law", axis="boom", balance="force", **table.law(entries))
    written = encode_terms_table([term], ["swing", "boom"])
    columns = table.columns(values)
    assert columns.shape == (40, table.size)
    drives = Drives(2, np.zeros(8), np.zeros(2), np.zeros(2), np.zeros(2))
    for row in range(40):
        own = {name: column[row] for name, column in values.items()}
        state = DriveState(**own, spool_rate=0.0, play_output=0.0, play_difference=0.0)
        # rounding of the interpolation
        assert sum_terms(written, FORCE, 1, state, drives) == pytest.approx(columns[row] @ entries, rel=1e-9, abs=1e-12)
