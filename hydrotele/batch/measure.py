"""Speed, memory and repeatability of batches, for `hydrotele bench --device` and the page of the batch."""

import json
import time
from typing import Any

import numpy as np

from hydrotele.batch.batch import Batch
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine

CPU_COUNTS, CUDA_COUNTS = (256, 4096), (256, 4096, 16384, 65536, 262144)
_PERIOD, _TIMESTEP = 0.02, 0.001  # s
_AMPLITUDE = 0.3  # amplitude of the random commands [1]


def measure_batch(machine: Machine, device: str, counts: tuple[int, ...], seconds: float = 3.0) -> list[dict[str, Any]]:
    """Measure batches of several sizes with random commands, drawn anew every tenth control period.

    Args:
        machine: the machine.
        device: "cpu" or "cuda".
        counts: numbers of machines.
        seconds: duration of the measurement of each size [s].

    Returns:
        For each size: `machines`; `steps_per_s`, time steps of all machines per second; on the CPU
        `steps_per_core_s`, time steps per second of processor time; `first_step_s`, duration of the
        first step with compilation or loading of code [s]; `bytes_per_machine`, of arrays with one row per
        machine; `failed`, number of machines whose state is not finite at the end.
    """
    return [_measure_size(machine, device, count, seconds) for count in counts]


def _measure_size(machine: Machine, device: str, count: int, seconds: float) -> dict[str, Any]:
    batch = Batch(machine, count, device=device, period=_PERIOD, timestep=_TIMESTEP)
    rng, begin = np.random.default_rng(0), time.perf_counter()
    batch.step(np.zeros(len(batch.axes)))
    batch.synchronise()
    first, periods, begin, used = time.perf_counter() - begin, 0, time.perf_counter(), time.process_time()
    while periods == 0 or time.perf_counter() - begin < seconds:
        batch.step(rng.uniform(-_AMPLITUDE, _AMPLITUDE, (count, len(batch.axes))), 10)
        batch.synchronise()
        periods += 10
    elapsed, used = time.perf_counter() - begin, time.process_time() - used
    steps = count * periods * round(_PERIOD / _TIMESTEP)
    arrays = [a for a in batch.machines[:10] if len(a) == count]
    found = {
        "machines": count, "steps_per_s": round(steps / elapsed), "first_step_s": round(first, 2),
        "bytes_per_machine": sum(a.dtype.itemsize * int(np.prod(a.shape[1:])) for a in arrays),
        "failed": int(np.sum(batch.to_host(batch.machines.failed))),
    }  # fmt: skip
    return found if device == "cuda" else found | {"steps_per_core_s": round(steps / used)}


def measure_parity(machine: Machine, seconds: float, count: int = 64) -> dict[str, float]:
    """Compare a CUDA device with the CPU under the same random commands.

    The device contracts products and sums, and its elementary functions round differently.

    Args:
        machine: the machine.
        seconds: duration of the motion [s].
        count: number of machines.

    Returns:
        Largest differences of the joint positions `position` [rad] or [m] and of the pressures `pressure` [Pa], and
        `repeated`, 1 if a second run on the device has the same bits.
    """
    states = []
    for device in ("cpu", "cuda", "cuda"):
        batch, rng = Batch(machine, count, device=device, period=_PERIOD, timestep=_TIMESTEP), np.random.default_rng(1)
        for _ in range(round(seconds / _PERIOD)):
            batch.step(rng.uniform(-_AMPLITUDE, _AMPLITUDE, (count, len(batch.axes))))
        states.append(batch.to_host(batch.state))
    names = np.array(batch.state_names)
    gap = np.abs(states[1] - states[0]).max(axis=0)
    return {
        "position": float(gap[np.char.startswith(names, "position")].max()),
        "pressure": float(gap[np.char.startswith(names, "pressure")].max(initial=0.0)),
        "repeated": float(np.array_equal(states[1], states[2])),
    }


def compare_with_log(machine: Machine, log: Log) -> dict[str, tuple[float, float]]:
    """Simulate the commands of a log with a batch of one machine and compare the channels.

    Args:
        machine: the machine.
        log: log of a run that started at rest, with its true values and one row per control period.

    Returns:
        Channel -> (RMS, largest) difference [channel's unit].
    """
    begun, rest = json.loads(log.metadata["initial_state"]), Batch(machine, 1)
    state, names = rest.state.copy(), rest.state_names
    for i, axis in enumerate(begun["order"]):
        state[0, names.index(f"position.{axis}")] = begun["angle"][i]
        for side in ("pressure_head", "pressure_rod"):
            state[0, names.index(f"{side}.{axis}")] = begun[side][i]
    batch = Batch(machine, 1, start=state)
    commands = np.column_stack([log[f"command.{axis}"] for axis in batch.axes])
    shown = np.array([batch.step(command)[0].copy() for command in commands[:-1]])
    found = {}
    for c, channel in enumerate(batch.channels):
        error = shown[:, c] - log[channel][1:]
        found[channel] = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())
    return found
