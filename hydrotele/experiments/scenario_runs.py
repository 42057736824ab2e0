"""Run shipped scenarios for experiments and read quantities from their logs."""

from collections.abc import Mapping

import numpy as np

from hydrotele.run.run import Run, run_scenario
from hydrotele.scenario.scenario import Scenario, load_scenario


def run_shipped_scenario(name: str, overrides: Mapping[str, str] | None = None) -> tuple[Scenario, Run]:
    """Simulate a scenario that is shipped with the package, with changed settings.

    Args:
        name: name of the scenario.
        overrides: dotted scenario key -> value as YAML text.

    Returns:
        (scenario with the changed settings, its simulated run with true and measured logs).
    """
    scenario = load_scenario(name, dict(overrides or {}))
    return scenario, run_scenario(scenario)


def read_true_channel(run: Run, channel: str) -> np.ndarray:
    """Return the (n,) samples of a channel in the log of true values, or zeros if that log has no such channel."""
    return run.truth.columns.get(channel, np.zeros(len(run.truth.time)))


def compute_cylindrical_pose(run: Run) -> dict[str, np.ndarray]:
    """Return the true tip pose over time: r, z [m], theta and attitude [rad], each (n,).

    r and theta are cylindrical coordinates about the swing axis; theta is continuous. The attitude is the
    sum of the joint angles of boom, stick and tool.
    """
    x, y, z = (read_true_channel(run, f"truth.tip.{c}") for c in "xyz")
    arm = run.plant.machine.arm
    assert arm is not None
    axes = {axis.joint: name for name, axis in run.plant.machine.axes.items()}
    bends = [read_true_channel(run, f"angle.{axes[j]}") for j in (arm.boom, arm.stick, arm.tool) if j]
    return {"r": np.hypot(x, y), "theta": np.unwrap(np.arctan2(y, x)), "z": z,
            "attitude": np.sum(bends, axis=0)}  # fmt: skip


def make_random_operator_settings(seed: int) -> dict[str, str]:
    """Return scenario settings that draw a random simulated operator from the published population.

    The settings are those for `overrides` of `run_shipped_scenario`; they also set the seed of the run.

    Args:
        seed: seed of the operator and of the sensor noise.
    """
    return {"seed": str(seed), "pilot.perception.sample": str(seed)}
