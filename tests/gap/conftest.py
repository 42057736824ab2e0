"""Made-up results of a search, so that showing one needs no search."""

import dataclasses

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.gap.result import (
    Alternative,
    Candidate,
    Estimate,
    Gap,
    GapSize,
    Lack,
    LearnedLaw,
    NamedEffect,
    Prediction,
    Unknown,
)
from hydrotele.logs.dataset import RunData
from hydrotele.logs.log import Log
from hydrotele.machine.log_channels import default_channel_unit
from hydrotele.machine.machine_file import load_machine
from hydrotele.terms.term import Term

NOISE = {"angle": 1.0e-3, "length": 1.2e-3, "pressure_head": 1e5, "pressure_rod": 1e5}
_PERIOD, _ROWS, _LOUD = 0.02, 400, slice(150, 230)


def made_up_log(rows: int = _ROWS) -> Log:
    """Smooth motion of the CAT 215 with noise, at 50 Hz."""
    time = _PERIOD * np.arange(rows)
    rng = np.random.default_rng(5)
    columns = {}
    for k, (axis, mean) in enumerate({"swing": 0.0, "boom": 0.45, "stick": -1.6}.items()):
        wave = np.sin((0.7 + 0.2 * k) * time)
        columns[f"command.{axis}"] = 0.4 * np.cos((0.7 + 0.2 * k) * time)
        columns[f"angle.{axis}"] = mean + 0.2 * wave
        columns[f"pressure_head.{axis}"] = 1.1e7 + 3e6 * wave
        columns[f"pressure_rod.{axis}"] = 0.8e7 - 2e6 * wave
    columns["length.boom"] = 0.5 + 0.1 * np.sin(0.9 * time)
    for name in columns:
        if not name.startswith("command"):
            columns[name] = columns[name] + NOISE[name.split(".")[0]] * rng.normal(size=rows)
    units = {name: default_channel_unit(name) for name in columns}
    return Log(time, columns, units, {"machine": "cat215", "tool": "none"}, "data/test_1.parquet")


def run_data(log: Log, machine) -> RunData:
    """A log as the loader hands it on."""
    axes = tuple(machine.axes)
    channels = [c for c in log.columns if not c.startswith(("command", "truth"))]
    command = np.column_stack([log[f"command.{axis}"] for axis in axes])
    reading = np.column_stack([log[c] for c in channels])
    known = np.ones(len(log), bool)
    return RunData(log.name, float(log.time[0]), 1.0 / log.rate, command, known, reading, log)


def predictions(log: Log, bias: float, loud: slice = _LOUD) -> Prediction:
    """One-step predictions with white errors, and `bias` standard deviations in the boom."""
    channels = tuple(c for c in log.columns if not c.startswith(("command", "truth")))
    measured = np.column_stack([log[c] for c in channels])
    rng = np.random.default_rng(7)
    whitened = rng.normal(size=measured.shape)
    wave = np.sin(np.linspace(0, 9, len(log.time)))
    for k, channel in enumerate(channels):
        if channel.endswith(".boom"):
            whitened[:, k] += 0.2 * bias * wave
            whitened[loud, k] += bias * wave[loud]
    sigma = np.array([NOISE.get(c.split(".")[0], 1e5) for c in channels])
    return Prediction(log.name, log.time, channels, measured - sigma * whitened, measured, whitened)


def patched_machine(machine):
    """A machine with effects of every kind that a patch can hold."""
    for name, location, values in (
        ("payload", "tool", {"mass": 250.0}),
        ("valve_deadband", "stick", {"deadband": 0.085}),
        ("command_delay", "boom", {"delay": 0.06}),
        ("length_offset", "boom", {"offset": -0.006}),
    ):
        machine = apply_effect(machine, name, location, values)
    return machine


_PAYLOAD = NamedEffect("payload", "tool", 0.9997, {"mass": Estimate(251.3, "kg", 247.9, 254.6, 0.0)}, share=0.63)
_KNOT = 0.55  # m, where the learned law begins
_PER_METRE = 3.0e5  # N/m, its slope from there


def with_learned_law(machine):
    """A machine with a law learned from data, and with calibrated numbers."""
    for name, location, values in (
        ("payload", "tool", {"mass": 251.3}),
        ("valve_gain", "boom", {"ratio": 1.04}),
    ):
        machine = apply_effect(machine, name, location, values)
    law = Term(
        name="learned_force", axis="boom", balance="force", law="formula",
        parameters={f"above(position, {_KNOT})": -_PER_METRE}, domain={"position": (0.3, 0.7)},
        uncertainty=400.0, description="learned from data: force over position",
    )  # fmt: skip
    return machine.model_copy(update={"terms": (*machine.terms, law)})


