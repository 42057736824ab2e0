"""Cylinder linkages: published lengths, inverses, derivatives, numeric and MuJoCo loop closure."""

import math

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.linalg import null_space
from scipy.optimize import root

from hydrotele.kinematics.linkages import FourBar, LoopOpenError, TwoBar, two_bar_from_points

BOOM = TwoBar(0.625, 2.000, math.radians(78.6), 1)
STICK = TwoBar(2.444, 0.720, math.radians(10.3), -1)
BOOM_RANGE, STICK_RANGE = np.radians([-42.0, 58.9]), np.radians([-155.0, -25.0])
# Zhu Table 6.5 read as: r1 ground, r2 0.4049 bucket arm, r3 coupler, r4 rocker, L base to pivot
BUCKET = FourBar(
    output_pivot=(1.8, 0.0),
    rocker_pivot=(1.494464, 0.110488),
    cylinder_base=(-0.106478, 0.185533),
    rocker=0.5486,
    coupler=0.4849,
    output_arm=(-0.202450, 0.350654),
    assembly=1,
    working_angle=-1.0,
)
BUCKET_CLOSED, BUCKET_STROKE = 1.19, 0.92
BUCKET_RANGE = BUCKET.angle(np.array([BUCKET_CLOSED + BUCKET_STROKE, BUCKET_CLOSED]))
CASES = [(BOOM, BOOM_RANGE), (STICK, STICK_RANGE), (BUCKET, BUCKET_RANGE)]


def polar(distance, degrees):
    """Point at a distance and an angle."""
    return distance * math.cos(math.radians(degrees)), distance * math.sin(math.radians(degrees))


@pytest.mark.parametrize(("linkage", "span"), CASES)
def test_round_trip(linkage, span):
    """1e-10 is asked; the conditioning 1 / rate is at most 10 rad/m over these strokes."""
    theta = np.linspace(*span, 5001)
    np.testing.assert_allclose(linkage.angle(linkage.length(theta)), theta, rtol=0, atol=1e-10)


@pytest.mark.parametrize(("linkage", "span"), CASES)
def test_floats_and_arrays_agree(linkage, span):
    """Same formulas through math and NumPy, whose functions differ in the last place: 1e-13."""
    theta = np.linspace(*span, 12).reshape(3, 4)
    for method in (linkage.length, linkage.rate, lambda t: linkage.angle(linkage.length(t))):
        one_by_one = np.array([[method(float(t)) for t in row] for row in theta])
        assert isinstance(method(float(theta[0, 0])), float)
        np.testing.assert_allclose(method(theta), one_by_one, rtol=0, atol=1e-13)


@pytest.mark.parametrize(("linkage", "span"), CASES)
def test_rate_is_the_derivative(linkage, span):
    """Central difference, h = 1e-5: h^2 / 6 |c'''| < 1e-9 with |c'''| < 50, eps c / h < 1e-10."""
    theta, step = np.linspace(*span, 301), 1e-5
    numeric = (linkage.length(theta + step) - linkage.length(theta - step)) / (2 * step)
    np.testing.assert_allclose(linkage.rate(theta), numeric, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("linkage", "span"), CASES)
def test_virtual_work_of_a_constant_force(linkage, span):
    """F times the stroke equals the torque integrated over the angle; quad is asked for 1e-10."""
    force = 2.5e5
    torque_work, _ = quad(lambda t: force * linkage.rate(t), *span, epsrel=1e-10)
    stroke = linkage.length(float(span[1])) - linkage.length(float(span[0]))
    assert torque_work == pytest.approx(force * stroke, rel=1e-9)


