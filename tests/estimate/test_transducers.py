"""First-order lags of sensors against their analytic responses."""

import numpy as np
import pytest
from scipy.signal import lsim, lti

from hydrotele.estimate.reduced_model import advance, follow_channel, simulate_rows
from hydrotele.machine.sensors import SensorError, step_first_order_lag


@pytest.mark.parametrize("ratio", [1e-9, 1e-3, 0.3, 1.0, 50.0])
def test_one_step_is_the_analytic_response(ratio):
    """Step: `1 - exp(-t/T)`; ramp of rate 1/T: `t/T - 1 + exp(-t/T)`; rounding apart."""
    assert step_first_order_lag(0.0, 1.0, 1.0, ratio) == pytest.approx(-np.expm1(-ratio), rel=1e-12)
    wanted = ratio + np.expm1(-ratio) if ratio > 1e-6 else 0.5 * ratio**2
    assert step_first_order_lag(0.0, 0.0, ratio, ratio) == pytest.approx(wanted, rel=1e-9, abs=1e-15)
    assert step_first_order_lag(2.0, 0.0, 0.0, ratio) == pytest.approx(2.0 * np.exp(-ratio), rel=1e-12)


@pytest.mark.parametrize("steps", [1, 7, 100])
def test_a_ramp_is_followed_exactly_whatever_the_steps(steps):
    time, constant = np.linspace(0.0, 0.2, steps + 1), 0.03
    trail = np.column_stack([np.zeros(steps + 1), 5.0 * time])
    end = follow_channel(trail, 1, 0.2 / steps / constant, 0.0)
    wanted = 5.0 * (time - constant * -np.expm1(-time / constant))
    assert trail[:, 1] == pytest.approx(wanted, abs=1e-14) and end == trail[-1, 1]
    assert not trail[:, 0].any()


@pytest.mark.parametrize("delay", [0.0, 0.0137, 0.05])
def test_a_free_run_shows_lag_then_delay(machine_of, reduced_of, delay):
    """SciPy's simulation of the lag over what `advance` keeps, straight between steps, delayed."""
    error = SensorError(scale=1.1, offset=2e5, delay=delay, time_constant=0.012)
    plain, channels = machine_of("cat215/none"), ("angle.boom", "pressure_head.boom")
    slow = plain.model_copy(update={"sensor_errors": {"pressure_head.boom": error}})
    rows, steps, period = 60, 20, 0.02
    command = np.repeat(np.random.default_rng(0).uniform(-0.6, 0.6, (6, 3)), 10, axis=0)
    model, space, z = reduced_of(slow, channels)
    seen, states = np.empty((rows, 2)), np.empty((rows, len(z)))
    simulate_rows(model, space, z, command, period, steps, seen, states)
    z, trail = states[0].copy(), np.zeros((rows * steps + 1, 2))
    for row in range(rows - 1):
        advance(model, space, z, command, row, period, steps, trail[row * steps :])
    assert np.array_equal(z, states[-1]), "a sensor changes no motion"
    true = trail[:-steps, 1]
    time = period / steps * np.arange(len(true))
    lagged = true[0] + lsim(lti([1.0], [0.012, 1.0]), true - true[0], time)[1]
    late = np.interp(period * np.arange(rows) - delay, time, lagged)
    np.testing.assert_allclose(seen[:, 1], 1.1 * late + 2e5, rtol=1e-9)  # rounding
    assert np.abs(late - true[::steps]).max() > 1e5