_POINTS = np.linspace(0.3, 0.7, 41)
_LAW = LearnedLaw(
    "force", "boom", f"-3e+05 above(position, {_KNOT})",
    "A force on the boom drive, 12 kN RMS, that varies with position.", "", "position",
    tuple(_POINTS.tolist()), tuple((-_PER_METRE * np.maximum(0.0, _POINTS - _KNOT)).tolist()),
    (400.0,) * 41, "N", "m", 0.31,
)  # fmt: skip
_CALIBRATION = {
    "valve_gain.boom.ratio": Estimate(1.04, "1", 1.035, 1.045, 1.0),
    "mass.stick": Estimate(612.0, "kg", 590.0, 634.0, 610.0),
}
_NOISE = {
    "angle.boom": (1.2e-3, 1.0e-3),
    "length.boom": (1.2e-3, float("nan")),
}
_LACKS = (Lack("force", "boom", 2100.0, "N", 0.012), Lack("command", "stick", 0.002, "1", 0.004))
_OFFSET = NamedEffect(
    "length_offset", "boom", 0.62, {"offset": Estimate(-0.0061, "m", -0.0066, -0.0056, 0.0)},
    (Alternative("pin_offset", "boom", 0.37),),
)  # fmt: skip
_RANKING = (
    Candidate("payload", "tool", 81234.5, {"mass": 251.3}),
    Candidate("com_offset", "stick", 31000.0, {"dx": 0.31, "dz": -0.02}),
    Candidate("viscous_friction", "boom", 812.0, {"viscous": 9000.0}),
    Candidate("bulk_modulus", "all", 5.0, {"bulk_modulus": 0.91e9}),
)
_TESTS = {
    "mean square": {"value": 1.03, "limit": 1.08, "passed": True},
    "autocorrelation": {"value": 0.011, "limit": 0.03, "passed": True},
    "window means": {"value": 3.1, "limit": 4.2, "passed": True},
}
_LAWS = {
    "force": {
        "swing": {"before": 5200.0, "after": 2100.0, "noise": 2000.0},
        "boom": {"before": 21000.0, "after": 2600.0, "noise": 2500.0},
        "stick": {"before": 3600.0, "after": 1700.0, "noise": float("nan")},
    },
    "flow": {
        "boom": {"before": 1.1e-4, "after": 1.1e-4, "noise": 1.0e-4},
        "stick": {"before": 0.9e-4, "after": 0.9e-4, "noise": 0.9e-4},
    },
    "supply": {"supply": {"before": 2.1e5, "after": 2.0e5, "noise": 2.0e5}},
}
_EXPERIMENT = {
    "reason": "move the boom over its whole stroke with the stick held.",
    "scenario": {
        "name": "separate",
        "machine": "cat215",
        "duration": 20.0,
        "pilot": {"kind": "constant", "commands": {"boom": 0.2}},
    },
}
_UNKNOWN = Unknown(
    "force", "pressure_head.boom", ("length.boom",),
    "A force of 9 kN against the motion where the piston is near 0.55 m.",
    "9000 above(position, 0.55) * sign(velocity, 0.01)", ((3.0, 4.6),),
)  # fmt: skip
_CASES = {
    "named": {"effects": (_PAYLOAD,)},
    "no_gap": {},
    "unknown": {"unknown": _UNKNOWN},
    "ambiguous": {"effects": (_OFFSET,), "next_experiment": _EXPERIMENT},
    "partly": {
        "effects": (_PAYLOAD,),
        "unknown": _UNKNOWN,
        "calibration": _CALIBRATION,
        "learned": (_LAW,),
        "lacks": _LACKS,
        "noise": _NOISE,
    },
}


def made_up_gap(verdict: str, log: Log | None = None, loud: slice = _LOUD) -> Gap:
    """A Gap of each verdict on a log."""
    log = log or made_up_log()
    machine = load_machine("cat215", tool="none")
    patch = with_learned_law if verdict == "partly" else patched_machine
    facts = _CASES[verdict]
    named = bool(facts.get("effects"))
    before = predictions(log, 0.0 if verdict == "no_gap" else 6.0, loud)
    after = predictions(log, 0.1, loud) if named else before
    rms = [float(np.sqrt(np.nanmean(p.whitened**2))) for p in (before, after)]
    return dataclasses.replace(
        Gap(
            machine=machine, patched=patch(machine) if named else machine,
            verdict=verdict, effects=(), unknown=None, size=GapSize(*rms, 1.0), ranking=_RANKING,
            before=(before,), after=(after,), laws=_LAWS,
            law_units={"force": "N m", "flow": "m^3/s", "supply": "Pa"}, tests=_TESTS,
            notes=("fit_2: 1.0 % of the rows are missing.",), seconds=31.4,
        ),
        **facts,
    )  # fmt: skip


@pytest.fixture(scope="session")
def gap_of():
    """Verdict -> a made-up Gap."""
    gaps = {verdict: made_up_gap(verdict) for verdict in _CASES}
    return gaps.__getitem__


@pytest.fixture(scope="session")
def heldout():
    """The held-out run of these Gaps."""
    return run_data(made_up_log(), load_machine("cat215", tool="none"))
