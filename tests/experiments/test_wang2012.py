"""Wang's rows that take no long search, the verdicts of the others, and the report's pictures."""

import numpy as np
import pytest

from hydrotele.experiments import wang2012
from hydrotele.experiments.finding import Finding, Marginals, Panel
from hydrotele.show.experiment_report import write_experiment_report


@pytest.fixture(scope="module")
def quick():
    found = [*wang2012.kinematics(), wang2012.refined_exact(), wang2012.poe_poses()]
    found += [wang2012.wire_method(), *wang2012.wire_calibration()]
    return {one.name: one for one in found}


def test_rows_that_agree(quick):
    differs = {name for name, one in quick.items() if not one.ok}
    # 36 parameters do not describe a robot with errors of A_i, whatever the seed
    assert differs == {"a robot with errors in all 54, identified with 36"}


def test_every_row_says_its_criterion_and_where_it_is_published(quick):
    for one in quick.values():
        assert one.source and any(c.isdigit() for c in one.simulated)
        if one.name not in ("number of parameter errors",
                            "independent parameters: counting formulas"):  # fmt: skip
            assert "criterion" in one.simulated, one.name
    assert "page 34" in quick["number of parameter errors"].source


def test_a_search_that_ends_too_high_is_told():
    history = np.array([5.0, 4.0])
    good, bad = (history, 61.02, 61.0), (history, 63.0, 61.0)
    assert wang2012.evolution_runs([good] * 5, "dh").ok
    assert not wang2012.evolution_runs([good] * 4 + [bad], "dh").ok


@pytest.mark.parametrize(("inside", "ok"), [(34, True), (36, False), (32, False)])
def test_intervals_that_are_too_wide_or_too_narrow_are_told(inside, ok):
    assert bool(wang2012.coverage([(inside, 36)] * 50).ok) is ok


def test_the_report_shows_curves_over_poses_and_posteriors(tmp_path):
    rng = np.random.default_rng(1)
    panel = Panel("error [mm]", np.arange(1, 4), {"before": np.ones(3)}, "pose", True)
    shown = Marginals(("a4", "b1x"), rng.normal(size=(400, 2)), np.zeros(2))
    finding = Finding("one", "Fig. 18", "said", "seen", True, (panel,), shown)
    write_experiment_report("wang2012", [finding], tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert text.count("data:image/png") == 2 and "Posterior: one" in text
