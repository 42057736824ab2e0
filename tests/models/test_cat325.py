"""The CAT 325 feller-buncher: published numbers, closed forms, speeds, saw and grab."""

import math

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.kinematics import feller_arm
from hydrotele.kinematics.arm_dimensions import arm_geometry, feller_geometry
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.closed_loops import compute_loop_closure_error
from hydrotele.simulate.plant import build_plant, rest_state

CAT = load_machine("cat325")
PLANT = build_plant(CAT, ground=False)
ARM = ("swing", "boom", "stick", "tilt", "head")
CYLINDERS = ("boom", "stick", "tilt", "head")


def ends(axis):
    """The ends of a joint's range in the order in which a positive command passes them [rad]."""
    low, high = CAT.joints[CAT.axes[axis].joint].range
    return (high, low) if axis in ("stick", "tilt") else (low, high)


def test_numbers_are_those_of_zhu():
    """Z Tables 6.4 and 6.6; five digits of the pins in the machine file leave 1e-6 m."""
    places = {"boom": (2.2816, 0.9112), "stick": (0.9012, 2.3390), "head": (0.6340, 0.5880)}
    for name, (a, b) in places.items():
        two_bar = axis_linkage(CAT, name)
        found = sorted((two_bar.lower, two_bar.upper))
        assert found == pytest.approx(sorted((a, b)), abs=2e-6)
    bars = axis_linkage(CAT, "tilt")
    ground = np.subtract(bars.rocker_pivot, bars.output_pivot)
    line = np.subtract(bars.cylinder_base, bars.rocker_pivot)
    assert math.hypot(*ground) == pytest.approx(0.4813, abs=2e-6)
    assert math.atan2(ground[1], -ground[0]) == pytest.approx(0.1831, abs=2e-6)
    assert math.hypot(*bars.output_arm) == pytest.approx(0.5637, abs=2e-6)
    assert (bars.coupler, bars.rocker) == pytest.approx((0.6400, 0.6850))
    assert math.hypot(*line) == pytest.approx(2.3163, abs=2e-6)
    assert math.atan2(line[1], -line[0]) == pytest.approx(0.0728, abs=2e-6)
    for name, count, bore, rod in (
        ("boom", 2, 0.120, 0.085), ("stick", 1, 0.150, 0.105), ("tilt", 1, 0.150, 0.105),
        ("head", 1, 0.1524, 0.0635),
    ):  # fmt: skip
        head = count * math.pi / 4 * bore**2
        ring = count * math.pi / 4 * (bore**2 - rod**2)
        assert CAT.axes[name].cylinder.effective_areas == pytest.approx((head, ring), rel=1e-5)
    swing = CAT.axes["swing"].motor.displacement * CAT.supply.relief_pressure
    assert swing == pytest.approx(86300, rel=1e-4)


def test_masses_of_the_head_add_up():
    """2300 kg at (0.15, 0, -0.55) with its moments, the lateral place for the grab as at home.

    1 mm and 1 kg m^2: the numbers of the machine file are rounded to that.
    """
    links = [CAT.links[name] for name in ("head", "saw", "grab")]
    turned = CAT.home["grab"]
    turn = np.array([[math.cos(turned), math.sin(turned), 0.0],
                     [-math.sin(turned), math.cos(turned), 0.0], [0.0, 0.0, 1.0]])  # fmt: skip
    places = [np.array(links[0].com)] + [np.add(li.position, turn @ li.com) for li in links[1:]]
    masses = np.array([link.mass for link in links])
    middle = masses @ np.array(places) / masses.sum()
    assert masses.sum() == 2300
    assert middle == pytest.approx([0.15, 0.0, -0.55], abs=1e-3)
    moments = np.zeros(3)
    for mass, place, link in zip(masses, places, links, strict=True):
        way = place - middle
        moments += mass * (way @ way - way**2) + link.inertia
    assert moments == pytest.approx([700, 900, 500], abs=2.0)


def random_poses(count, seed=325):
    rng = np.random.default_rng(seed)
    low, high = np.array([CAT.joints[j].range or (-math.pi, math.pi) for j in ARM]).T
    for q in rng.uniform(low, high, (count, 5)):
        yield q, rest_state(PLANT, dict(zip(ARM, q, strict=True)))


