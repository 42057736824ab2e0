"""Tasks in plain Python and compiled ones: single and batched alike, and messages for what is wrong."""

import importlib.metadata
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import hydrotele.envs
from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.envs.dm import load
from hydrotele.envs.episode import draw_uniform_between
from hydrotele.envs.gymnasium_env import MachineEnv, MachineVectorEnv
from hydrotele.envs.observation import ObservationField
from hydrotele.envs.python_task import PythonTask
from hydrotele.envs.task_catalogue import find_task

CUSTOM = "hydrotele/Custom-v0"
OPTIONS = {"variants": 3, "duration": 1.0}


class LevelTip(PythonTask):
    """Bring the tip to a height."""

    machine, tool, action = "cat215", "bucket", "joint_rate"
    observation = (ObservationField("height_error", "m", -5.0, 5.0),)
    measures = (("height_error", "m"),)

    def start(self, machine, rng):
        return {"boom": rng.uniform(0.2, 0.5)}

    def reset(self, rng):
        return [rng.uniform(1.0, 3.0)]

    def observe(self, state):
        return [state.goal[0] - state.tip_pose[2]]

    def reward(self, state, action):
        state.goal[1] += 1.0  # counts the steps
        state.measures[0] = abs(state.goal[0] - state.true_tip[2])
        return -state.measures[0] - 1e-3 * float(np.square(action).sum()) - 1e-6 * state.work

    def terminated(self, state):
        return state.goal[1] >= 30.0


@compiled
def draw_height(rng):
    return np.array([draw_uniform_between(rng, 1.0, 3.0)])


@compiled
def observe_height(state):
    return np.array([state.goal[0] - state.tip_pose[2]])


@compiled
def height_reward(state, action):
    state.goal[1] += 1.0
    state.measures[0] = abs(state.goal[0] - state.true_tip[2])
    return -state.measures[0] - 1e-3 * np.square(action).sum() - 1e-6 * state.work


@compiled
def has_ended(state):
    return state.goal[1] >= 30.0


class LevelTipCompiled(LevelTip):
    """The same with compiled functions."""

    reset, observe = staticmethod(draw_height), staticmethod(observe_height)
    reward, terminated = staticmethod(height_reward), staticmethod(has_ended)


@pytest.fixture(params=[LevelTip, LevelTipCompiled], ids=["plain", "compiled"])
def task(request):
    return request.param


