"""Pictures and windows of environments: what they show, where they come from, what they refuse."""

import os
import shutil
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import AddRenderObservation, RenderCollection

import hydrotele.envs
from hydrotele.core.errors import InputError
from hydrotele.envs.gymnasium_env import MachineEnv, MachineVectorEnv
from hydrotele.envs.rendering import TaskRenderer, make_goal_markers
from hydrotele.show.offscreen_renderer import Canvas


def set_nightly(cases, daily):
    """The cases of a parametrised test; those that are not in `daily` run nightly."""
    return [c if c in daily else pytest.param(c, marks=pytest.mark.nightly) for c in cases]


SMALL = {"width": 80, "height": 60, "variants": 2, "duration": 0.2}
_CHECKED = """
import sys, warnings
warnings.simplefilter("error")
import gymnasium
from gymnasium.utils.env_checker import check_env
import hydrotele.envs
options = {"render_mode": "human", "width": 80, "height": 60, "variants": 1}
env = gymnasium.make("hydrotele/TrackTrajectory-v0", **options).unwrapped
if sys.argv[1] == "check":
    env.metadata = env.metadata | {"render_modes": ["human"]}  # pictures have a test of their own
    check_env(env)
else:
    env.reset(seed=1)
    env.step(env.action_space.sample())
    assert env.render() is None
env.close()
print("clean")
"""


@pytest.fixture(scope="module", autouse=True)
def _renderer():
    """Skip where this machine cannot draw."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    try:
        Canvas(model, 8, 8).close()
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture
def env():
    env = MachineEnv("TrackTrajectory", "rgb_array", action="joint_rate", **SMALL)
    env.reset(seed=4)
    yield env
    env.close()


DRAWN = ("TrackTrajectory", "PlaceLog")  # daily; their machines and goals differ most


@pytest.mark.nightly
def test_any_thread_may_render():
    env = MachineEnv("TrackTrajectory", render_mode="rgb_array", variants=1, width=64, height=48)
    env.reset(seed=0)
    with ThreadPoolExecutor(2) as pool:
        images = [env.render(), *pool.map(lambda _: env.render(), range(2)), env.render()]
    assert images[0].std() > 1.0
    for image in images[1:]:
        np.testing.assert_array_equal(image, images[0])
    with ThreadPoolExecutor(1) as pool:
        pool.submit(env.close).result()


@pytest.mark.nightly
@pytest.mark.parametrize("name", set_nightly(hydrotele.envs.TASK_NAMES, DRAWN))
def test_a_picture_of_every_task_shows_machine_and_goal_and_changes_with_them(name):
    """The same picture without the goal's markers is another one."""
    options = SMALL | {"duration": 5.0, "width": 160, "height": 120}
    env = MachineEnv(name, "rgb_array", action="joint_rate", **options)
    env.reset(seed=1)
    first = env.render()
    assert first.shape == (120, 160, 3) and first.dtype == np.uint8
    red, green, blue = np.moveaxis(first.astype(float), -1, 0)
    yellow = (red > 120) & (green > 0.5 * red) & (blue < 0.4 * red)
    assert 0.01 < yellow.mean() < 0.5
    again = env.render()
    assert np.array_equal(again, first) and not np.shares_memory(again, first)
    stage = TaskRenderer(env.core)
    canvas = Canvas(stage.model, 160, 120)
    stage.update()
    bare = canvas.draw(stage.model, stage.data, stage.find_camera())
    assert (bare != first).any()
    marked = canvas.draw(stage.model, stage.data, stage.find_camera(), stage.make_markers())
    assert np.array_equal(marked, first)
    canvas.close()
    for _ in range(50):
        _, _, terminated, truncated, _ = env.step(np.ones(env.action_space.shape, np.float32))
        if terminated or truncated:
            break
    assert (env.render() != first).any(axis=2).mean() > 0.01
    env.close()


@pytest.mark.parametrize("name", hydrotele.envs.TASK_NAMES)
def test_every_task_marks_its_goal(name):
    env = MachineEnv(name, action="joint_rate", **SMALL)
    env.reset(seed=1)
    assert TaskRenderer(env.core).make_markers()
    env.close()


def test_the_drawn_machine_stands_where_the_simulated_one_does(env):
    for _ in range(5):
        env.step(np.array([1.0, -1.0, 0.5], np.float32))
    stage = TaskRenderer(env.core)
    stage.update()
    model, data = env.core.copy_model_and_data()
    for body in range(model.nbody):
        drawn = stage.data.body(model.body(body).name).xpos
        assert np.array_equal(drawn, data.xpos[body])


def test_the_goal_starts_at_the_tip_and_goes_where_the_reference_does(env):
    ball, off, *way = make_goal_markers(env.core, 0)
    tip = env.core.episodes["tip"][0]
    # float arithmetic of closed kinematics against MuJoCo's pins, which open by 0.1 mm
    assert ball.start == pytest.approx(tip, abs=2e-3)
    assert np.array_equal(off.end, ball.start) and np.array_equal(way[0].start, ball.start)
    gaps = [np.linalg.norm(a.end - b.start) for a, b in zip(way[:-1], way[1:], strict=True)]
    assert max(gaps) == 0.0 and len(way) > 10


@pytest.mark.nightly
def test_each_episode_is_drawn_with_its_own_machine():
    """Boom cylinders with base pins in other places, among them those of one that is not first."""
    ranges = {"x": [-0.05, 0.05], "z": [-0.05, 0.05]}
    worn = {"name": "pin_offset", "location": "boom", "parameters": ranges}
    env = MachineVectorEnv("TrackTrajectory", 8, randomise=[worn], **SMALL)
    env.reset(seed=2)
    stage, pins = TaskRenderer(env.core), set()
    for number in range(8):
        stage.update(number)
        model, data = env.core.copy_model_and_data(number)
        for body in range(model.nbody):
            drawn = stage.data.body(model.body(body).name).xpos
            assert np.array_equal(drawn, data.xpos[body])
        pins.add(stage.data.body("boom_tube").xpos[0])
    assert len(pins) > 1
    env.close()


