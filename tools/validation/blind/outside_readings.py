"""Apply sensor errors that the library does not have."""

import numpy as np

_FULL_SCALE = 34.5e6  # Pa, 5000 psi


def _channel(location: str) -> str:
    axis, side = location.split(".")
    return f"pressure_{side}.{axis}"


def pressure_drift(time, channels, location, p) -> dict[str, np.ndarray]:
    """Zero that creeps by `drift` [Pa] with the time constant `time` [s]."""
    name = _channel(location)
    return {name: channels[name] + p["drift"] * (1.0 - np.exp(-time / p["time"]))}


def bent_transducer(time, channels, location, p) -> dict[str, np.ndarray]:
    """Parabola between zero and full scale with the largest error `bow` [Pa] in the middle."""
    name = _channel(location)
    part = channels[name] / _FULL_SCALE
    return {name: channels[name] + 4.0 * p["bow"] * part * (1.0 - part)}
