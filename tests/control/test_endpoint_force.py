"""End-point force: known forces come back, readings that fail do no harm."""

import math

import mujoco
import numpy as np
import pytest

from hydrotele.control.endpoint_force import EndpointForce, endpoint_force_of_log
from hydrotele.core.errors import InputError
from hydrotele.kinematics.arm import ArmGeometry, jacobian
from hydrotele.kinematics.task_space import task_jacobian
from hydrotele.logs.log import Log
from hydrotele.machine.machine import get_sensor_set
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.plant import build_plant, rest_state
from hydrotele.simulate.record import positions_one_step_earlier, start_leapfrog

CAT = load_machine("cat215", "bucket")
REAL = "khoshzaban1992"
HOME = np.array([0.0, 0.45, -1.6, -1.2])


def felt_in_plant(machine, kind, force, command, seconds):
    """Estimates (n, m) at 200 Hz with ideal sensors under a force (3,) [N] at the tip, and tips.

    Args:
        machine: with an arm; its drives without valve read 0.
        kind: of the estimate.
        force: in the world, of all times.
        command: time [s] -> (k,) valve commands.
        seconds: how long.
    """
    plant = build_plant(machine, 1.0e-3, ground=False)
    data = rest_state(plant)
    start_leapfrog(plant.model, data)
    felt = EndpointForce(plant.machine, plant.axes, kind, 0.005)
    site, out, tips = plant.model.site("hydrotele_tip"), [], []
    body = plant.model.site_bodyid[site.id]
    for tick in range(round(seconds / 0.005)):
        data.ctrl[:] = command(0.005 * tick)
        for _ in range(5):
            data.qfrc_applied[:] = 0.0
            place = data.site_xpos[site.id]
            mujoco.mj_applyFT(plant.model, data, force, np.zeros(3), place, body, data.qfrc_applied)
            mujoco.mj_step(plant.model, data)
        head, rod = np.zeros(len(plant.axes)), np.zeros(len(plant.axes))
        head[: plant.hydraulic], rod[: plant.hydraulic] = data.act.reshape(-1, 4)[:, 2:].T
        joint = positions_one_step_earlier(plant.model, data)[plant.qpos]
        out.append(felt.update(joint, head, rod).copy())
        tips.append(data.site_xpos[site.id].copy())
    return np.array(out), np.array(tips)


def in_task(force, tip):
    """Components r [N], theta [N m], z [N] of a force (3,) at tips (n, 3)."""
    r = np.hypot(tip[:, 0], tip[:, 1])
    along = (tip[:, 0] * force[0] + tip[:, 1] * force[1]) / r
    return np.column_stack([along, tip[:, 0] * force[1] - tip[:, 1] * force[0], 0 * r + force[2]])


FORCE = np.array([-4000.0, 1500.0, 9000.0])


@pytest.mark.parametrize("name", ["cat215", "cat215/bucket", "cat325"])
@pytest.mark.parametrize(("kind", "bound"), [("static", 250.0), ("dynamic", 10.0)])
def test_a_force_on_a_resting_arm_comes_back(name, kind, bound):
    """10 kN; after 6 s the swing still creeps through the motor's leak, which takes friction.

    That is 130 N at the tip, 220 N on the feller-buncher, of which the static model knows nothing.
    To the dynamic one the creep is known, late by the filters' half second.
    """
    machine = load_machine(*name.split("/"))
    out, tips = felt_in_plant(machine, kind, FORCE, lambda t: 0.0, 6.0)
    lever = np.array([1.0, np.hypot(*tips[-1, :2]), 1.0])
    assert np.abs((out[-200:, :3] - in_task(FORCE, tips[-200:])) / lever).max() < bound
    least = 250.0 if kind == "static" else 5.0  # 250 N m: the tool's linkage, friction
    assert np.abs(out[-200:, 3:]).max(initial=0.0) < least  # the force acts at the tip itself


def moving(t):
    """All joints to and fro, up to 0.2 rad/s."""
    return np.array([0.3, 0.2, -0.25, 0.3]) * math.sin(2.0 * t)


@pytest.mark.nightly
@pytest.mark.parametrize("force", [np.zeros(3), FORCE], ids=["free", "loaded"])
def test_a_moving_arm_feels_only_what_there_is(force):
    """The dynamic estimate within 100 N, in the mean square; the static one is fifty times as far.

    100 N is what friction that changes sign leaves: it changes within the fast filter's memory.
    The force turns with the swing, so the estimate is compared with what it was a delay ago.
    """
    error = {}
    late = round(EndpointForce(CAT, tuple(CAT.axes)).delay / 0.005)
    for kind in ("static", "dynamic"):
        out, tips = felt_in_plant(CAT, kind, force, moving, 8.0)
        gap = (out[late:, :3] - in_task(force, tips[:-late])) / [1.0, 6.0, 1.0]
        error[kind] = math.sqrt(np.mean(np.sum(gap[300:] ** 2, axis=1)))
    assert error["dynamic"] < 100.0
    assert error["dynamic"] < 0.02 * error["static"]


