"""The flotor in MuJoCo: coils, stops, nothing blows up, and what a turning cab does to it."""

import mujoco
import numpy as np
import pytest

from hydrotele.machine.joystick import load_joystick
from hydrotele.simulate.joystick import SimulatedFlotor, joystick_spec
from hydrotele.teleop.coils import make_three_station_coils
from hydrotele.teleop.levitation import quaternion_to_rotation_vector

JOYSTICK = load_joystick()
REST = np.zeros(6)


def lifting(flotor):
    """Currents that carry the flotor's weight and leave it without torque about its handle."""
    f, c = JOYSTICK.flotor, JOYSTICK.coils
    weight = np.array([0.0, 0.0, 9.81 * f.mass, 0.0, 0.0, 0.0])
    coils = make_three_station_coils(c.radius, c.force_per_ampere, c.max_current)
    assert flotor.model.nu == 6
    return coils.compute_currents(weight).value


def test_coils_push_as_their_map_says():
    flotor = SimulatedFlotor(JOYSTICK, hand=False)
    f, c = JOYSTICK.flotor, JOYSTICK.coils
    made = np.empty((6, 6))
    for k in range(6):
        flotor.data.ctrl[:] = np.eye(6)[k]
        mujoco.mj_forward(flotor.model, flotor.data)
        made[:, k] = flotor.data.qfrc_actuator
    expected = make_three_station_coils(c.radius, c.force_per_ampere, c.max_current).wrench_map
    expected[3:] -= np.cross(f.handle, expected[:3], axis=0)  # about the handle, as MuJoCo counts
    np.testing.assert_allclose(made, expected, atol=1e-12)


@pytest.mark.parametrize("speed", [0.1, 0.3])
def test_a_hand_does_not_push_it_through_a_stop(speed):
    """A hit at the speed of a hand goes half as deep as the stop's 5 ms at that speed."""
    flotor = SimulatedFlotor(JOYSTICK)
    flotor.data.qvel[0], deepest = speed, 0.0
    for _ in range(40):
        flotor.step(lifting(flotor), REST)
        deepest = max(deepest, coils_moved(flotor)[0])
    assert deepest < 5e-3 + 0.5 * 5e-3 * speed, deepest


def test_random_currents_break_nothing():
    """10 s of currents anywhere within their limits, with and without a hand: no warning.

    Nobody drives it so: all coils upwards throw 0.85 kg with 96 N through 10 mm, and it meets a
    stop at 1.5 m/s, 3.8 mm per step of 2.5 ms. Two such steps make a stop of 5 ms. A wall at the
    coils, below the centre of mass, turns what it stops: by 6 deg more in two steps at 20 rad/s.
    """
    rng = np.random.default_rng(6)
    for hand in (False, True):
        flotor = SimulatedFlotor(JOYSTICK, hand=hand)
        data, most = flotor.data, np.zeros(2)
        for _ in range(2000):
            flotor.step(rng.uniform(-4.0, 4.0, 6), REST)
            turned = np.linalg.norm(quaternion_to_rotation_vector(data.qpos[3:7]))
            most = np.maximum(most, [np.abs(coils_moved(flotor)).max(), turned])
        assert not np.any(data.warning.number) and np.isfinite(data.qpos).all()
        assert 5e-3 < most[0] < 13e-3 and np.deg2rad(7.0) < most[1] < np.deg2rad(14.0), most


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_stops_hold_20_newton(axis, way):
    """At rest they give way by 0.08 mm and 0.05 deg: 20 N on the coils, or 2 N m.

    A stop takes 95 to 99 % of a push at once and the rest over its depth (solimp).
    """
    flotor, push = SimulatedFlotor(JOYSTICK, hand=False), np.zeros(6)
    push[axis] = way * (20.0 if axis < 3 else 2.0)
    if axis < 2:  # at the height of the coils, so that it does not tilt
        push[[4, 3][axis]] = way * 20.0 * JOYSTICK.flotor.handle[2] * [-1.0, 1.0][axis]
    currents = lifting(flotor)
    flotor.model.dof_damping[:] = [20.0] * 3 + [0.2] * 3  # so that it comes to rest
    for _ in range(600):
        flotor.step(currents, push)
    if axis < 3:
        found = coils_moved(flotor)
        assert 5.0e-3 < way * found[axis] < 5.08e-3, found
    else:
        found = quaternion_to_rotation_vector(flotor.data.qpos[3:7])
        assert np.deg2rad(7.0) < way * found[axis - 3] < np.deg2rad(7.05), np.rad2deg(found)


