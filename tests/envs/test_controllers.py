"""Reference controllers: they do what they are for, and see only observations."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.catalogue import (
    CONTROLLER_NAMES,
    REFERENCE_CONTROLLERS,
    make_controller,
)
from hydrotele.envs.controllers.controller import find_observation_columns
from hydrotele.envs.controllers.tracking import ReferencePreview, make_track_controller
from hydrotele.envs.episode import DISABLED, SAME_STEP
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.envs.track_trajectory import PREVIEW_TIMES, compute_axis_reference

_SHORT = Options(variants=2, duration=3.0)


def _core(autoreset=DISABLED, **choices) -> TaskCore:
    return TaskCore(TASKS["TrackTrajectory"], Options(**{**vars(_SHORT), **choices}), 4, 1, autoreset)


def _errors(core, controller) -> np.ndarray:
    """(steps, n) of the tip [m]."""
    core.reset(np.arange(core.count))
    controller.begin(core.count)
    found = []
    for _ in range(core.setup.clock.horizon):
        core.step(controller(core.observation))
        found.append(core.measures[:, 0].copy())
    return np.array(found)


@pytest.mark.daily("resolved_motion-0.3")
@pytest.mark.parametrize(
    ("action", "most"),
    # a tip at 1 m/s that is 50 ms late is off by 50 mm; rates of the tip are limited to less
    [("valve", 0.05), ("joint_rate", 0.05), ("resolved_motion", 0.3)],
)
def test_references_are_followed(action, most):
    core = _core(action=action)
    followed = _errors(core, make_track_controller(core.setup))
    left = _errors(core, make_controller("zero", core.setup))
    assert np.sqrt(np.mean(followed**2)) < min(most, 0.5 * np.sqrt(np.mean(left**2)))


def test_references_between_those_shown_are_those_of_the_task():
    core = _core()
    core.reset(np.arange(4))
    controller = make_track_controller(core.setup)
    controller.begin(4)
    for _ in range(120):  # past the fade, whose second derivative jumps
        core.step(controller(core.observation))
    preview, now = ReferencePreview(core.setup), core.episodes["tick"][0] * core.setup.clock.period
    for ahead in (0.0, 0.06, 0.3, PREVIEW_TIMES[-1]):
        place, rate = preview.interpolate(core.observation, ahead)
        for n in range(4):
            true = [compute_axis_reference.py_func(core.episodes["goal"][n], i, now + ahead) for i in (0, 1, 2)]
            # fifth derivative of 0.3 rad at 2.4 rad/s over 0.4 s: some 1e-4
            assert place[n] == pytest.approx([t[0] for t in true], abs=5e-4)
            assert rate[n] == pytest.approx([t[1] for t in true], abs=5e-3)


@pytest.mark.parametrize("action", ["valve", "joint_rate"])
def test_an_episode_begun_anew_is_controlled_as_a_first_one(action):
    core = _core(SAME_STEP, action=action, duration=0.2)
    controller = make_track_controller(core.setup)
    core.reset(np.arange(4))
    controller.begin(4)
    while not core.truncated.any():
        core.step(controller(core.observation))
    controller.reset(core.truncated != 0)
    again = controller(core.observation)
    controller.begin(4)
    assert np.array_equal(again, controller(core.observation))


def test_every_task_has_controllers_and_others_are_refused():
    assert set(REFERENCE_CONTROLLERS) <= set(TASKS)
    setup = _core().setup
    for name in CONTROLLER_NAMES:
        controller = make_controller(name, setup)
        controller.begin(3)
        shape = np.shape(controller(np.zeros((3, len(setup.fields)), np.float32)))
        assert shape == (3, len(setup.axes))
    with pytest.raises(InputError, match="pid"):
        make_controller("pid", setup)
    with pytest.raises(InputError, match="angle.boom"):
        find_observation_columns(setup, "angle", ["bom"])