def test_boom_and_stick_are_khoshzabans():
    """K Eq. 3.26 with K's signs, theta_K = -theta: one formula twice, 1e-14 is rounding."""
    theta = np.linspace(*BOOM_RANGE, 50)
    boom = np.sqrt(0.625**2 + 2.0**2 - 2 * 0.625 * 2.0 * np.cos(-theta + math.radians(-78.6)))
    np.testing.assert_allclose(BOOM.length(theta), boom, rtol=0, atol=1e-14)
    theta = np.linspace(*STICK_RANGE, 50)
    stick = np.sqrt(2.444**2 + 0.72**2 - 2 * 2.444 * 0.72 * np.cos(-theta + math.radians(10.3)))
    np.testing.assert_allclose(STICK.length(theta), stick, rtol=0, atol=1e-14)


def test_boom_stroke_ends_at_its_joint_limit():
    """Closed length 1.447 m + stroke 1.05 m is -58.9 deg in K's signs, given to 0.1 deg."""
    assert math.degrees(BOOM.angle(1.447 + 1.05)) == pytest.approx(58.9, abs=0.05)


def test_zhus_two_bars_are_khoshzabans():
    """Z Table 6.5 against K: each bar differs by 1 mm at most, so the length by 2 mm at most."""
    boom = TwoBar(0.6240, 1.9998, BOOM.angle_offset)
    stick = TwoBar(2.4436, 0.7202, STICK.angle_offset, -1)
    for ours, zhus, span in ((BOOM, boom, BOOM_RANGE), (STICK, stick, STICK_RANGE)):
        theta = np.linspace(*span, 100)
        np.testing.assert_allclose(zhus.length(theta), ours.length(theta), rtol=0, atol=2e-3)


def test_two_bars_from_the_pins_of_the_machine():
    """Pins of the CAT 215 give B = theta + 78.6 deg and B = 10.3 deg - theta; 1e-12 is rounding."""
    boom = two_bar_from_points(polar(0.625, -41.6), polar(2.000, 37.0), 0.2)
    stick = two_bar_from_points(polar(2.444, 155.3), polar(0.720, 145.0), -1.5)
    for got, want in ((boom, BOOM), (stick, STICK)):
        assert got.direction == want.direction
        np.testing.assert_allclose(
            [got.lower, got.upper, got.angle_offset],
            [want.lower, want.upper, want.angle_offset],
            rtol=0,
            atol=1e-12,
        )


@given(
    st.floats(0.3, 3.0),
    st.floats(0.3, 3.0),
    st.floats(-180, 180),
    st.floats(-180, 180),
    st.floats(-math.pi, math.pi),
)
def test_two_bar_from_any_points(base, rod, base_angle, rod_angle, theta):
    """Length is the distance of the pins, and back again, 0.6 deg off the dead line."""
    turned = math.degrees(theta) + rod_angle
    included = math.remainder(math.radians(turned - base_angle), math.tau)
    assume(0.01 < abs(included) < math.pi - 0.01)
    linkage = two_bar_from_points(polar(base, base_angle), polar(rod, rod_angle), theta)
    distance = math.dist(polar(base, base_angle), polar(rod, turned))
    assert linkage.length(theta) == pytest.approx(distance, abs=1e-13)  # rounding of metres
    assert linkage.angle(linkage.length(theta)) == pytest.approx(theta, abs=1e-10)


def test_cat215_bucket_is_a_sound_linkage():
    """About 150 deg, extending curls in, arm never below 0.1 m, rocker pin above the stick."""
    theta = np.linspace(*BUCKET_RANGE, 1001)
    assert np.degrees(BUCKET_RANGE) == pytest.approx([-137.4, 14.4], abs=0.1)  # printed digits
    assert np.all(BUCKET.rate(theta) < -0.10)
    assert np.all(BUCKET.pin_positions(theta)[1][1] > 0.3)
    assert BUCKET_STROKE < 0.95 * BUCKET_CLOSED
    assert BUCKET_CLOSED > BUCKET_STROKE + 0.25
    assert math.dist(BUCKET.output_pivot, BUCKET.rocker_pivot) == pytest.approx(0.3249, abs=1e-6)
    assert math.dist(BUCKET.rocker_pivot, BUCKET.cylinder_base) == pytest.approx(1.6027, abs=1e-6)