def test_the_stop_is_at_the_coils_not_at_the_handle():
    """A push on the handle tilts the flotor about its stop: Zhu 1994, 5.1.2, "magnetic gap"."""
    flotor, push = SimulatedFlotor(JOYSTICK, hand=False), np.array([20.0, 0, 0, 0, 0, 0])
    flotor.model.dof_damping[:] = [20.0] * 3 + [0.2] * 3
    currents = lifting(flotor)
    for _ in range(600):
        flotor.step(currents, push)
    # The stop turns by no more than 7 deg; then the handle is 0.12 m sin 7 deg beyond the coils.
    beyond = flotor.data.qpos[0] - coils_moved(flotor)[0]
    assert beyond == pytest.approx(0.12 * np.sin(np.deg2rad(7.0)), rel=0.01)


def heights(rng_seed=1, periods=200, **kind):
    """Height of a handle [m] that a hand holds and a sampled spring and damper, pushed at random.

    600 N/m and 30 N s/m from differences of places, as a control does; up and down, where nothing
    else is coupled.
    """
    flotor, rng = SimulatedFlotor(JOYSTICK, **kind), np.random.default_rng(rng_seed)
    f, c, last, found = JOYSTICK.flotor, JOYSTICK.coils, 0.0, []
    coils = make_three_station_coils(c.radius, c.force_per_ampere, c.max_current)
    for _ in range(periods):
        z = float(flotor.data.qpos[2])
        wrench, muscles = np.zeros(6), np.zeros(6)
        wrench[2] = 9.81 * f.mass - 600.0 * z - 30.0 * (z - last) / flotor.period
        last = z
        muscles[2] = 9.81 * JOYSTICK.hand.mass + rng.normal(0.0, 1.5)
        flotor.step(coils.compute_currents(wrench).value, muscles)
        found.append(float(flotor.data.qpos[2]))
    return np.array(found)


def test_steps_converge_with_their_second_order():
    """Against Runge-Kutta steps of 0.3 ms: four times less with every halving.

    With the two steps of a run the error is 1.6e-4 of the motion. Plain Euler steps had 4 % of it
    at the same cost, as half a step less delay has.
    """
    exact = heights(refinement=8, runge_kutta=True)
    errors = [np.abs(heights(refinement=fine) - exact).max() for fine in (1, 2, 4)]
    assert errors[0] < 2e-4 * np.abs(exact).max(), errors
    ratios = np.array(errors[:-1]) / errors[1:]
    assert (np.abs(ratios - 4.0) < 0.1).all(), ratios


def test_held_forces_move_a_free_body_exactly():
    """A place is x + v T + f T^2 / 2 m, whatever the held force of every period is: rounding."""
    flotor, mass = SimulatedFlotor(JOYSTICK, hand=False), JOYSTICK.flotor.mass
    rng, currents, x, v = np.random.default_rng(3), lifting(flotor), 0.0, 0.0
    for _ in range(20):
        push, period = np.array([0, 0, rng.normal(0.0, 3.0), 0, 0, 0]), flotor.period
        flotor.step(currents, push)
        x, v = x + v * period + 0.5 * push[2] / mass * period**2, v + push[2] / mass * period
        assert flotor.data.qpos[2] == pytest.approx(x, rel=1e-9, abs=1e-15)
    assert abs(x) < 4e-3  # no stop was met


SLANTED = JOYSTICK.model_copy(update={"hand": JOYSTICK.hand.model_copy(update={
    "mass_shape": (1.1, 0.5, 1.2), "stiffness_shape": (2.5, 0.4, 0.6)})})  # fmt: skip


