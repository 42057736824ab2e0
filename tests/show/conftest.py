"""A short made-up log of the CAT 215 with its bucket; no simulator is needed to show one."""

import numpy as np
import pytest

from hydrotele.logs.log import Log
from hydrotele.machine.machine_file import load_machine

_ROWS = 50


@pytest.fixture(scope="session")
def machine():
    """The machine with the most linkages: bucket, rocker and coupler close a loop of four bars."""
    return load_machine("cat215", tool="bucket")


@pytest.fixture(scope="session")
def stuck(machine):
    """The same with a coupler so short that the bucket cannot be turned beyond some 0.3 rad."""
    closure = machine.closures["bucket_coupler_pin"]
    shorter = closure.a.model_copy(update={"position": (0.35, 0.0, 0.0)})
    closure = closure.model_copy(update={"a": shorter})
    return machine.model_copy(update={"closures": {"bucket_coupler_pin": closure}})


@pytest.fixture(scope="session")
def log():
    """50 rows at 50 Hz."""
    return make_log(0.02 * np.arange(_ROWS))


@pytest.fixture(scope="session")
def make():
    """The maker of such logs, for other clocks."""
    return make_log


def make_log(time: np.ndarray, offset: float = 0.0) -> Log:
    """Smooth motion of all axes; `offset` is added to the boom angle [rad]."""
    columns = {
        "command.boom": np.sin(3 * time),
        "angle.swing": 0.8 * np.sin(time),
        "angle.boom": 0.45 + 0.2 * np.sin(2 * time) + offset,
        "angle.stick": -1.6 + 0.3 * np.cos(2 * time),
        "angle.bucket": -1.2 + 0.3 * np.sin(3 * time),
        "length.boom": 0.5 + 0.1 * np.sin(2 * time),
        "pressure_head.boom": 1e7 + 1e6 * np.sin(time),
        "pressure_supply": 2e7 + 1e6 * np.cos(time),
        "truth.flow_head.boom": 1e-3 * np.cos(2 * time),
    }
    units = dict.fromkeys(columns, "rad") | {
        "command.boom": "1", "length.boom": "m", "pressure_head.boom": "Pa",
        "pressure_supply": "Pa", "truth.flow_head.boom": "m^3/s",
    }  # fmt: skip
    return Log(time, columns, units, {"machine": "cat215"}, "somewhere/made_up.parquet")