def actions(count: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(-1.0, 1.0, (count, 4)).astype(np.float32)


def test_gymnasium_accepts_it(task):
    env = gymnasium.make(CUSTOM, task=task, **OPTIONS)
    assert [field.name for field in env.unwrapped.core.setup.fields][-1] == "height_error"
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("mode", ["Disabled", "NextStep", "SameStep"])
def test_a_batch_gives_the_same_bits_as_a_single_one(task, mode):
    """Three steps after the end of an episode in every mode of gymnasium; environment 1 of a batch and a single one."""
    one = MachineEnv(task, **OPTIONS)
    many = MachineVectorEnv(task, num_envs=3, autoreset_mode=mode, **OPTIONS)
    seen, _ = one.reset(seed=8)
    assert np.array_equal(many.reset(seed=7)[0][1], seen)
    over = False
    for action in actions(70):
        batch = np.tile(action, (3, 1))
        if over and mode == "Disabled":
            many.reset(options={"reset_mask": np.array([False, True, False])})
            assert np.array_equal(many.core.observation[1], one.reset()[0])
            over = False
            continue
        rows, rewards, terminated, truncated, infos = many.step(batch)
        if over:  # NextStep: this step resets
            assert np.array_equal(rows[1], one.reset()[0]) and rewards[1] == 0.0
            over = False
            continue
        seen, reward, ended, late, info = one.step(action)
        assert (rewards[1], terminated[1], truncated[1]) == (reward, ended, late)
        over = ended or late
        if over and mode == "SameStep":
            assert np.array_equal(infos["final_obs"][1], seen)
            assert infos["final_info"]["height_error"][1] == info["height_error"]
            seen, over = one.reset()[0], False
        else:
            assert infos["height_error"][1] == info["height_error"]
        assert np.array_equal(rows[1], seen)
    assert many.core.episodes["episode"][1] >= 2
    one.close()
    many.close()


def test_plain_and_compiled_differ_only_in_their_random_goal():
    """With the same goal, every number is the same: of observation, reward and end."""
    plain, fast = (MachineEnv(task, **OPTIONS) for task in (LevelTip, LevelTipCompiled))
    for env in (plain, fast):
        env.reset(seed=5)
    fast.core.episodes["goal"][0] = plain.core.episodes["goal"][0]
    for action in actions(30):
        a, b = plain.step(action), fast.step(action)
        assert np.array_equal(a[0], b[0]) and a[2:4] == b[2:4]
        assert a[1] == pytest.approx(b[1], rel=1e-12)  # sums of squares in another order
    assert plain.core.episodes["work"][0] > 0.0
    plain.close()
    fast.close()


def test_work_is_that_of_lifting():
    """The work of raising the boom is at least the gain of potential energy, and less than twice as much."""

    class Raise(PythonTask):
        machine, tool, action = "cat215", "none", "joint_rate"

        def observe(self, state):
            return ()

        def reward(self, state, action):
            return state.work

    env = MachineEnv(Raise, variants=1, duration=4.0)
    env.reset(seed=0)
    mass = sum(link.mass for link in env.core.setup.machine.links.values())
    model, data = env.core.copy_model_and_data()
    before = float(model.body_mass @ data.xipos[:, 2])
    for _ in range(150):
        work = env.step(np.array([0.0, 0.6, 0.0]))[1]
    model, data = env.core.copy_model_and_data()
    gained = 9.81 * (float(model.body_mass @ data.xipos[:, 2]) - before)
    assert mass > 1000.0 and 2e4 < gained < work < 2.0 * gained
    env.close()


def test_readings_may_be_left_out():
    class Bare(LevelTip):
        with_readings = False

    env = MachineEnv(Bare, **OPTIONS)
    seen, _ = env.reset(seed=0)
    assert seen.shape == (1,)
    env.close()


@pytest.mark.parametrize(("machine", "axes"), [("rig", ("slide",)), ("ec20", ("boom", "stick"))])
def test_a_machine_without_an_arm_will_do(machine, axes):
    class Hold(PythonTask):
        def observe(self, state):
            return ()

        def reward(self, state, action):
            return -float(np.abs(state.rate).sum())

    env = MachineEnv(Hold, machine=machine, **OPTIONS)
    env.reset(seed=0)
    assert env.core.setup.axes == axes
    assert np.isfinite(env.step(np.zeros(len(axes)))[1])
    with pytest.raises(InputError, match="has no arm"):
        MachineEnv(Hold, machine=machine, action="resolved_motion")
    env.close()


def test_dm_control_runs_it():
    env = load(LevelTip, random=7, **OPTIONS)
    assert env.reset().observation["height_error"].shape == (1,)
    env.close()


def test_what_is_wrong_is_said():
    class Nothing(PythonTask):
        pass

    class TooMany(LevelTip):
        def observe(self, state):
            return [1.0, 2.0]

    class NotFinite(LevelTip):
        def observe(self, state):
            return [np.nan]

    class Half(LevelTip):
        observe = staticmethod(observe_height)

    class Argument(LevelTip):
        def __init__(self, height):
            self.height = height

    @compiled
    def observe_two(state):
        return np.zeros(2)

    class TooManyCompiled(LevelTipCompiled):
        observe = staticmethod(observe_two)

    for task, said in (
        (Nothing, r"does not define observe\(\)"), (Half, "reset, reward, terminated must be compiled"),
        (Argument, "without arguments"), (TooManyCompiled, "observe returns 2 values, but `observation` names 1"),
        (3, "neither the name of a task"), ("LevelTop", "valid: "),
    ):  # fmt: skip
        with pytest.raises(InputError, match=said):
            MachineEnv(task, **OPTIONS)
    for task, said in ((TooMany, "observe returns 2 values"), (NotFinite, "observe returns nan for height_error")):
        env = MachineEnv(task, **OPTIONS)
        with pytest.raises(InputError, match=said):
            env.reset(seed=0)
        env.close()
    with pytest.raises(InputError, match="task=MyTask"):
        gymnasium.make(CUSTOM)
    for program in (Argument(2.0), LevelTipCompiled()):  # an object needs no default; gymnasium copies it
        for _ in range(2):
            env = gymnasium.make(CUSTOM, task=program, **OPTIONS)
            env.reset(seed=0)
            env.close()


def test_plugins_are_tasks_by_name(monkeypatch):
    entries = [
        importlib.metadata.EntryPoint("Level", f"{__name__}:LevelTip", hydrotele.envs.PLUGIN_GROUP),
        importlib.metadata.EntryPoint("Bad", "math:pi", hydrotele.envs.PLUGIN_GROUP),
    ]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: entries)
    monkeypatch.setattr("hydrotele.core.plugins.Plugin.load", lambda p: LevelTip if p.name == "Level" else 3.14)
    assert find_task("Level").name == "LevelTip"
    with pytest.raises(InputError, match="plug-in Bad of the package .*3.14 is neither"):
        find_task("Bad")


def printed_code(page: str, start: str) -> str:
    """Return the Python block of a page that begins with a line."""
    text = (Path(__file__).parents[2] / "docs" / page).read_text(encoding="utf-8")
    return next(code for code in re.findall(r"```python\n(.*?)```", text, re.S) if code.startswith(start))


def test_the_task_of_the_page_runs_as_printed():
    names: dict = {}
    exec(printed_code("bring_your_own.md", "import gymnasium\nimport hydrotele as ht"), names)
    names["env"].reset(seed=0)
    names["envs"].reset(seed=0)
    assert np.isfinite(names["env"].step(np.zeros(4))[1])
    assert np.isfinite(names["envs"].step(np.zeros((64, 4)))[1]).all()
    names["env"].close()
    names["envs"].close()


def test_the_planning_example_of_the_page_runs_as_printed():
    names: dict = {}
    exec(printed_code("train.md", "import gymnasium, numpy, hydrotele.envs\n\nenv ="), names)
    assert names["returns"].std() > 0.0
    names["env"].close()
    names["plans"].close()
