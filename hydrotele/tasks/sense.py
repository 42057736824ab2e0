"""Sensors of an episode: true values at one time, late, with defects and errors, converted."""

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.hydraulics.circuit import SCRATCH, SLOTS
from hydrotele.simulate.pointers import floats
from hydrotele.simulate.readout import state_supply
from hydrotele.simulate.sensors import convert
from hydrotele.tasks.chance import draw
from hydrotele.tasks.memory import AXES, CHANNELS


@compiled
def true_positions(f, e, w):
    """Bring an episode's true axis positions up to date.

    Args:
        f: record of FACTS.
        e: record of MEMORY; `position` is written.
        w: World, staggered as `simulate.record` says.

    Returns:
        Nothing.

    Source: `simulate.record.aligned_positions`.
    """
    for i in range(f.axes):
        e.position[i] = w.qpos[f.qpos[i]] - f.timestep * w.qvel[f.dof[i]]


@compiled
def _sensed(f, e, w, out):
    """What stands before the sensors: positions [rad], [m], head and rod pressures, supply [Pa]."""
    k = f.axes
    for i in range(k):
        out[i] = e.position[i]
    for i in range(f.hydraulic):
        out[k + 2 * i], out[k + 2 * i + 1] = w.act[4 * i + 2], w.act[4 * i + 3]
    if f.hydraulic > 0:
        scratch = np.empty(SCRATCH)
        user = floats(f.users + 8 * e.variant * k * SLOTS, k * SLOTS)
        out[k + 2 * f.hydraulic] = state_supply(user, f.hydraulic, w.act, scratch)


@compiled
def _late(f, e, sim, values):
    """Put values into the ring of the past; take out those that the sensors see now."""
    length = f.delayed_sensor
    ring = floats(f.sensed + 8 * sim * length * CHANNELS, length * CHANNELS)
    lags = floats(f.lags + 8 * e.variant * CHANNELS, CHANNELS)
    now = e.tick % length
    for c in range(CHANNELS):
        ring[now * CHANNELS + c] = values[c]
    for c in range(CHANNELS):
        lag = min(lags[c], 1.0 * e.tick)
        if lag > 0.0:
            whole = int(lag)
            part = lag - whole
            new = ring[((now - whole) % length) * CHANNELS + c]
            old = ring[((now - whole - 1) % length) * CHANNELS + c] if part > 0.0 else new
            values[c] = new + part * (old - new)


@compiled
def sense(f, e, w, sim):
    """Read the sensors, if a reading is due; otherwise they are held.

    Args:
        f: record of FACTS.
        e: record of MEMORY; readings are written.
        w: World.
        sim: number of the simulation, scalar.

    Returns:
        Nothing.

    Source: as `simulate.feedback` for scenario runs; late readings are linear between control
        periods, and before the start everything stood as at the start.
    """
    true_positions(f, e, w)
    due = e.tick % f.every == 0
    if not due and f.delayed_sensor == 0:
        return
    values = np.zeros(CHANNELS)
    _sensed(f, e, w, values)
    if f.delayed_sensor > 0:
        _late(f, e, sim, values)
    if not due:
        return
    k, many = f.axes, f.axes + 2 * f.hydraulic
    scales = floats(f.scales + 8 * e.variant * CHANNELS, CHANNELS)
    offsets = floats(f.offsets + 8 * e.variant * CHANNELS, CHANNELS)
    for c in range(many + (1 if f.hydraulic > 0 else 0)):
        value = scales[c] * values[c] + offsets[c]
        if f.noisy:
            value += f.accuracy[c] * (2.0 * draw(e) - 1.0)
            value = convert(value, f.converters[0, c], f.converters[1, c], f.converters[2, c])
        values[c] = value
    span = f.every * f.period
    for i in range(k):
        e.rate[i] = (values[i] - e.joint[i]) / span if e.tick > 0 else 0.0
        e.joint[i] = values[i]
        e.sampled_reference[i] = e.reference[i]
    for i in range(f.hydraulic):
        e.head[i], e.rod[i] = values[k + 2 * i], values[k + 2 * i + 1]
    e.supply = values[many] if f.hydraulic > 0 else 0.0


assert CHANNELS >= 3 * AXES + 1
