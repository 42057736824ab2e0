"""A force held: what the load cell reads is what the bucket does, and where an episode ends."""

import numpy as np
import pytest

from hydrotele.envs.episode import DISABLED
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.hold_force import FAILURE_REWARD, MAX_CELL_ERROR
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.simulate.contact_forces import mark_surrounding_bodies, total_contact_force

FORCE = TASKS["HoldForce"]
COUNT = 6


def make(action: str = "resolved_motion", sensors: str = "ideal") -> TaskCore:
    options = Options(variants=4, action=action, sensors=sensors)  # pyright: ignore
    return TaskCore(FORCE, options, COUNT, 1, DISABLED)


@pytest.fixture(scope="module")
def core() -> TaskCore:
    return make()


def seen(core: TaskCore, name: str) -> np.ndarray:
    return core.observation[:, [field.name for field in core.setup.fields].index(name)]


def press(core: TaskCore, seconds: float) -> None:
    """Press with what is wanted, by the rate of the height."""
    action = np.zeros((core.count, 4))
    for _ in range(round(50 * seconds)):
        force = seen(core, "force")
        speed = np.where(force < 1.0e3, -0.08, 2.0e-6 * (force - seen(core, "reference_force")))
        action[:, 2] = speed / FORCE.pose_rates[2]
        core.step(action)


@pytest.mark.nightly
def test_the_load_cell_reads_the_contact_force_of_every_plate(core):
    core.reset(np.arange(COUNT))
    assert len(set(core.episodes["variant"].tolist())) > 1
    assert not seen(core, "force").any()
    press(core, 7.0)
    around = mark_surrounding_bodies(core.setup.variants.plant)
    plates = set()
    for n in range(COUNT):
        model, data = core.copy_model_and_data(n)
        up = total_contact_force(model, data, around)[2]
        # the slow approach of the last seconds moves a plate of 300 kg by next to nothing
        assert seen(core, "force")[n] == pytest.approx(up, rel=0.01)
        assert up > 8.0e3
        assert core.measures[n, 0] == pytest.approx(up - seen(core, "reference_force")[n], abs=400.0)
        plates.add(float(model.joint("plate_0").stiffness[0]))
        height = core.setup.variants.start_tips[core.episodes["variant"][n], 2] - model.body("plate_0").pos[2]
        assert 0.1 < height < 0.2  # 50 to 150 mm, and 50 mm from the plate's middle to its face
    assert len(plates) > 1


def test_the_load_cell_errs_by_one_per_cent_of_50_kn():
    core = make(sensors="real")
    core.reset(np.arange(COUNT))
    read = []
    for _ in range(40):
        core.step(np.zeros((COUNT, 4)))
        assert np.abs(core.measures[:, 0] + seen(core, "reference_force")).max() < 0.01
        read.append(seen(core, "force").copy())
    assert 0.9 * MAX_CELL_ERROR < np.abs(read).max() <= MAX_CELL_ERROR  # 240 uniform numbers


def test_forces_wanted_lie_in_their_range_and_change_once(core):
    core.reset(np.arange(COUNT))
    wanted = []
    for _ in range(60):
        core.reset()
        wanted.append(core.episodes["goal"][:, :3].copy())
    first, second, time = np.concatenate(wanted).T
    for force in (first, second):
        assert force.min() >= 1.0e4
        assert force.max() <= 3.5e4
        assert np.ptp(force) > 2.0e4  # of 360 draws from 25 kN
    assert np.abs(second - first).min() >= 5.0e3
    assert ((second > first).mean() > 0.3) and ((second < first).mean() > 0.3)
    assert (8.0 <= time).all() and (time <= 12.0).all()
    core.episodes["goal"][:, 2] = 0.09  # the change comes soon
    for step in range(1, 8):
        core.step(np.zeros((COUNT, 4)))
        now = 0.02 * step
        asked = core.episodes["goal"][:, 0 if now < 0.09 else 1]
        assert np.allclose(seen(core, "reference_force"), asked, rtol=1e-6)
        since = now if now < 0.09 else now - 0.09
        assert np.allclose(seen(core, "time_since_change"), since, atol=1e-6)


def test_reward_is_one_less_the_error_as_a_share(core):
    core.reset(np.arange(COUNT))
    for _ in range(3):
        press(core, 0.7)
        wanted = seen(core, "reference_force").astype(float)
        force = core.episodes["goal"][:, 3]
        expected = np.maximum(-1.0, 1.0 - np.abs(force - wanted) / wanted)
        assert np.allclose(core.reward, expected, atol=1e-6)  # float32 of what is wanted
        assert np.allclose(core.measures[:, 0], force - wanted, atol=0.01)
    assert core.reward.max() > 0.1


def test_a_tip_beside_the_plate_ends_the_episode():
    core = make("valve")
    core.reset(np.arange(COUNT))
    ended = np.zeros(COUNT, bool)
    for _ in range(300):
        core.step(np.tile([1.0, 0.2, 0.0, 0.0], (COUNT, 1)))
        new = (core.terminated != 0) & ~ended
        assert (core.reward[new] == FAILURE_REWARD).all()
        assert (core.measures[new, 3] == 1.0).all()
        assert (np.abs(core.episodes["tip"][new, :2] - [6.0, 0.0]).max(axis=1) > 1.2).all()
        ended |= new
    assert ended.all()


def test_a_hard_blow_is_an_overload():
    core = make("valve")
    core.reset(np.arange(COUNT))
    lift = np.tile([0.0, 0.5, 0.0, 0.0], (COUNT, 1))
    for _ in range(60):
        core.step(lift)
    ended = np.zeros(COUNT, bool)
    for _ in range(200):
        core.step(-2.0 * lift)
        new = (core.terminated != 0) & ~ended
        assert (core.reward[new] == FAILURE_REWARD).all()
        assert (core.measures[new, 2] == 1.0).all()
        ended |= new
    assert ended.all()
