"""Run shipped scenarios for experiments and read quantities from their logs."""

from collections.abc import Mapping

import numpy as np

from hydrotele.run.run import Run, run_scenario
from hydrotele.scenario.scenario import Scenario, load_scenario


def run_shipped_scenario(name: str, overrides: Mapping[str, str] | None = None) -> tuple[Scenario, Run]:
    """Simulate a scenario that is shipped with the package, with changed settings.

    Args:
        name: name of the scenario.
        overrides: scenario key -> value.

    Returns:
        (scenario, run).
    """
    scenario = load_scenario(name, dict(overrides or {}))
    return scenario, run_scenario(scenario)


def read_true_channel(run: Run, channel: str) -> np.ndarray:
    """Return the (n,) samples of a channel of the simulated truth, or zeros if the run has no such channel."""
    return run.truth.columns.get(channel, np.zeros(len(run.truth.time)))


def compute_cylindrical_pose(run: Run) -> dict[str, np.ndarray]:
    """Return the true tip pose over time: r, z [m], theta and attitude [rad], each (n,).

    r and theta are cylindrical coordinates about the swing axis.
    """
    x, y, z = (read_true_channel(run, f"truth.tip.{c}") for c in "xyz")
    arm = run.plant.machine.arm
    assert arm is not None
    axes = {axis.joint: name for name, axis in run.plant.machine.axes.items()}
    bends = [read_true_channel(run, f"angle.{axes[j]}") for j in (arm.boom, arm.stick, arm.tool) if j]
    return {"r": np.hypot(x, y), "theta": np.unwrap(np.arctan2(y, x)), "z": z,
            "attitude": np.sum(bends, axis=0)}  # fmt: skip


def make_random_operator_settings(seed: int) -> dict[str, str]:
    """Return scenario settings that draw a random simulated operator from its population and set the seed.

    Args:
        seed: seed of the operator and of the sensor noise.
    """
    return {"seed": str(seed), "pilot.perception.sample": str(seed)}