def test_four_bar_against_a_numeric_loop_closure():
    """The vector loop O-Q-R-P solved by scipy, each from the angles before.

    Root stops at 1e-13; the loop's Jacobian, whose determinant is rocker * coupler * sin, is
    conditioned below 100 here, so 1e-10 is safe.
    """
    output, pivot, base, arm = (
        complex(*point)
        for point in (
            BUCKET.output_pivot,
            BUCKET.rocker_pivot,
            BUCKET.cylinder_base,
            BUCKET.output_arm,
        )
    )

    def loop(angles, theta):
        q = output + arm * np.exp(1j * theta)
        gap = q + BUCKET.coupler * np.exp(1j * angles[1]) - pivot
        gap -= BUCKET.rocker * np.exp(1j * angles[0])
        return gap.real, gap.imag

    angles = np.array(BUCKET.pose(float(BUCKET_RANGE[1]))[:2]) + 0.05
    for theta in np.linspace(BUCKET_RANGE[1], BUCKET_RANGE[0], 60):
        angles = root(loop, angles, args=(theta,), tol=1e-13).x
        length = abs(pivot + BUCKET.rocker * np.exp(1j * angles[0]) - base)
        np.testing.assert_allclose(BUCKET.pose(float(theta)), [*angles, length], rtol=0, atol=1e-10)


CHAIN = """
<mujoco><option jacobian="dense"/><default><geom size="0.05" mass="5"/></default><worldbody>
  <body pos="{o[0]} 0 {o[1]}"><joint name="output" axis="0 -1 0"/><geom pos="0.5 0 0"/>
    <body pos="{q[0]} 0 {q[1]}"><joint name="coupler" axis="0 -1 0"/><geom/>
      <site name="coupler" pos="{coupler} 0 0"/></body></body>
  <body pos="{p[0]} 0 {p[1]}"><joint name="rocker" axis="0 -1 0"/><geom/>
    <site name="rocker" pos="{rocker} 0 0"/></body>
  <body pos="{b[0]} 0 {b[1]}"><joint name="tube" axis="0 -1 0"/><geom/>
    <body><joint name="rod" type="slide" axis="1 0 0"/><geom/><site name="rod"/></body></body>
</worldbody><equality>
  <connect site1="rocker" site2="coupler"/><connect site1="rocker" site2="rod"/>
</equality></mujoco>"""


def test_four_bar_against_a_mujoco_closed_chain():
    """Our pose closes MuJoCo's loop; the only motion its constraints allow has our moment arm."""
    model = mujoco.MjModel.from_xml_string(
        CHAIN.format(
            o=BUCKET.output_pivot,
            q=BUCKET.output_arm,
            p=BUCKET.rocker_pivot,
            b=BUCKET.cylinder_base,
            coupler=BUCKET.coupler,
            rocker=BUCKET.rocker,
        )
    )
    data = mujoco.MjData(model)
    address = {model.joint(i).name: i for i in range(model.njnt)}
    for theta in np.linspace(*BUCKET_RANGE, 40):
        pose, (_, rod_pin) = BUCKET.pose(float(theta)), BUCKET.pin_positions(float(theta))
        x, z = np.subtract(rod_pin, BUCKET.cylinder_base)
        data.qpos[address["output"]] = theta
        data.qpos[address["coupler"]] = pose.coupler_angle - theta
        data.qpos[address["rocker"]] = pose.rocker_angle
        data.qpos[address["tube"]] = math.atan2(z, x)
        data.qpos[address["rod"]] = pose.length
        mujoco.mj_forward(model, data)
        # 1e-14 is rounding of lengths of two metres
        np.testing.assert_allclose(data.efc_pos, 0, rtol=0, atol=1e-14)
        motion = null_space(data.efc_J.reshape(data.nefc, model.nv), rcond=1e-9)
        assert motion.shape[1] == 1
        arm = motion[address["rod"], 0] / motion[address["output"], 0]
        # 1e-12: rounding times the condition of the constraint Jacobian, below 100
        assert arm == pytest.approx(BUCKET.rate(float(theta)), abs=1e-12)
        # virtual work: a rod force balanced by the opposite torque does no work in that motion
        applied = np.zeros(model.nv)
        applied[address["rod"]] = 2.87e5
        applied[address["output"]] = -2.87e5 * BUCKET.rate(float(theta))
        assert motion[:, 0] @ applied == pytest.approx(0, abs=1e-6)  # 3e5 N times 1e-12