@pytest.mark.nightly
def test_pictures_of_the_first_environments():
    env = MachineVectorEnv("TrackTrajectory", 8, "rgb_array", render_count=2, **SMALL)
    env.reset(seed=2)
    frames = env.render()
    assert isinstance(frames, tuple) and len(frames) == 2
    assert all(frame.shape == (60, 80, 3) for frame in frames)
    assert (frames[0] != frames[1]).any()
    env.close()


def test_batched_pictures_are_the_single_ones():
    many = MachineVectorEnv("TrackTrajectory", 2, "rgb_array", **SMALL)
    one = MachineEnv("TrackTrajectory", "rgb_array", **SMALL)
    many.reset(seed=6)
    for number, frame in enumerate(many.render()):
        one.reset(seed=6 + number)
        assert np.array_equal(one.render(), frame)
    many.close()
    one.close()


@pytest.mark.nightly
@pytest.mark.parametrize("name", set_nightly(DRAWN, ["TrackTrajectory"]))
def test_the_checker_of_gymnasium_sees_pictures(name):
    options = {"render_mode": "rgb_array", "width": 40, "height": 30, "variants": 1}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(f"hydrotele/{name}-v0", **options).unwrapped
        env.metadata = env.metadata | {"render_modes": ["rgb_array"]}
        check_env(env)
        env.close()


@pytest.mark.nightly
@pytest.mark.parametrize("what", ["step", pytest.param("check", marks=pytest.mark.nightly)])
def test_windows(what):
    """On a screen of its own, where every warning is an error; nightly gymnasium's checker."""
    if not shutil.which("xvfb-run"):
        pytest.skip("there is no xvfb-run for a window")
    environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    done = subprocess.run(
        ["xvfb-run", "-a", sys.executable, "-c", _CHECKED, what],
        env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0 and done.stdout.split() == ["clean"], done.stderr


@pytest.fixture(scope="module")
def of_free_camera():
    env = MachineEnv("TrackTrajectory", "rgb_array", action="joint_rate", **SMALL)
    env.reset(seed=4)
    yield env.render()
    env.close()


@pytest.mark.nightly
@pytest.mark.parametrize("camera", set_nightly(["overview", "cab", 0, "free"], ["cab", 0, "free"]))
def test_cameras_of_the_machine(camera, of_free_camera):
    other = MachineEnv("TrackTrajectory", "rgb_array", camera=camera, **SMALL)
    other.reset(seed=4)
    assert (other.render() != of_free_camera).any() == (camera != "free")
    other.close()


@pytest.mark.nightly
def test_wrappers_of_gymnasium_get_frames():
    make = {"render_mode": "rgb_array", **SMALL}
    env = RenderCollection(gymnasium.make("hydrotele/TrackTrajectory-v0", **make))
    env.reset(seed=1)
    env.step(env.action_space.sample())
    frames = env.render()
    assert len(frames) == 2 and frames[0].shape == (60, 80, 3)
    env.close()
    env = AddRenderObservation(gymnasium.make("hydrotele/TrackTrajectory-v0", **make))
    assert env.reset(seed=1)[0] in env.observation_space
    env.close()


def test_pictures_per_second_are_the_steps():
    env = MachineEnv("TrackTrajectory", control_rate=20.0, variants=1)
    assert env.metadata["render_fps"] == 20
    env.close()


def test_without_a_mode_there_is_no_picture():
    env = MachineEnv("TrackTrajectory", variants=1)
    env.reset(seed=1)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None
    env.close()


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"camera": "drone"}, "choose one of overview, side, cab, free"),
        ({"width": 0}, "must be 1 to"),
        ({"height": 100_000}, "must be 1 to"),
        ({"render_mode": "depth"}, "choose one of rgb_array, human"),
    ],
)
def test_what_cannot_be_drawn_is_refused(choices, message):
    options = {"render_mode": "rgb_array", **SMALL} | choices
    with pytest.raises(InputError, match=message):
        env = MachineEnv("TrackTrajectory", **options)
        env.reset(seed=1)
        env.render()


def test_a_window_without_a_screen_is_refused(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match="no screen.*rgb_array.*xvfb-run"):
        MachineEnv("TrackTrajectory", "human", variants=1)


@pytest.mark.nightly
def test_nothing_is_drawn_unasked_and_no_driver_says_what_to_install():
    """In a process of its own, whose OpenGL is one that Linux does not have.

    An environment that is stepped without pictures brings no OpenGL along.
    """
    code = (
        "import sys\nfrom hydrotele.envs.gymnasium_env import MachineEnv\n"
        "env = MachineEnv('TrackTrajectory', variants=1)\nenv.reset(seed=1)\n"
        "env.step(env.action_space.sample())\nprint('OpenGL' in sys.modules)\n"
        "env = MachineEnv('TrackTrajectory', 'rgb_array', variants=1); env.reset(seed=1)\n"
        "try:\n env.render()\nexcept ValueError as error: print(error)"
    )
    hidden = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    environment = {k: v for k, v in os.environ.items() if k not in hidden}
    environment["PYOPENGL_PLATFORM"] = "wgl"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    unasked, _, message = done.stdout.partition("\n")
    assert unasked == "False"
    assert "libegl1" in message and "MUJOCO_GL=osmesa" in message
