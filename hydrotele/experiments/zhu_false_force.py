"""Zhu 1994, 6.3.3: false endpoint force that a model estimates from pressures in free motion.

Both models are identified from logs of the feller-buncher's sensors. The static model is identified
by least squares from slow moves, as in the thesis (6.1.3); the dynamic model is identified from an
excitation motion. The identification starts from a machine with wrong masses and friction.
"""

import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from hydrotele.control.endpoint_force import Gravity, endpoint_force_of_log, identify_gravity
from hydrotele.effects.effect import changed
from hydrotele.experiments.comparison import Changes, Claim, Experiment, Judgement, Panel, Sample
from hydrotele.experiments.intervals import check_mean, collect, format_values
from hydrotele.experiments.scenario_runs import operator_changes, run_shipped
from hydrotele.identify.estimation import Estimator
from hydrotele.identify.identification import identify_with_shapes
from hydrotele.identify.identified_machine import identified_machine
from hydrotele.identify.motion import Processing
from hydrotele.identify.record import records
from hydrotele.identify.setup import cylinder_bars, machine_setup
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.log import save_log
from hydrotele.machine.machine import Machine
from hydrotele.simulate.closure import closed_chain

_INITIAL_ERROR = 1.3  # factor of masses and dry friction at the start of the identification
_MIN_RATIO = 3.0  # false force in motion over that at rest
_MAX_SHARE = 0.2  # false force of the dynamic over that of the static model
_SENSORS = "zhu1994"
_SEEDS = (11, 12)  # seeds of the logs for the fit and for the validation


def _falsify_machine(machine: Machine) -> Machine:
    """Return the machine with masses and dry friction multiplied by `_INITIAL_ERROR`."""
    for name, link in machine.links.items():
        machine = changed(machine, f"links.{name}.mass", _INITIAL_ERROR * link.mass)
    for name, axis in machine.axes.items():
        if axis.cylinder:
            path = f"axes.{name}.cylinder.friction.coulomb"
            machine = changed(machine, path, _INITIAL_ERROR * axis.cylinder.friction.coulomb)
    return machine


@cache
def identify_models(offset: int) -> tuple[Machine, Gravity]:
    """Identify the feller-buncher and its static model from logs of simulated sensors.

    Args:
        offset: number added to the seeds of the logs.

    Returns:
        (machine of the dynamic estimate, parameters of the static estimate).
    """
    _, slow = run_shipped("feller_slow_moves", {"seed": str(10 + offset)})
    start = _falsify_machine(slow.plant.machine)
    gravity = identify_gravity(start, slow.measured)
    with tempfile.TemporaryDirectory() as folder:
        for number, seed in enumerate(_SEEDS):
            period = "30.0" if number == 0 else "26.0"
            keys = {"seed": str(seed + offset), "pilot.period": period}
            _, run = run_shipped("feller_excitation", keys)
            save_log(run.measured, Path(folder, f"log_{number}.parquet"))
        data = load_dataset(Path(folder), start, _SENSORS, "log_1", force=True)
    fit, validation, notes = records(data)
    setup = machine_setup(start, closed_chain(start), "complete")
    found = identify_with_shapes(fit, validation, setup, Processing(), Estimator(), notes=notes)
    machine, _ = identified_machine(start, found, cylinder_bars(start))
    return machine, gravity