@given(
    st.floats(0.2, 0.5),
    st.floats(100, 170),
    st.floats(0.3, 0.7),
    st.floats(0.3, 0.7),
    st.floats(0.2, 0.5),
    st.sampled_from([1, -1]),
    st.floats(-3.0, 3.0),
)
def test_any_four_bar_round_trips(ground, direction, rocker, coupler, arm, assembly, theta):
    """Where it closes and 3 deg from dead points, so that 1 / rate is below 1e4 rad/m."""
    pivot = polar(ground, direction)
    linkage = FourBar((0.0, 0.0), pivot, (-1.8, 0.1), rocker, coupler, (arm, 0.0), assembly, working_angle=theta)
    try:
        q, r = linkage.pin_positions(theta)
    except LoopOpenError:
        low, high = abs(rocker - coupler), rocker + coupler
        assert not low < math.dist(pivot, polar(arm, math.degrees(theta))) < high
        return
    assert math.dist(q, r) == pytest.approx(coupler, abs=1e-14)  # rounding
    assert math.dist(pivot, r) == pytest.approx(rocker, abs=1e-14)
    pose = linkage.pose(theta)
    sine_dead = math.sin(pose.coupler_angle - pose.rocker_angle)
    sine_output = math.sin(pose.coupler_angle - theta)
    rod = (r[0] + 1.8, r[1] - 0.1)
    sine_rod = math.sin(math.atan2(rod[1], rod[0]) - pose.rocker_angle)
    assume(min(abs(sine_dead), abs(sine_output), abs(sine_rod)) > 0.05)
    assert linkage.angle(linkage.length(theta)) == pytest.approx(theta, abs=1e-10)


def test_errors_name_the_length_and_the_interval():
    """Every way in which a loop can stay open is refused, for floats and inside arrays."""
    with pytest.raises(LoopOpenError, match=r"3 m requested, the bars allow \[1\.375, 2\.625\] m"):
        BOOM.angle(3.0)
    with pytest.raises(LoopOpenError, match=r"1 m requested"):
        BOOM.angle(np.array([2.0, 1.0]))
    with pytest.raises(LoopOpenError):
        BOOM.angle(math.nan)
    with pytest.raises(LoopOpenError, match=r"cylinder length 2\.5 m requested"):
        BUCKET.angle(2.5)
    short = FourBar((1.8, 0.0), (1.5, 0.1), (-0.1, 0.2), 0.2, 0.2, (-0.2, 0.35), 1, 1.8)
    with pytest.raises(LoopOpenError, match="two bars join"):
        short.length(np.array([1.0, -1.0]))
    with pytest.raises(ValueError, match="in line"):
        two_bar_from_points((-1.0, 0.0), (2.0, 0.0))
    with pytest.raises(ValueError, match="direction"):
        TwoBar(1.0, 1.0, 0.0, 0)
    with pytest.raises(ValueError, match="assembly"):
        FourBar((1.8, 0.0), (1.5, 0.1), (-0.1, 0.2), 0.55, 0.48, (-0.2, 0.35), 0)


def test_limit_positions_can_be_asked_for_again():
    """Rounding of a limit position just computed is no error; the angle is loose by sqrt(eps)."""
    for included in (0.0, math.pi):
        theta = included - BOOM.angle_offset
        assert BOOM.angle(BOOM.length(theta)) == pytest.approx(theta, abs=1e-7)
