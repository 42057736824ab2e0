"""Measure how often 95 % intervals of the friction force contain it, for friction laws of four forms.

    python tools/studies/friction_coverage.py [--trials 26] [--seed 2] [--jobs 1]
        [--out docs/validation/friction_coverage.md]

Plain MuJoCo simulates a two-link arm that follows random motions. Its joints have damping and one of four laws of dry
friction: `tanh`, `stribeck`, `lugre`, and MuJoCo's `frictionloss`. Every trial records three runs of 20 s at 200 Hz,
with noise of the torques and positions, and identifies the arm as `hydrotele identify --mjcf` does. The true friction
force at 0.3 and 1 rad/s is compared with its 95 % interval.
"""

import tempfile
from pathlib import Path

import mujoco
import numpy as np

from hydrotele.identify.identification import identify_with_friction_shapes
from hydrotele.identify.mechanism import Mechanism, load_mechanism
from hydrotele.identify.record import IdentificationRecord
from hydrotele.identify.result import Identification
from tools.studies.study import options, publish, side_by_side

LAWS = ("tanh", "stribeck", "lugre", "frictionloss")
SPEEDS = (0.3, 1.0)  # rad/s
COULOMB, DAMPING = 1.5, 0.4  # N m, N m s/rad
STICTION, STRIBECK_SPEED = 2.1, 0.08  # N m, rad/s
SMOOTHING_SPEED, STRIBECK_SMOOTHING_SPEED = 0.05, 0.03  # rad/s, of the laws `tanh` and `stribeck`
BRISTLE_STIFFNESS, BRISTLE_DAMPING = 600.0, 8.0  # N m/rad, N m s/rad
TORQUE_NOISE, POSITION_NOISE = 0.05, 1e-5  # N m, rad
JOINTS, RUNS, SECONDS, RATE, STEP = ("shoulder", "elbow"), 3, 20.0, 200.0, 1e-3  # s, Hz, s of a physics step
LOWEST_FREQUENCY, HARMONICS, AMPLITUDE = 0.1, 5, 0.6  # Hz, number, rad
STIFFNESS, CONTROL_DAMPING = 900.0, 60.0  # 1/s^2 and 1/s, of the joint controller

ARM = """\
<mujoco model="arm"><compiler angle="radian"/><option timestep="0.001" integrator="implicitfast"/>
<worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping="{damping}" frictionloss="{loss}"/>
    <inertial pos="0.2 0 0" mass="4" diaginertia="0.01 0.06 0.06"/>
    <body name="lower" pos="0.4 0 0"><joint name="elbow" axis="0 1 0" damping="{damping}" frictionloss="{loss}"/>
      <inertial pos="0.15 0 0.01" mass="2.5" diaginertia="0.005 0.03 0.03"/></body></body>
</worldbody>
<actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator></mujoco>
"""


def sliding_friction(law: str, speed: np.ndarray) -> np.ndarray:
    """Return the dry friction at constant speeds [rad/s], without damping [N m]."""
    if law == "tanh":
        return COULOMB * np.tanh(speed / SMOOTHING_SPEED)
    if law == "frictionloss":
        return COULOMB * np.sign(speed)
    level = COULOMB + (STICTION - COULOMB) * np.exp(-((speed / STRIBECK_SPEED) ** 2))
    return level * (np.sign(speed) if law == "lugre" else np.tanh(speed / STRIBECK_SMOOTHING_SPEED))


class _Bristles:
    """Bristle model of LuGre for both joints; its deflection follows the speed exactly over one step."""

    def __init__(self) -> None:
        self.deflection = np.zeros(2)

    def friction(self, speed: np.ndarray, step: float) -> np.ndarray:
        """Return the friction torques [N m] and advance the deflection by one step [s]."""
        level = COULOMB + (STICTION - COULOMB) * np.exp(-((speed / STRIBECK_SPEED) ** 2))
        rate = speed - BRISTLE_STIFFNESS * np.abs(speed) / level * self.deflection
        torque = BRISTLE_STIFFNESS * self.deflection + BRISTLE_DAMPING * rate
        final = np.sign(speed) * level / BRISTLE_STIFFNESS
        decay = np.exp(-BRISTLE_STIFFNESS * np.abs(speed) / level * step)
        self.deflection = final + (self.deflection - final) * decay
        return torque


