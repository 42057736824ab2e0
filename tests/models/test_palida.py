"""The hexapod PaLiDA and the Panda: plain MJCF without machine files."""

import mujoco
import numpy as np
import pytest

from hydrotele.core.files import models_folder
from hydrotele.experiments.palida import PUBLISHED_PARAMETERS, load_excitation, load_robot
from hydrotele.multibody.inverse_dynamics import project_on_drives


def compiled(name):
    return mujoco.MjModel.from_xml_path(str(models_folder() / name / f"{name}.xml"))


@pytest.mark.parametrize(("name", "share"), [("palida", 0.1), ("panda", 0.3)])
def test_steps_under_noise_without_warning(name, share):
    """1 s of seeded noise on every drive: no warning, closed pins, finite states."""
    model, rng = compiled(name), np.random.default_rng(20)
    data, opening = mujoco.MjData(model), 0.0
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    limit = share * model.actuator_ctrlrange[:, 1]
    start = data.qpos.copy()
    for step in range(round(1.0 / model.opt.timestep)):
        if step % 50 == 0:
            data.ctrl[:] = limit * rng.uniform(-1.0, 1.0, model.nu)
        mujoco.mj_step(model, data)
        held = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        opening = max(opening, np.abs(data.efc_pos[: data.nefc][held]).max(initial=0.0))
    assert not np.any(data.warning.number)
    assert np.isfinite(data.qpos).all() and np.abs(data.qpos - start).max() > 1e-3
    assert opening < 1e-4  # m, a tenth of a millimetre


def test_a_hexapod_has_19_bodies_and_the_published_base_parameters():
    chain = load_robot().setup.chain
    assert len(chain.bodies) == 19 and len(chain.closures) == 6 and len(chain.drives) == 6
    # rounding of the file's decimals
    np.testing.assert_allclose(load_robot().truth, [one.value for one in PUBLISHED_PARAMETERS], atol=1e-9)


def test_drive_forces_are_those_of_the_simulator():
    """Regressor times truth against MuJoCo's mass matrix, bias, friction and closures to 1e-8.

    Along the designed motion `M a + h + friction = S' F + J' l` is solved with MuJoCo's own M, h,
    J; rates of the platform's quaternion follow from those of its Cardan angles.
    """
    own, model = load_robot(), compiled("palida")
    motion = load_excitation()
    whole = motion.evaluate(np.linspace(0.0, motion.period, 40))
    setup = own.setup
    found, forces = (
        project_on_drives(setup.chain, setup.given_joints, *whole),
        own.matrix(whole) @ own.truth,
    )
    data, mass, worst = mujoco.MjData(model), np.zeros((24, 24)), 0.0
    selector = np.zeros((24, 6))
    selector[[model.joint(name).dofadr[0] for name in setup.chain.drives], range(6)] = 1.0
    for row in range(40):
        q, rate = found.position[row], found.rate[row]
        data.qpos[:21] = q[:21]
        mujoco.mju_euler2Quat(data.qpos[21:], q[21:], "xyz")
        spin, turned = _body_rates(q[21:], rate[21:])
        data.qvel[:] = np.concatenate([rate[:21], spin @ rate[21:]])
        after = np.concatenate([
            found.acceleration[row, :21], spin @ found.acceleration[row, 21:] + turned @ rate[21:]
        ])  # fmt: skip
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        closing = data.efc_J.reshape(-1, 24)[: data.ne]
        need = mass @ after + data.qfrc_bias + model.dof_damping * data.qvel
        need += model.dof_frictionloss * np.sign(data.qvel)
        solved = np.linalg.solve(np.column_stack([selector, closing.T]), need)
        worst = max(worst, np.abs(solved[:6] - forces[row]).max())
    assert worst < 1e-8


def _body_rates(angles, rates):
    """Angular velocity in the body's frame per rate of Cardan angles (3, 3), and its rate."""
    (_, b, c), (_, db, dc) = angles, rates
    sb, cb, sc, cc = np.sin(b), np.cos(b), np.sin(c), np.cos(c)
    spin = np.array([[cb * cc, sc, 0.0], [-cb * sc, cc, 0.0], [sb, 0.0, 1.0]])
    turned = np.array([
        [-sb * cc * db - cb * sc * dc, cc * dc, 0.0],
        [sb * sc * db - cb * cc * dc, -sc * dc, 0.0],
        [cb * db, 0.0, 0.0],
    ])  # fmt: skip
    return spin, turned
