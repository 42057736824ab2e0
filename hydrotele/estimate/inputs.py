"""Unknown inputs: force, flow and command that a machine has and its model lacks, as noise.

Each acts on one balance of one axis and is an Ornstein-Uhlenbeck process: it keeps its sign for
about a correlation time, as missing friction, leakage or valve opening does, and unlike white
process noise. They are further states of the filter; their sizes are found from the data
(`estimate.levels`), and a smoother reads them back, row by row.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.effects.effect import changed
from hydrotele.estimate.reduced_model import (
    X,
    accelerate,
    advance,
    model_space,
    place,
    reduced_model,
)
from hydrotele.hydraulics.laws import air_compliance
from hydrotele.hydraulics.parameters import (
    ADDED_DELIVERY,
    actuator_order,
    extra_state_names,
    longest_step,
)
from hydrotele.hydraulics.supply import ADDED_LAG
from hydrotele.machine.machine import Machine
from hydrotele.multibody.reduced_mechanism import solve
from hydrotele.terms.facts import Term

MEMORY = 0.3  # s, correlation time: longer than a valve's lag, shorter than a motion
_USUAL_PRESSURE = 2.0e7  # Pa, of a pump's own circuit that states no relief setting
_TRIED = 1.0e-4  # of its largest size, by which an input of a pump drive is tried
_ROWS_STEP = 4.0e-3  # s, for what inputs do in a row
BALANCES = ("force", "flow_head", "flow_rod", "command")
SUPPLY = "flow_supply"
"""Balance of the pump that valves share; its input stands under the first axis with a valve."""


class Input(NamedTuple):
    """An unknown input.

    Attributes:
        balance: out of `BALANCES`, or `SUPPLY`.
        axis: the axis on which it acts.
    """

    balance: str
    axis: str

    @property
    def name(self) -> str:
        """Balance and axis."""
        return f"{self.balance}.{self.axis}"


def possible_inputs(machine: Machine, axes: Sequence[str] = ()) -> tuple[Input, ...]:
    """Every unknown input of a machine, or of some of its axes; a force drive has one.

    One of the pump's flow is among them where the machine has a term of it.
    """
    found = []
    for axis in actuator_order(machine):
        if axes and axis not in axes:
            continue
        facts = machine.axes[axis]
        count = 4 if facts.valve else 3 if facts.pump else 1
        found += [Input(balance, axis) for balance in BALANCES[:count]]
    if ADDED_DELIVERY in extra_state_names(machine):
        found.append(Input(SUPPLY, next(iter(machine.valve_axes))))
    return tuple(found)


def input_sizes(machine: Machine, inputs: Sequence[Input]) -> np.ndarray:
    """(m,) the largest size of each input that makes sense: full force, rated flow, half stroke."""
    sizes = []
    for balance, axis in inputs:
        facts = machine.axes[axis]
        if balance == "command":
            sizes.append(0.5)
        elif balance == SUPPLY:
            assert machine.supply
            sizes.append(machine.supply.pump_flow)
        elif balance != "force":
            pump = facts.pump
            sizes.append(
                facts.valve.rated_flow if facts.valve
                else pump.displacement * pump.rated_speed if pump else math.nan
            )  # fmt: skip
        elif facts.force:
            sizes.append(abs(facts.force.gain) * facts.force.command_limit)
        else:
            pressure = machine.supply.relief_pressure if machine.supply else _USUAL_PRESSURE
            sizes.append(pressure * facts.hydraulic_drive.areas[0])
    return np.array(sizes)


def input_units(machine: Machine, inputs: Sequence[Input]) -> list[str]:
    """SI unit of each input."""
    units = {"command": "1", "flow_head": "m^3/s", "flow_rod": "m^3/s", SUPPLY: "m^3/s"}
    return [units.get(i.balance) or ("N m" if _turns(machine, i.axis) else "N") for i in inputs]


def _turns(machine: Machine, axis: str) -> bool:
    return machine.axes[axis].cylinder is None and machine.position_kind(axis) == "angle"


@compiled
def _drive_responses(model, sp, states, position, response):
    """Drive positions (n, nu), and accelerations per unit drive force (n, nu, rates)."""
    n, t = len(model.mech.free), len(model.transmission)
    column = np.zeros(n + t)
    for row in range(len(states)):
        place(model, sp, states[row])
        accelerate(model, sp, states[row], 0.0)
        for i in range(len(model.gear)):
            position[row, i] = sp.drive[X, i]
            column[:] = 0.0
            if model.gear[i] >= 0:
                column[n + model.gear[i]] = 1.0
            else:
                for f in range(n):
                    column[f] = sp.row[i, f]
            solve(sp.mass, column)
            response[row, i] = column


@compiled
def _rows_later(model, sp, states, command, period, steps, later):
    """States (n, nz) a row after given ones, without readings."""
    trail = np.zeros((0, 0))
    for row in range(len(states)):
        later[row] = states[row]
        advance(model, sp, later[row], command, row, period, steps, trail)


def _pumped_column(
    machine: Machine, states: np.ndarray, command: np.ndarray, period: float, i: Input
) -> np.ndarray:
    """(n, nz) change of the states per unit of an input of a pump drive, by difference.

    Its oil and friction are faster than a row, so that no rule at the row's ends tells the change.
    Where dry friction holds, a force moves nothing until it breaks away; as what holds is itself
    uncertain, a force counts as on a piston that slides.
    """
    size = _TRIED * float(input_sizes(machine, [i])[0])
    if i.balance == "force":
        for part in ("coulomb", "stribeck_extra"):
            machine = changed(machine, f"axes.{i.axis}.cylinder.friction.{part}", 0.0)
        if i.axis in machine.loads:
            bare = machine.loads[i.axis].model_copy(update={"friction": 0.0, "return_force": 0.0})
            machine = machine.model_copy(update={"loads": {**machine.loads, i.axis: bare}})
    term = Term.model_validate({
        "name": "unknown", "axis": i.axis, "balance": i.balance, "law": "constant",
        "parameters": {"value": size},
    })  # fmt: skip
    more = machine.model_copy(update={"terms": (*machine.terms, term)})
    steps = max(1, math.ceil(period / min(_ROWS_STEP, longest_step(machine, i.axis))))
    ends = []
    for one in (machine, more):
        model, later = reduced_model(one, ()), np.empty(states.shape)
        _rows_later(model, model_space(model), states, command, period, steps, later)
        ends.append(later)
    return (ends[1] - ends[0]) / size


def input_columns(
    machine: Machine, states: np.ndarray, flow: np.ndarray, period: float, inputs: Sequence[Input],
    command: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Change of the model's states over each row per unit of each input.

    Args:
        machine: the machine.
        states: (n, nz) states of a run, row by row.
        flow: (n, >= nz, >= nz) their transition Jacobians as of `filter.filter_run`.
        period: time between rows [s].
        inputs: m unknown inputs.
        command: (n, nu) commands.

    Returns:
        (n, m, nz) changes [state's unit per input's unit], by the trapezoidal rule: half of what
        acts in a row is carried along by the row's transition. Those of pump drives by difference.
    """
    model = reduced_model(machine, ())
    order = actuator_order(machine)
    rows, size, nu = *states.shape, len(order)
    first = 2 * (len(model.mech.free) + len(model.transmission))
    rates = first // 2
    position, response = np.empty((rows, nu)), np.empty((rows, nu, rates))
    _drive_responses(model, model_space(model), states, position, response)
    columns = np.zeros((rows, len(inputs), size))
    for m, (balance, axis) in enumerate(inputs):
        i = order.index(axis)
        facts = machine.axes[axis]
        if facts.pump:
            continue
        if balance == "force":
            columns[:, m, rates : 2 * rates] = response[:, i]
        elif balance == SUPPLY:
            assert machine.supply
            at = first + 4 * model.hydraulic + extra_state_names(machine).index(ADDED_DELIVERY)
            follows = 2.0 / period * math.tanh(0.5 * period / ADDED_LAG)  # of its exponential
            columns[:, m, at] = follows / machine.supply.pump_flow
        elif balance == "command":
            assert facts.valve
            columns[:, m, first + 4 * i + 1] = facts.valve.bandwidth**2
        else:
            side = 2 if balance == "flow_head" else 3
            drive = facts.hydraulic_drive
            volume = np.maximum(drive.volumes(position[:, i])[side - 2], drive.dead_volume)
            oil = drive.hose_compliance
            if machine.supply:
                bubbles = np.array([
                    air_compliance(p, machine.supply.entrained_air)
                    for p in states[:, first + 4 * i + side]
                ])  # fmt: skip
                oil += volume * (1.0 / machine.supply.bulk_modulus + bubbles)
            columns[:, m, first + 4 * i + side] = 1.0 / oil
    carried = np.einsum("rms,rsk->rmk", columns, flow[:, :size, :size])
    columns = 0.5 * period * (columns + carried)
    for m, i in enumerate(inputs):
        if machine.axes[i.axis].pump:
            columns[:, m] = _pumped_column(machine, states, command, period, i)
    return columns


def decay(period: float) -> float:
    """By which factor an input falls over a row of a period [s]."""
    return math.exp(-period / MEMORY)


def input_drift(size: np.ndarray, period: float) -> np.ndarray:
    """Variance that a row adds to inputs of stationary standard deviations `size` (m,)."""
    return size**2 * (1.0 - decay(period) ** 2)