@pytest.mark.parametrize("name", ["zhu_up", "zhu_out"])
def test_real_sensors_false_force_is_a_fifth_of_the_static_one(name):
    """Asked for; the first second is left out, in which the filters start."""
    run = run_scenario(load_scenario(name, {"sensors": REAL, "ground": "false"}))
    size = {}
    for kind in ("static", "dynamic"):
        sensors = get_sensor_set(CAT, REAL)
        found = endpoint_force_of_log(CAT, run.measured, kind, sensors=sensors)
        r = np.hypot(run.truth["truth.tip.x"], run.truth["truth.tip.y"])
        square = found["r"] ** 2 + found["z"] ** 2 + (found["theta"] / r) ** 2
        size[kind] = math.sqrt(np.mean(square[50:]))
    assert size["dynamic"] < 0.2 * size["static"]


def test_jacobian_is_that_of_the_arm():
    """The same derivative as the closed form of `kinematics.arm`; rounding."""
    felt = EndpointForce(CAT, tuple(CAT.axes))
    table = np.zeros((4, 4))
    task_jacobian(felt._arm.task, HOME, table)
    stick = CAT.links["bucket"].position
    base = np.add(CAT.links["swing"].position, CAT.links["boom"].position)
    geometry = ArmGeometry(
        base_radius=base[0], lateral_offset=base[1], boom_pin_height=base[2],
        boom_length=CAT.links["stick"].position[0], stick_length=stick[0],
        tool_offset=(1.35, 0.0),
    )  # fmt: skip
    np.testing.assert_allclose(table, jacobian(geometry, HOME), atol=1e-12)


def readings():
    return HOME.copy(), np.full(4, 4e6), np.full(4, 2e6)


@pytest.mark.parametrize("kind", ["static", "dynamic"])
def test_a_lost_reading_holds_the_last_one(kind):
    felt = EndpointForce(CAT, tuple(CAT.axes), kind)
    joint, head, rod = readings()
    assert not np.any(felt.update(np.full(4, np.nan), head, rod)) and not felt.is_healthy
    before = felt.update(joint, head, rod).copy()
    assert felt.is_healthy and np.abs(before).min() > 100.0
    for bad in (np.nan, np.inf):
        head[1] = bad
        for _ in range(200):
            np.testing.assert_allclose(felt.update(joint, head, rod), before, rtol=1e-6)  # rounding
        assert not felt.is_healthy
    head[1] = 4e6
    felt.update(joint, head, rod)
    assert felt.is_healthy


def test_a_frozen_sensor_is_named():
    felt, rng = EndpointForce(CAT, tuple(CAT.axes), period=0.02), np.random.default_rng(1)
    for _ in range(30):
        joint, head, rod = readings()
        joint += 1e-3 * rng.standard_normal(4)
        head += 1e4 * rng.standard_normal(4)
        rod[[0, 1, 3]] += 1e4 * rng.standard_normal(3)
        felt.update(joint, head, rod)
    assert felt.find_constant_channels(0.5) == ("pressure_rod.stick",)
    assert felt.find_constant_channels(1.0) == ()


def test_held_samples_change_nothing():
    """At 200 Hz with samples held for four updates as at 50 Hz; bit for bit."""
    slow = EndpointForce(CAT, tuple(CAT.axes), period=0.02)
    held = EndpointForce(CAT, tuple(CAT.axes), period=0.005, every=4)
    rng = np.random.default_rng(2)
    for _ in range(50):
        joint, head, rod = readings()
        joint += 1e-3 * rng.standard_normal(4)
        expected = slow.update(joint, head, rod).copy()
        for _ in range(4):
            assert held.update(joint, head, rod).tolist() == expected.tolist()
            joint = joint.copy()


def test_axes_may_come_in_any_order():
    axes = tuple(CAT.axes)
    turned = [2, 0, 3, 1]
    one, other = EndpointForce(CAT, axes), EndpointForce(CAT, [axes[i] for i in turned])
    joint, head, rod = readings()
    head += np.arange(4) * 1e5
    a, b = one.update(joint, head, rod), other.update(joint[turned], head[turned], rod[turned])
    assert a.tolist() == b.tolist()


@pytest.mark.parametrize(
    ("tool", "keys", "message"),
    [
        ("grapple", {}, "grapple_pitch, grapple_roll"),
        ("bucket", {"axes": ("swing", "boom", "stick")}, "readings of bucket are missing"),
        ("bucket", {"kind": "exact"}, "static or dynamic"),
        ("bucket", {"bandwidth": 60.0}, "quarter"),
        ("bucket", {"every": 0}, "quarter"),
    ],
)
def test_what_cannot_be_felt_is_refused(tool, keys, message):
    machine = load_machine("cat215", tool)
    with pytest.raises(InputError, match=message):
        EndpointForce(machine, **{"axes": tuple(machine.axes)} | keys)


def test_a_machine_without_arm_is_refused():
    machine = load_machine("emps")
    with pytest.raises(InputError, match="has no arm"):
        EndpointForce(machine, tuple(machine.axes))


def test_a_log_without_pressures_is_refused():
    time = np.arange(20) * 0.02
    names = [f"angle.{axis}" for axis in CAT.axes]
    log = Log(time, {n: np.zeros(20) for n in names}, dict.fromkeys(names, "rad"))
    with pytest.raises(InputError, match=r"pressure_head\.swing"):
        endpoint_force_of_log(CAT, log)
