"""Initial regressions on plain data: a cylinder on rails, integrated here with NumPy and without the library's laws.

The equations are those of a textbook (Merritt 1967, chapter 6): orifice flow through a four-edge valve, compressible
oil in two chambers, mass with viscous and Coulomb friction.
"""

import dataclasses
import math

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.estimate.hypothesis import hypotheses
from hydrotele.gap.initial_regressions import fit_robust, run_initial_regressions, start_values, with_start_values
from hydrotele.gap.result import regressions_document
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.log import Log
from hydrotele.machine.log_channels import default_channel_unit
from hydrotele.machine.machine_file import load_machine

PERIOD, SECONDS, STEP = 0.01, 20.0, 2e-4  # s
NOISE = {"position.slide": 2e-5, "length.slide": 2e-5, "pressure_head.slide": 2e4, "pressure_rod.slide": 2e4,
         "pressure_supply": 2e4}  # fmt: skip


def simulate_cylinder(coulomb: float = 150.0, viscous: float = 600.0, gain: float = 1.0) -> dict[str, np.ndarray]:
    """Integrate the rig with semi-implicit Euler steps of 0.2 ms, and add noise.

    Args:
        coulomb: Coulomb friction [N].
        viscous: viscous friction [N s/m].
        gain: of the valve flow, relative to the data sheet.

    Returns:
        Column -> readings (n,).
    """
    area_head, area_rod, stroke, dead, beta, mass = 12.566371e-4, 7.657632e-4, 0.5, 1e-4, 1.2e9, 203.0
    orifice, supply, tank = gain * 30.0 / 60000.0 / math.sqrt(7e6), 14e6, 0.2e6
    x, v, head, rod, spool = 0.25, 0.0, 5e6, 8.2e6, 0.0
    table = []
    for k in range(round(SECONDS / STEP)):
        time = k * STEP
        if k % round(PERIOD / STEP) == 0:
            # the position is fed back, so that the cylinder stays within its stroke
            wanted = 0.25 + 0.12 * math.sin(1.1 * time) + 0.05 * math.sin(2.7 * time)
            command = min(max(4.0 * (wanted - x) + 0.1 * math.sin(3.9 * time), -1.0), 1.0)
            table.append((command, x, head, rod))
        spool += STEP * 2.0 * math.pi * 40.0 * (command - spool)
        opening = math.copysign(max(abs(spool) - 0.01, 0.0) / 0.99, spool)
        up, down = (supply - head, rod - tank) if opening > 0 else (head - tank, supply - rod)
        q_head = orifice * opening * math.sqrt(max(up, 0.0))
        q_rod = orifice * opening * math.sqrt(max(down, 0.0))
        friction = coulomb * math.tanh(v / 0.005) + viscous * v
        v += STEP * (area_head * head - area_rod * rod - friction) / mass
        x += STEP * v
        head += STEP * beta / (dead + area_head * x) * (q_head - area_head * v)
        rod += STEP * beta / (dead + area_rod * (stroke - x)) * (area_rod * v - q_rod)
    command, position, head, rod = np.array(table).T
    columns = {
        "command.slide": command, "position.slide": position, "length.slide": position.copy(),
        "pressure_head.slide": head, "pressure_rod.slide": rod, "pressure_supply": np.full(len(head), supply),
    }  # fmt: skip
    rng = np.random.default_rng(3)
    return {c: v + NOISE.get(c, 0.0) * rng.normal(size=len(v)) for c, v in columns.items()}