def measure_false_force(seed: int, changes: Changes) -> Sample:
    """Estimate the endpoint force in free motion with the static and the dynamic model.

    The machine is at rest and then follows joint steps or joystick steps.

    Args:
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        RMS false forces of both models [N] and their ratios.
    """
    machine, gravity = identify_models(0)
    values, panels = {}, []
    squares = {"static": 0.0, "dynamic": 0.0}
    at_rest = np.nan
    for name, moving in (("feller_joint_steps", 1.0), ("feller_steps", 1.0)):
        if name == "feller_joint_steps":
            keys = {"seed": str(seed)} | dict(changes)
        else:  # this scenario has another pilot, to which changes of the first do not apply
            keys = operator_changes(seed)
            keys |= {k: v for k, v in changes.items() if not k.startswith("pilot")}
        _, run = run_shipped(name, keys)
        time = run.measured.time
        sensors = machine.sensors.get(_SENSORS)
        curves = {}
        for kind in ("static", "dynamic"):
            force = endpoint_force_of_log(
                machine, run.measured, kind, gravity=gravity if kind == "static" else None,
                sensors=sensors,
            )  # fmt: skip
            size = np.hypot(force["z"], force["r"])
            values[f"{kind}_{name}"] = float(np.sqrt(np.mean(size[time > moving] ** 2)))
            squares[kind] += values[f"{kind}_{name}"] ** 2 / 2.0
            if kind == "static" and name == "feller_joint_steps":
                waiting = (time > 0.5) & (time < moving)
                at_rest = float(np.sqrt(np.mean(size[waiting] ** 2)))
            curves[kind] = force["z"] / 1e3
        panels.append(Panel(f"estimated vertical force in free motion, {name} [kN]", time, curves))
    values |= {key: float(np.sqrt(square)) for key, square in squares.items()}
    values |= {
        "at_rest": at_rest, "share": values["dynamic"] / values["static"],
        "ratio": values["static_feller_joint_steps"] / at_rest,
    }  # fmt: skip
    return Sample(values, tuple(panels))


def _judge_static(samples: Sequence[Sample]) -> Judgement:
    check = check_mean(
        "false force of the static model in joint steps over that at rest",
        collect(samples, "ratio"), (_MIN_RATIO, np.inf),
        "big: three times the error at rest",
    )  # fmt: skip
    note = (
        f"{format_values(samples, 'static_feller_joint_steps', 1e-3, 2)} kN RMS during the steps,"
        f" {format_values(samples, 'at_rest', 1e-3, 2)} kN at rest before them"
    )
    return Judgement((check,), note=note)


def _judge_dynamic(samples: Sequence[Sample]) -> Judgement:
    check = check_mean(
        "false force of the dynamic model over that of the static one", collect(samples, "share"),
        (0.0, _MAX_SHARE), "a limit of this project",
    )  # fmt: skip
    note = (
        f"{format_values(samples, 'static', 1e-3, 2)} kN RMS with the static model,"
        f" {format_values(samples, 'dynamic', 1e-3, 2)} kN with the dynamic one:"
        f" {format_values(samples, 'dynamic_feller_joint_steps', 1e-3, 2)} kN in joint steps,"
        f" {format_values(samples, 'dynamic_feller_steps', 1e-3, 2)} kN in steps of the joystick"
    )
    explanation = (
        "both models are identified from logs, starting with"
        f" {_INITIAL_ERROR:g} times the masses and friction"
    )
    return Judgement((check,), explanation, note)


FALSE_FORCE = (
    Experiment("false force", measure_false_force, (
        Claim(
            "feller-buncher: false force of the static model",
            "\"During free motion, the joint torques caused by the manipulators dynamics can"
            ' introduce big computed-force error"',
            "p. 107",
            "document",
            _judge_static,
            {
                "pilot.interpolate": "linear", "pilot.time": "[0, 30, 31]",
                "pilot.columns": "{boom: [0.45, 0.45, 0.45], stick: [-1.35, -1.35, -1.35],"
                " tilt: [0.9, 0.9, 0.9]}",
            },
            "a machine at rest",
        ),
        Claim(
            "feller-buncher: false force of the dynamic model",
            "the false force of a dynamic model identified from logs is less than a fifth of that"
            " of the static model",
            "additional to p. 107",
            "additional",
            _judge_dynamic,
            {"effects": "[{name: payload, parameters: {mass: 300.0}}]"},
            "the machine carries an additional load of 300 kg",
        ),
    ), 6),
)  # fmt: skip