def record_run(law: str, name: str, rng: np.random.Generator, seconds: float = SECONDS) -> IdentificationRecord:
    """Simulate one run of the arm and return its noisy record."""
    loss = COULOMB if law == "frictionloss" else 0.0
    model = mujoco.MjModel.from_xml_string(ARM.format(damping=DAMPING, loss=loss))
    data, bristles, inertia = mujoco.MjData(model), _Bristles(), np.zeros((2, 2))
    orders = np.arange(1, HARMONICS + 1)[:, None]
    speeds = 2.0 * np.pi * LOWEST_FREQUENCY * orders
    amplitude = AMPLITUDE / orders * rng.uniform(0.7, 1.3, (HARMONICS, 2))
    angle = speeds * np.arange(round(seconds / STEP))[:, None, None] * STEP + rng.uniform(0, 2 * np.pi, (HARMONICS, 2))
    wanted = (amplitude * np.sin(angle)).sum(1)
    rate = (amplitude * speeds * np.cos(angle)).sum(1)
    feedforward = -(amplitude * speeds**2 * np.sin(angle)).sum(1) + STIFFNESS * wanted + CONTROL_DAMPING * rate
    expected = DAMPING * rate + COULOMB * np.tanh(rate / SMOOTHING_SPEED)
    data.qpos[:], data.qvel[:] = wanted[0], rate[0]
    mujoco.mj_forward(model, data)
    rows, every = [], round(1.0 / RATE / STEP)
    for k in range(len(wanted)):
        mujoco.mj_fullM(model, data, inertia)
        acceleration = feedforward[k] - STIFFNESS * data.qpos - CONTROL_DAMPING * data.qvel
        data.ctrl[:] = inertia @ acceleration + data.qfrc_bias + expected[k]
        if k % every == 0:
            rows.append(np.concatenate([data.qpos, data.ctrl]))
        if law == "lugre":
            data.qfrc_applied[:] = -bristles.friction(data.qvel, STEP)
        elif law != "frictionloss":
            data.qfrc_applied[:] = -sliding_friction(law, data.qvel)
        mujoco.mj_step(model, data)
    table = np.array(rows)
    table += np.repeat([POSITION_NOISE, TORQUE_NOISE], 2) * rng.standard_normal(table.shape)
    unknown = np.full(2, np.nan)
    return IdentificationRecord(name, 1.0 / RATE, JOINTS, table[:, :2], unknown, table[:, 2:], unknown)


def load_arm() -> Mechanism:
    """Return the arm as its MJCF states it: with dry friction and damping, but no law near zero speed."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(ARM.format(damping=DAMPING, loss=COULOMB))
        return load_mechanism(path)


def compare_friction(law: str, found: Identification) -> list[tuple[float, bool, float, float]]:
    """Compare the identified friction forces with the true ones.

    Args:
        law: law of dry friction.
        found: the identification.

    Returns:
        Per joint and speed of `SPEEDS`: speed [rad/s], whether the 95 % interval contains the true force, the error
        and the half width of the interval [N m].
    """
    rows = []
    for one in found.friction:
        if np.isclose(one.speed, SPEEDS).any():
            true = float(sliding_friction(law, np.array(one.speed))) + DAMPING * one.speed
            low, high = one.ci95
            rows.append((one.speed, bool(low <= true <= high), one.force - true, 0.5 * (high - low)))
    return rows


def run_trial(seed: int, number: int) -> dict[str, list[tuple[float, bool, float, float]]]:
    """Identify the arm with each friction law and return the comparisons by law."""
    mechanism, out = load_arm(), {}
    for k, law in enumerate(LAWS):
        rng = np.random.default_rng([seed, number, k])
        *fit, heldout = (record_run(law, f"run_{run}", rng) for run in range(RUNS))
        out[law] = compare_friction(law, identify_with_friction_shapes(fit, heldout, mechanism.setup))
    return out


def make_report(results: list[dict[str, list[tuple[float, bool, float, float]]]]) -> str:
    """Return the table of the coverage in Markdown."""
    total = np.array([row for trial in results for rows in trial.values() for row in rows])
    share = total[:, 1].mean()
    lines = [
        "`hydrotele identify` states the friction force of a joint with a 95 % interval. This study tests "
        "whether the interval contains the true force, whatever the law of dry friction near zero speed. "
        f"{100 * share:.1f} % of all intervals do; 90 to 98 % are required.",
        "",
        f"Plain MuJoCo simulates a two-link arm with {COULOMB:g} N m of dry friction and {DAMPING:g} N m "
        "s/rad of damping. Four laws of dry friction are simulated: `tanh` (smooth change of sign), "
        "`stribeck` (higher friction near zero speed), `lugre` (LuGre model: elastic contact that starts to "
        "slide) and `frictionloss` (MuJoCo's ideal dry friction). The identification does not know which. "
        f"There are {len(results)} trials per law, each with {RUNS} runs of {SECONDS:g} s at {RATE:g} Hz and "
        f"torque noise of {TORQUE_NOISE:g} N m; two runs are fitted.",
        "",
        "Each row is one law and one speed, for both joints. The fourth column should be near 95 %. Error: "
        "estimated minus true force. Half width: half of the interval; smaller is better if the intervals "
        "still contain the true force.",
        "",
        "| law | speed [rad/s] | intervals | contain the true force | mean error [N m] | mean half width [N m] |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for law in LAWS:
        for speed in SPEEDS:
            own = np.array([row for trial in results for row in trial[law] if np.isclose(row[0], speed)])
            lines.append(
                f"| {law} | {speed:g} | {len(own)} | {100 * own[:, 1].mean():.1f} % | {own[:, 2].mean():+.4f} |"
                f" {own[:, 3].mean():.4f} |"
            )
    spread = 196.0 * np.sqrt(share * (1.0 - share) / len(total))
    lines.append(f"| all | | {len(total)} | {100 * share:.1f} % (+- {spread:.1f}) | | |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    asked = options(__doc__, trials=26, seed=2, jobs=1)
    publish(make_report(side_by_side(run_trial, asked)), "Coverage of the friction force", asked)
