"""Zhu's chapters 1 to 5 and 6.1.3: quotations, items, broken runs of the rows that take no time."""

import re
from pathlib import Path

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.experiments import zhu_identification, zhu_theory
from hydrotele.experiments.comparison import merge_settings
from hydrotele.experiments.zhu_identification import measure_outliers, simulate_sensor_failures
from hydrotele.logs.log import Log

EXPERIMENTS = (*zhu_theory.EXPERIMENTS, *zhu_identification.EXPERIMENTS)
CLAIMS = {claim.name: (one, claim) for one in EXPERIMENTS for claim in one.claims}
DRAWINGS = zhu_theory.DRAWINGS | zhu_identification.DRAWINGS
SEED = Path(__file__).parents[3] / "shared" / "seeds" / "zhu1994_teleoperation.txt"
EXPECTED_TO_DIFFER = {"force feed-forward error of 5 %", "rate control: damping of the master"}
ITEMS = (
    *((2, n) for n in (7, 8, 9)), *((1, n) for n in range(1, 7)),
    *((3, n) for n in range(10, 23)), *((4, n) for n in range(23, 30)),
    *((5, n) for n in range(30, 35)), *((6, n) for n in range(35, 45)),
)  # fmt: skip
"""Figures 1.1 to 6.44 of the document's list, as chapter and number."""


def bare(text: str) -> str:
    """Without white space, of which the scanned text has too much within words."""
    return re.sub(r"\s+", "", text)


@pytest.mark.parametrize("name", [n for n, (_, c) in CLAIMS.items() if '"' in c.quote])
def test_quotations_are_in_the_document(name):
    if not SEED.is_file():
        pytest.skip("the thesis is not beside the repository")
    text = bare(SEED.read_text(encoding="utf-8")).lower()
    for part in re.findall(r'"([^"]+)"', CLAIMS[name][1].quote):
        assert bare(part).lower() in text, part


def named_figures(item: str) -> set[tuple[int, int]]:
    """Figures of an item; `6.37-6.40` names all between."""
    found = set()
    for words in re.findall(r"Figs? ([\d., -]+)", item):
        for first, last in re.findall(r"(\d\.\d+)(?:-(\d\.\d+))?", words):
            chapter, number = map(int, first.split("."))
            end = int(last.split(".")[1]) if last else number
            found |= {(chapter, n) for n in range(number, end + 1)}
    return found


def test_every_figure_is_a_row_or_a_drawing():
    rows = set().union(*(named_figures(claim.item) for _, claim in CLAIMS.values()))
    drawn = set().union(*(named_figures(name.replace("Figure", "Fig"))
                          for name in DRAWINGS))  # fmt: skip
    rows |= {f for _, c in CLAIMS.values() for f in named_figures(c.item.replace("Fig.", "Fig"))}
    assert set(ITEMS) <= rows | drawn
    assert "Tables 2.1, 2.2" in " ".join(claim.item for _, claim in CLAIMS.values())


def test_claims_can_be_broken_and_begin_with_their_page():
    assert len(CLAIMS) == sum(len(one.claims) for one in EXPERIMENTS)
    for _, claim in CLAIMS.values():
        additional = claim.kind == "additional"
        assert claim.item.startswith("additional" if additional else "p. "), claim.name
        if claim.kind in ("document", "additional"):
            assert claim.fault is not None and claim.fault_description, claim.name


@pytest.mark.daily(
    "inverse kinematics",
    "force feed-forward error",
    "direct force, linear",
    "damping that rises",
    "four channels, position control",
    "delayed channel",
    "intervening impedance",
)
@pytest.mark.parametrize("one", [e for e in EXPERIMENTS if e.fixed_repetitions == 1],
                         ids=lambda one: one.name)  # fmt: skip
def test_exact_rows_agree_and_differ_when_broken(one):
    samples = [one.measure(1, {})]
    for claim in one.claims:
        expected = "differs" if claim.name in EXPECTED_TO_DIFFER else "agrees"
        assert claim.compare(samples).verdict == expected, claim.name
        if claim.fault is not None:
            assert claim.compare([one.measure(1, claim.fault)]).verdict == "differs", claim.name


@pytest.mark.parametrize("name", ["theorem 4-2", "task identification"])
def test_drawn_rows_agree_and_differ_when_broken(name):
    one = next(e for e in EXPERIMENTS if e.name == name)
    samples = [one.measure(seed, {}) for seed in range(1, 7)]
    for claim in one.claims:
        assert claim.compare(samples).verdict == "agrees"
        broken = [one.measure(seed, claim.fault) for seed in range(1, 7)]
        assert claim.compare(broken).verdict == "differs"


def test_unknown_changes_are_refused():
    with pytest.raises(InputError, match="valid: failures, remove"):
        measure_outliers(1, {"remove_outliers": True})
    with pytest.raises(InputError, match="unknown"):
        merge_settings({"damping": 2.0}, {"delay": 1.0})


def test_failed_sensors_read_zero_for_a_while():
    time = np.arange(3000) * 0.02
    names = [f"{k}.boom" for k in ("angle", "pressure_head", "pressure_rod")]
    units = {name: "rad" if "angle" in name else "Pa" for name in names}
    log = Log(time, {name: np.ones(3000) for name in names}, units)
    bad = simulate_sensor_failures(log, ("boom",), 4, np.random.default_rng(0))
    dead = sum(np.count_nonzero(bad[name] == 0.0) for name in names) * 0.02
    assert 0.5 < dead < 12.0
    assert all(np.all(log[name] == 1.0) for name in names)