def test_closed_form_puts_tip_and_head_where_mujoco_does():
    """1e-9 m: rounding of some twenty sines on 10 m, and MuJoCo's products of quaternions."""
    geometry = feller_geometry(CAT)
    lengths = (0.30, 2.20, 5.90, 2.95, 0.55, 0.35, 0.60)
    assert tuple(vars(geometry).values()) == pytest.approx(lengths, abs=1e-12)
    for q, data in random_poses(60):
        mujoco.mj_kinematics(PLANT.model, data)
        pose, tip = feller_arm.forward_kinematics(geometry, q), data.site("hydrotele_tip")
        assert pose[:3] == pytest.approx(tip.xpos, abs=1e-9)
        frame = tip.xmat.reshape(3, 3)
        assert feller_arm.tool_direction(q) == pytest.approx(frame[:, 0], abs=1e-9)
        # the head's axis leans by the attitude: its z has the cosine for height
        assert frame[2, 2] == pytest.approx(math.cos(pose.attitude), abs=1e-9)


def test_closed_form_jacobian_is_mujocos():
    geometry, model = feller_geometry(CAT), PLANT.model
    for q, data in random_poses(20, seed=6):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        table = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, table, None, model.site("hydrotele_tip").id)
        columns = [model.joint(name).dofadr[0] for name in ARM]
        # 1e-9 of metres: as the positions
        np.testing.assert_allclose(feller_arm.jacobian(geometry, q)[:3], table[:, columns], atol=1e-9)


def test_home_is_a_felling_posture():
    """Head level, saw between 0.2 and 0.5 m above the ground, stem 7 to 8 m ahead."""
    data = rest_state(PLANT)
    mujoco.mj_kinematics(PLANT.model, data)
    frame = data.body("head").xmat.reshape(3, 3)
    np.testing.assert_allclose(frame, np.eye(3), atol=1e-9)  # rounding: angles of home sum to 0
    assert 0.2 < data.body("saw").xpos[2] < 0.5
    assert 7.0 < data.site("hydrotele_tip").xpos[0] < 8.0


@pytest.mark.daily("head")
@pytest.mark.parametrize("axis", CYLINDERS)
def test_linkage_follows_the_cylinder_over_the_whole_range(axis):
    """Lengths to 1e-9 m (loops are closed to 1e-12 m); the range uses the stroke but 12 mm."""
    linkage, cylinder = axis_linkage(CAT, axis), CAT.axes[axis].cylinder
    first, last = ends(axis)
    pistons = []
    for q in np.linspace(first, last, 41):
        data = rest_state(PLANT, {axis: float(q)})
        mujoco.mj_kinematics(PLANT.model, data)
        way = data.site(f"hydrotele_{axis}_pin_b").xpos - data.body(f"{axis}_tube").xpos
        assert linkage.length(float(q)) == pytest.approx(np.linalg.norm(way), abs=1e-9)
        assert linkage.angle(linkage.length(float(q))) == pytest.approx(q, abs=1e-9)
        pistons.append(data.joint(f"{axis}_rod").qpos[0])
    assert np.all(np.diff(pistons) > 0)  # out with a positive command, in one direction
    assert 0.0 <= pistons[0] < 0.008 and 0.0 <= cylinder.stroke - pistons[-1] < 0.012


@pytest.mark.parametrize(("boom", "stick", "tilt"), [(0.35, -1.65, 1.30), (0.2, -0.7, 0.5), (1.0, -2.2, 0.0)])
def test_stands_still_with_closed_valves(boom, stick, tilt):
    """2 s; leakage of 1e-12 m^3/(s Pa) at 22 MPa: 1 mm/s of the boom's piston, 15 mm/s of the tip.

    Its arm is 0.63 m at least, the tip 9.3 m away; the start rings out within 20 mm more.
    """
    data = rest_state(PLANT, {"boom": boom, "stick": stick, "tilt": tilt})
    mujoco.mj_kinematics(PLANT.model, data)
    start = data.site("hydrotele_tip").xpos.copy()
    mujoco.mj_step(PLANT.model, data, 2000)
    assert np.linalg.norm(data.site("hydrotele_tip").xpos - start) < 0.05
    assert abs(data.joint("saw").qvel[0]) < 1e-6
    assert sum(w.number for w in data.warning) == 0


