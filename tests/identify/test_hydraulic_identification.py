"""Hydraulic numbers from commands, pressures and motion."""

import dataclasses

import pytest

from hydrotele.core.errors import InputError
from hydrotele.effects.effect import with_value
from hydrotele.identify.hydraulic_identification import HYDRAULIC_EFFECTS, identify_hydraulics
from hydrotele.identify.identify_document import build_identify_document
from hydrotele.logs.dataset import make_dataset
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario

TRUTH = {
    "axes.slide.valve.rated_flow": 1.15, "axes.slide.valve.bandwidth": 0.8,
    "axes.slide.cylinder.leakage": 2.0, "supply.bulk_modulus": 0.85,
}  # fmt: skip


@pytest.fixture(scope="module")
def found():
    """A rig whose valve, oil and leakage are not those that its model has."""
    machine, logs = load_machine("rig"), []
    wrong, given = machine, {}
    for path, factor in TRUTH.items():
        node = machine
        for key in path.split("."):
            node = node[key] if isinstance(node, dict) else getattr(node, key)
        given[path] = float(node)
        wrong = with_value(wrong, path, node / factor)
    for name, seed in (("a", 1), ("b", 2)):
        scenario = load_scenario("rig_steps", {"seed": str(seed)})
        log = run_scenario(scenario).measured
        logs.append(RunFiles(name, (log,)))
    data = make_dataset(logs, wrong, None, "b")
    return identify_hydraulics(data, jobs=1), given


@pytest.mark.nightly
def test_hidden_numbers_are_found_with_honest_intervals(found):
    result, given = found
    numbers = {n.qualified_name: n for n in result.parameters}
    assert set(numbers) >= {"valve_gain.slide", "spool_lag.slide", "bulk_modulus.all"}
    expected = {
        "valve_gain.slide": TRUTH["axes.slide.valve.rated_flow"],
        "spool_lag.slide": given["axes.slide.valve.bandwidth"],
        "internal_leakage.slide": given["axes.slide.cylinder.leakage"],
        "bulk_modulus.all": given["supply.bulk_modulus"],
    }  # fmt: skip
    for name, truth in expected.items():
        n = numbers[name]
        if not n.is_determined:
            continue
        # four standard deviations and a share for steps of the filter's integrator
        assert abs(n.value - truth) < 4.0 * n.std + 0.01 * abs(truth), name
    assert sum(numbers[name].is_determined for name in expected) >= 3
    assert result.status == "ok" and result.identified_rms_error < 1.1 < result.nominal_rms_error


def test_the_document_lists_them_with_the_others(found):
    document = build_identify_document(None, found[0])
    names = [p["name"] for p in document["parameters"]]
    assert "valve_gain.slide" in names
    for entry in document["parameters"]:
        assert (entry["value"] is None) == (entry["status"] == "weak")
    assert document["hydraulics"]["status"] == "ok"


def test_a_machine_without_valves_is_refused():
    machine = load_machine("emps")
    assert not machine.hydraulic_axes
    data = dataclasses.make_dataclass("Data", ["machine"])(machine)
    with pytest.raises(InputError, match="has no valves"):
        identify_hydraulics(data)  # pyright: ignore - nothing else of it is read


def test_all_effects_here_have_one_parameter():
    from hydrotele.effects import EFFECTS

    machine = load_machine("cat215")
    for name in HYDRAULIC_EFFECTS:
        effect = EFFECTS[name]
        for place in effect.locations(machine):
            needed = [p for p in effect.parameters(machine, place).values() if not p.optional]
            assert len(needed) == 1