def make_dataset(columns: dict[str, np.ndarray]) -> Dataset:
    """Two runs of columns: the first three quarters are fitted."""
    channels = tuple(c for c in columns if not c.startswith("command"))
    rows, runs = len(columns["command.slide"]), []
    for name, part in (("fit", slice(0, 3 * rows // 4)), ("test", slice(3 * rows // 4, rows))):
        own = {c: v[part] for c, v in columns.items()}
        count = len(own["command.slide"])
        log = Log(PERIOD * np.arange(count), own, {c: default_channel_unit(c) for c in own}, {}, name)
        reading = np.column_stack([own[c] for c in channels])
        known = np.ones(count, bool)
        runs.append(RunData(name, 0.0, PERIOD, own["command.slide"][:, None], known, reading, log))
    noise = np.array([NOISE[c] for c in channels])
    return Dataset(load_machine("rig"), ("slide",), channels, noise, (runs[0],), runs[1], ())


@pytest.fixture(scope="module")
def columns() -> dict[str, np.ndarray]:
    return simulate_cylinder()


def test_a_right_log_has_no_gross_error_and_the_true_coefficients(columns):
    found = run_initial_regressions(make_dataset(columns))
    assert found.errors == ()
    table = {r.balance: r for r in found.regressions}
    force, flow = table["force"], table["flow"]
    # a second-order servo valve of 60 Hz against the first-order lag of 40 Hz here: 1 % of the flow
    assert flow.coefficients["factor"].value == pytest.approx(1.0, abs=0.03)
    assert force.coefficients["coulomb"].value == pytest.approx(150.0, abs=30.0)
    assert force.coefficients["viscous"].value == pytest.approx(600.0, abs=150.0)
    assert min(r.explained for r in found.regressions) > 0.9
    assert flow.explained_nominal > 0.99


def test_friction_and_flow_gain_are_start_values(columns):
    found = run_initial_regressions(make_dataset(simulate_cylinder(coulomb=400.0, gain=0.8)))
    assert found.errors == ()
    starts = start_values(found)
    assert starts["coulomb_friction", "slide", "coulomb"] == pytest.approx(400.0, rel=0.15)
    assert starts["valve_gain", "slide", "ratio"] == pytest.approx(0.8, rel=0.05)
    candidates = with_start_values(hypotheses(load_machine("rig")), found)
    (friction,) = (h for h in candidates if h.key == ("coulomb_friction", "slide"))
    assert friction.parameters["coulomb"].start_values == (starts["coulomb_friction", "slide", "coulomb"],)
    assert len(friction.starts) == 1


ATTACKS = {
    "command reversed": ({"command.slide": ("command.slide", -1.0)}, "wrong sign", {"command.slide"}),
    "pressures exchanged": (
        {"pressure_head.slide": ("pressure_rod.slide", 1.0), "pressure_rod.slide": ("pressure_head.slide", 1.0)},
        "exchanged columns", {"pressure_head.slide", "pressure_rod.slide"},
    ),
    "bar read as Pa": (
        {c: (c, 1e-5) for c in NOISE if "pressure" in c}, "wrong unit", {c for c in NOISE if "pressure" in c},
    ),
    "length in mm": ({"length.slide": ("length.slide", 1e3)}, "wrong unit", {"length.slide"}),
}  # fmt: skip


@pytest.mark.parametrize("attack", ATTACKS)
def test_gross_errors_of_columns_are_named(columns, attack):
    moves, kind, channels = ATTACKS[attack]
    wrong = columns | {c: factor * columns[source] for c, (source, factor) in moves.items()}
    (error,) = run_initial_regressions(make_dataset(wrong)).errors
    assert (error.kind, set(error.channels)) == (kind, channels)
    assert error.probability > 0.95 and error.explained > 0.9 > error.explained_as_logged
    assert f"{100 * error.explained:.0f} %" in error.description


def test_a_factor_of_three_is_said_with_its_number():
    found = run_initial_regressions(make_dataset(simulate_cylinder(gain=3.0)))
    (error,) = found.errors
    assert (error.kind, error.channels) == ("factor", ("flow", "slide"))
    factor = next(r for r in found.regressions if r.balance == "flow").coefficients["factor"].value
    assert factor == pytest.approx(3.0, rel=0.1)
    assert f"{factor:.3g} times" in error.description


def test_an_effect_of_usual_size_is_no_gross_error(columns):
    data = make_dataset(columns)
    for name, values in (("viscous_friction", {"viscous": 2400.0}), ("internal_leakage", {"leakage": 2e-12})):
        machine = apply_effect(data.machine, name, "slide", values)
        assert run_initial_regressions(dataclasses.replace(data, machine=machine)).errors == ()


def test_a_drive_at_rest_has_no_regression(columns):
    still = columns | {c: np.full_like(v, v[0]) for c, v in columns.items() if "slide" in c}
    rng = np.random.default_rng(1)
    still |= {c: still[c] + NOISE[c] * rng.normal(size=len(still[c])) for c in NOISE if "slide" in c}
    found = run_initial_regressions(make_dataset(still))
    assert found.errors == () and not [r for r in found.regressions if r.balance != "length"]


def test_one_wild_row_in_ten_does_not_move_a_robust_fit():
    rng = np.random.default_rng(0)
    x = rng.normal(size=200)
    y = 2.0 * x + 0.01 * rng.normal(size=200)
    y[::10] += 50.0
    fit = fit_robust(y, np.column_stack([x, np.ones(200)]), np.array([-np.inf, -np.inf]))
    assert fit.value == pytest.approx([2.0, 0.0], abs=0.01)
    held = fit_robust(y, np.column_stack([x, np.ones(200)]), np.array([-np.inf, 0.5]))
    assert held.value[1] == 0.5


def test_document_is_plain(columns):
    document = regressions_document(run_initial_regressions(make_dataset(columns)))
    assert document["errors"] == []
    force = next(r for r in document["regressions"] if r["balance"] == "force")
    assert force["unit"] == "N" and force["coefficients"]["viscous"]["unit"] == "N s/m"