# Seconds over a joint's range at full lever, in and out: those of harvesting machines of this
# class (A): boom up in 4 to 6 s, the rest in 2 to 6 s, lowering faster than lifting.
TIMES = {
    "boom": ((4.0, 6.0), (2.5, 5.0)), "stick": ((2.0, 4.5), (3.0, 6.5)),
    "tilt": ((2.0, 5.0), (2.5, 6.5)), "head": ((1.5, 4.0), (1.5, 4.0)),
    "grab": ((0.8, 2.5), (0.8, 2.5)),
}  # fmt: skip


@pytest.mark.parametrize("command", [1.0, -1.0])
@pytest.mark.parametrize("axis", TIMES)
def test_axes_cross_their_range_the_right_way_in_time(axis, command):
    way = ends(axis)[:: int(command)]
    i, data = PLANT.axes.index(axis), rest_state(PLANT, {axis: way[0]})
    data.ctrl[i] = command
    shares = []
    for _ in range(700):
        mujoco.mj_step(PLANT.model, data, 10)
        shares.append((data.qpos[PLANT.qpos[i]] - way[0]) / (way[1] - way[0]))
        if shares[-1] > 0.98:
            break
    low, high = TIMES[axis][0 if command > 0 else 1]
    assert low < 0.01 * len(shares) < high
    assert sum(w.number for w in data.warning) == 0


def test_swing_turns_at_10_rpm():
    """Data sheet; positive to the left. 5 %: after 10 s the last of its acceleration is left."""
    data, i = rest_state(PLANT), PLANT.axes.index("swing")
    data.ctrl[i] = 1.0
    mujoco.mj_step(PLANT.model, data, 10000)
    assert data.qvel[PLANT.dof[i]] == pytest.approx(10 * math.tau / 60, rel=0.05)


def test_saw_runs_at_its_speed():
    """1100 to 1200 rpm; there its torque is used up by friction, with 7.6 rad/s^2 at standstill.

    0.02 rad/s^2: standing parts accelerate by what the closures' softness leaves.
    """
    data, dof = rest_state(PLANT), PLANT.model.joint("saw").dofadr[0]
    data.ctrl[PLANT.axes.index("saw")] = 1.0
    data.qvel[dof] = saw_speed()
    assert 1100 < saw_speed() * 60 / math.tau < 1200
    mujoco.mj_forward(PLANT.model, data)
    assert abs(data.qacc[dof]) < 0.02


def saw_speed():
    """Speed at full command [rad/s]."""
    drive = CAT.axes["saw"].force
    return (drive.gain - drive.friction.coulomb) / drive.friction.viscous


def test_spinning_saw_leans_on_the_tilt_as_a_gyroscope_does():
    """With the head tipped forward the disc's axis lies level: swinging it takes I Omega w."""
    model, rate, torques = PLANT.model, 0.5, []
    tipped = -math.pi / 2 - CAT.home["boom"] - CAT.home["stick"]
    for speed in (saw_speed(), 0.0):
        data = rest_state(PLANT, {"tilt": tipped})
        data.qvel[model.joint("swing").dofadr[0]] = rate
        data.qvel[model.joint("saw").dofadr[0]] = speed
        mujoco.mj_forward(model, data)
        torques.append(data.qfrc_bias[model.joint("tilt").dofadr[0]])
    gyroscopic = abs(torques[0] - torques[1])
    expected = CAT.links["saw"].inertia[2] * saw_speed() * rate
    assert gyroscopic == pytest.approx(expected, rel=1e-6)  # rounding; the disc is symmetric
    cylinder = CAT.axes["tilt"].cylinder
    strength = CAT.supply.relief_pressure * cylinder.area_rod
    assert gyroscopic < 0.1 * strength * abs(axis_linkage(CAT, "tilt").rate(tipped))