def test_an_arm_is_as_heavy_and_stiff_as_its_ellipses_say():
    """The matrices of MuJoCo with the hand less those without; only what hangs on it has weight."""
    hand, n = SLANTED.hand, 6
    found = []
    for held in (True, False):
        flotor = SimulatedFlotor(SLANTED, hand=held)
        model, data, mass, stiffness = flotor.model, flotor.data, np.zeros((n, n)), np.zeros((n, 2))
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        for k in range(2):
            data.qpos[:3] = np.eye(3)[k] * 1e-3
            mujoco.mj_forward(model, data)
            stiffness[:, k] = -data.qfrc_spring / 1e-3
        found.append((mass[:3, :3], stiffness[:2], model.body_mass.sum()))
    (m1, k1, w1), (m0, k0, w0) = found
    expected = hand.mass * np.array([[1.1, 0.5, 0.0], [0.5, 1.2, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(m1 - m0, expected, atol=1e-9)
    np.testing.assert_allclose(k1 - k0, hand.stiffness * np.array([[2.5, 0.4], [0.4, 0.6]]))
    assert w1 - w0 == pytest.approx(hand.carried_mass) and hand.carried_mass < hand.mass


def test_steps_of_a_slanted_arm_converge_with_their_second_order():
    """A push across its ellipses, in the plane, where mass and damping are coupled, too.

    Coils that carry the weight only; the hand alone brings it back.
    """
    stocky = JOYSTICK.flotor.model_copy(update={"inertia": (10.0, 10.0, 10.0)})  # hardly turns
    heavy = SLANTED.model_copy(update={"flotor": stocky})

    def places(**kind):
        flotor, rng = SimulatedFlotor(heavy, **kind), np.random.default_rng(5)
        muscles, found, currents = np.zeros(6), [], lifting(flotor)
        for _ in range(100):
            muscles[:2], muscles[2] = rng.normal(0.0, 0.3, 2), 9.81 * SLANTED.hand.carried_mass
            flotor.step(currents, muscles)
            found.append(flotor.data.qpos[:2].copy())
        return np.array(found)

    exact = places(refinement=16)
    errors = [np.abs(places(refinement=fine) - exact).max() for fine in (1, 2, 4)]
    assert np.abs(exact).max() < 4e-3 and errors[0] < 2e-3 * np.abs(exact).max(), errors
    assert (np.array(errors[:-1]) / errors[1:] > 3.5).all(), errors


def coils_moved(flotor):
    """Displacement (3,) of the coils' centre from its nominal place [m]."""
    turn, handle = np.empty(9), np.array(JOYSTICK.flotor.handle)
    mujoco.mju_quat2Mat(turn, flotor.data.qpos[3:7])
    return flotor.data.qpos[:3] + handle - turn.reshape(3, 3) @ handle


def test_a_turning_cab_does_what_it_does_in_a_whole_model():
    """0.1 s of free float in a cab that spins up, against MuJoCo with a cab of 1e9 kg m^2.

    What the flotor's own motion adds is left out: Coriolis at 0.05 m/s on average and 0.7 rad/s is
    0.07 of the 1.2 m/s^2 that push it aside, 6 %.
    """
    spin, rate, mount = 0.6, 1.5, np.array(JOYSTICK.mount)
    flotor = SimulatedFlotor(JOYSTICK, hand=False, refinement=8)
    currents = lifting(flotor)
    inside = joystick_spec(JOYSTICK, hand=False)
    world, inside.option = mujoco.MjSpec(), mujoco.MjSpec().option
    inside.visual.map.znear = world.visual.map.znear
    cab = world.worldbody.add_body(name="cab", mass=1.0, inertia=[1e9] * 3)
    cab.add_joint(name="swing", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    world.attach(inside, frame=cab.add_frame(pos=mount))
    world.option.timestep, world.option.gravity = flotor.model.opt.timestep, [0, 0, -9.81]
    model = world.compile()
    data = mujoco.MjData(model)
    data.qvel[0], data.qfrc_applied[0], data.ctrl[:] = spin, 1e9 * rate, currents
    for _ in range(40):
        flotor.step_in_cab(currents, REST, mount, data.qvel[0], rate)
        mujoco.mj_step(model, data, nstep=flotor.steps)
        if np.abs(data.qpos[1:4]).max() > 4e-3:
            break
    whole, own = data.qpos[1:], flotor.data.qpos
    far = np.abs(whole[:3]).max()
    assert far > 2e-3  # it was shaken
    assert np.abs(own[:3] - whole[:3]).max() < 0.06 * far, (own, whole)
    turned = quaternion_to_rotation_vector(whole[3:])
    assert np.abs(quaternion_to_rotation_vector(own[3:]) - turned).max() < 0.06 * np.abs(turned).max()