def test_pins_hold_in_violent_motion():
    """0.1 mm is what the project promises; at every command anew and at full speed reversed."""
    plant = build_plant(CAT, ground=True)
    model, rng, start = plant.model, np.random.default_rng(325), rest_state(plant)
    batch = Batch(model, 8, nthread=1)
    batch.qpos[:], batch.act[:] = start.qpos, start.act
    sites, widest, held = batch.bind("site_xpos"), 0.0, np.zeros((8, model.nu))
    for k in range(1500):
        if k % 250 == 0:
            held[:] = rng.choice([-1.0, 1.0], held.shape)
        batch.ctrl[:4] = rng.choice([-1.0, 1.0], (4, model.nu))
        batch.ctrl[4:] = held[4:]
        batch.step()
        gap = sites[:, model.eq_obj1id] - sites[:, model.eq_obj2id]
        widest = max(widest, np.sqrt((gap**2).sum(axis=2)).max())
    assert np.abs(batch.qvel[:, plant.dof[1]]).max() > 0.2, "the boom moves fast"
    assert 1e-7 < widest < 1e-4


def test_nothing_warns_with_the_saw_at_speed_on_the_ground():
    """5 s of reversals at full lever with the disc running, down to the ground and up again."""
    plant, opening = build_plant(CAT, ground=True), 0.0
    data = rest_state(plant)
    data.qvel[plant.model.joint("saw").dofadr[0]] = 120.0
    data.ctrl[plant.axes.index("saw")] = 1.0
    hydraulic = [plant.axes.index(a) for a in ("swing", "boom", "stick", "tilt", "head", "grab")]
    touched = 0
    for k in range(5000):
        if k % 500 == 0:
            up = 1.0 if (k // 500) % 3 else -1.0
            data.ctrl[hydraulic] = [up, up, -up, up, -up, up]
        mujoco.mj_step(plant.model, data)
        opening = max(opening, compute_loop_closure_error(plant.model, data))
        touched += data.ncon > 0
    assert touched, "it did not come down"
    assert opening < 1e-4
    assert sum(w.number for w in data.warning) == 0


def test_arm_with_a_head_is_not_taken_for_an_excavators():
    with pytest.raises(InputError, match=r"has a head \(head\).*feller_geometry"):
        arm_geometry(CAT)
    with pytest.raises(InputError, match="has no arm with a head: give arm.head"):
        feller_geometry(load_machine("cat215", "bucket"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"boom": "stick", "stick": "boom"}, "each joint must carry the next"),
        ({"head": "saw"}, r"saw must rotate about \(0, 0, -1\)"),
        ({"tip": CAT.arm.tip.model_copy(update={"link": "grab"})}, "tip must be on the head"),
        ({"tip": CAT.arm.tip.model_copy(update={"position": (0.3, 0.1, 0.0)})}, "plane y = 0"),
    ],
)
def test_arms_that_the_closed_form_does_not_know_are_refused(change, message):
    arm = CAT.arm.model_copy(update=change)
    with pytest.raises(InputError, match=message):
        feller_geometry(CAT.model_copy(update={"arm": arm}))


def test_a_head_needs_a_joint_that_is_there():
    facts = CAT.model_dump()
    for arm, message in (
        ({**facts["arm"], "head": "haed"}, "arm.head: 'haed' is not known; did you mean 'head'"),
        ({**facts["arm"], "tool": None}, "arm.head needs a tool joint"),
    ):
        with pytest.raises(ValueError, match=message):
            type(CAT).model_validate({**facts, "arm": arm})


@pytest.mark.parametrize(("axis", "ways"), [("boom", "xz"), ("tilt", "xz"), ("head", "xy")])
def test_a_pin_that_sits_elsewhere_is_moved_across_itself(axis, ways):
    """Along itself its loop would not close."""
    assert list(EFFECTS["pin_offset"].parameters(CAT, axis)) == list(ways)
    moved = apply_effect(CAT, "pin_offset", axis, dict.fromkeys(ways, 0.01))
    plant = build_plant(moved, ground=False)
    data = rest_state(plant)
    mujoco.mj_kinematics(plant.model, data)
    assert compute_loop_closure_error(plant.model, data) < 1e-9  # loops are closed to 1e-12 m
    found = data.body(f"{axis}_tube").xpos - data.body(CAT.axes[axis].cylinder.base_pin.link).xpos
    nominal = CAT.axes[axis].cylinder.base_pin.position
    assert abs(np.linalg.norm(found) - np.linalg.norm(nominal)) > 1e-3
