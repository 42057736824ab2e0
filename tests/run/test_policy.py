"""Policies in runs: the same control as in environments, files of all kinds, and messages for what is wrong."""

import json
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from hydrotele.cli.run_command import TRAINING_FILE, PolicyChoice, with_policy
from hydrotele.core.errors import InputError
from hydrotele.envs.gymnasium_env import MachineEnv
from hydrotele.run.policy import allow_policy, load_policy
from hydrotele.run.run import prepare_run, run_scenario
from hydrotele.scenario.scenario import Scenario, load_scenario, save_scenario

ACTIONS = ("valve", "joint_rate", "resolved_motion")
RIG = {"name": "t", "machine": "rig", "duration": 1.0, "ground": False}


def write_policy(folder: Path, text: str, name: str = "mine.py") -> None:
    (folder / name).write_text("import numpy as np\n" + text, encoding="utf-8")


def rig_scenario(folder: Path, **pilot) -> Scenario:
    spec = {"kind": "policy", "policy": "mine.py:act", **pilot}
    allow_policy("mine.py:act", str(folder))
    return Scenario.model_validate({**RIG, "folder": str(folder), "pilot": spec})


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("task", ["StraightLine", pytest.param("ReachFeller", marks=pytest.mark.nightly)])
def test_a_run_and_an_environment_with_the_same_actions_give_the_same_bits(task, action, monkeypatch):
    env = MachineEnv(task, variants=1, action=action, duration=2.0)
    setup = env.core.setup
    count = len(setup.axes)
    actions = np.repeat(np.random.default_rng(5).uniform(-1, 1, (10, count)), 10, axis=0).astype(np.float32)
    expected = [env.reset(seed=0)[0], *(env.step(action)[0] for action in actions[:99])]
    kinds = ("angle", "rate", "pressure_head", "pressure_rod", "pressure_supply", "tip", "command")
    names = [field.name for field in setup.fields if field.name.partition(".")[0] in kinds]
    received = []

    def act(observation):
        received.append(observation.copy())
        return actions[len(received) - 1]

    monkeypatch.setitem(sys.modules, "policy_of_test", type(sys)("policy_of_test"))
    sys.modules["policy_of_test"].act = act
    start = setup.task.start(setup.machine, np.random.default_rng([0, 0]))
    joints = {setup.machine.axes[name].joint: value for name, value in start.items()}
    pilot = {
        "kind": "policy", "policy": "policy_of_test:act", "observation": names, "axes": setup.axes, "action": action,
        "pose_rates": setup.task.pose_rates,
    }  # fmt: skip
    run_scenario(Scenario.model_validate({
        "name": "t", "machine": setup.machine.name, "tool": setup.machine.tool, "duration": 2.0, "ground": False,
        "start": {"joints": joints}, "servo": setup.task.servo, "pilot": pilot,
    }))  # fmt: skip
    assert np.array_equal(np.array(expected)[:, : len(names)], np.array(received))
    env.close()


def test_a_python_function_follows_the_motion_of_the_scenario(tmp_path):
    """A joint controller on the rig; a saved scenario repeats the run bit for bit."""
    write_policy(
        tmp_path, "FULL = 0.3\ndef act(s):\n    return (s.reference_rate + 4 * (s.reference - s.position)) / FULL\n"
    )
    points = [{"duration": 0.8, "joints": {"slide": 0.3}}]
    scenario = rig_scenario(tmp_path, reference={"kind": "waypoints", "settle": 0.1, "points": points}, rate=100.0)
    run = run_scenario(scenario)
    assert run.summary["tracking"]["slide"]["rms"] < 0.02
    assert np.abs(run.truth["command.slide"]).max() > 0.1 and run.plan.goal is not None
    save_scenario(scenario, tmp_path / "again.yaml")
    again = run_scenario(load_scenario(tmp_path / "again.yaml"))
    assert np.array_equal(again.truth["position.slide"], run.truth["position.slide"])


def test_attributes_of_the_program_are_defaults_and_the_scenario_has_precedence(tmp_path):
    text = "class act:\n    action, rate = 'joint_rate', 25.0\n    calls = []\n"
    text += "    def begin(self, machine, axes):\n        self.calls.append((machine.name, tuple(axes)))\n"
    text += "    def __call__(self, state):\n        self.calls.append(state.time)\n        return [0.1]\n"
    write_policy(tmp_path, text)
    run_scenario(rig_scenario(tmp_path))
    calls = load_policy("mine.py:act", str(tmp_path)).act.calls
    assert calls[0] == ("rig", ("slide",)) and calls[1:] == pytest.approx(np.arange(25) / 25.0)
    calls.clear()
    run_scenario(rig_scenario(tmp_path, rate=50.0))
    assert len(calls) == 51


def test_observations_by_name(tmp_path):
    """Readings, references now and later, in the order of the list."""
    write_policy(tmp_path, "seen = []\ndef act(o):\n    seen.append(o)\n    return [0.2]\n")
    names = ["position.slide", "reference.slide", "reference_in_100_ms.slide", "reference_rate.slide", "command.slide"]
    names += ["pressure_head.slide", "pressure_rod.slide", "pressure_supply", "rate.slide"]
    points = [{"duration": 0.8, "joints": {"slide": 0.3}}]
    reference = {"kind": "waypoints", "settle": 0.1, "points": points}
    run = run_scenario(rig_scenario(tmp_path, observation=names, reference=reference))
    seen = np.array(load_policy("mine.py:act", str(tmp_path)).act.__globals__["seen"])
    assert seen.dtype == np.float32 and seen.shape == (50, len(names))
    goal = run.plan.goal[::4, 0].astype(np.float32)
    assert np.array_equal(seen[:, 1], goal) and np.array_equal(seen[:-5, 2], goal[5:])
    assert seen[5:, 4] == pytest.approx(0.2)
    assert seen[:, 3] == pytest.approx(np.gradient(run.plan.goal[:, 0], 0.005)[::4], abs=2e-3)


@pytest.mark.parametrize(
    ("text", "pilot", "said"),
    [
        ("def act(s):\n    return [0.0, 0.0]\n", {}, "returned .* 1 finite actions are needed: slide"),
        ("def act(s):\n    return [np.nan]\n", {}, "returned .nan. at 0 s"),
        ("def act(s):\n    return s.speed\n", {}, "failed at 0 s: AttributeError"),
        ("def act(s):\n    return [0.0]\n", {"rate": 30.0}, "30 Hz must divide control_rate"),
        ("def act(s):\n    return [0.0]\n", {"observation": ["log.r"]}, "'log.r': is not a value of a scenario"),
        ("def act(s):\n    return [0.0]\n", {"observation": ["reference.slide"]}, "has no reference"),
        ("def act(s):\n    return [0.0]\n", {"axes": ["boom"]}, "'boom' is not an axis"),
        ("def act(s):\n    return [0.0]\n", {"action": "resolved_motion"}, "arm"),
        ("act = 3\n", {}, "is not a function"),
        ("class act:\n    def __init__(self, x):\n        pass\n", {}, "without arguments"),
        ("def act(s):\n    return [0.0]\nact.rate = 'fast'\n", {}, "rate"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, text, pilot, said):
    write_policy(tmp_path, text)
    with pytest.raises(InputError, match=said):
        run_scenario(rig_scenario(tmp_path, **pilot))


def test_a_scenario_file_alone_cannot_run_code(tmp_path, monkeypatch):
    """Neither run nor validate: the file may be somebody else's. Naming the program allows it and keeps the keys."""
    monkeypatch.chdir(tmp_path)
    write_policy(tmp_path, "open('executed', 'w').close()\ndef act(s):\n    return [0.1]\n", "other.py")
    text = (
        "{name: t, machine: rig, duration: 1.0, ground: false, pilot: {kind: policy, policy: 'other.py:act', rate: 20}}"
    )
    (tmp_path / "s.yaml").write_text(text)
    scenario = load_scenario(tmp_path / "s.yaml")
    for name in ("other.py:act", "x.zip", "x.pt", "json:loads"):
        pilot = scenario.pilot.model_copy(update={"policy": name})
        with pytest.raises(InputError, match="can run any code.*--policy"):
            prepare_run(scenario.model_copy(update={"pilot": pilot}))
    assert not (tmp_path / "executed").exists()
    chosen = with_policy(scenario, PolicyChoice(str(tmp_path / "other.py") + ":act", None))
    assert chosen.pilot.rate == 20.0
    prepare_run(chosen)
    assert (tmp_path / "executed").exists()


def test_unusable_files_are_refused(tmp_path):
    for suffix, said in ((".zip", "not a file of stable-baselines3"), (".onnx", "not a usable ONNX file")):
        (tmp_path / f"bad{suffix}").write_text("junk")
        with pytest.raises(InputError, match=said):
            load_policy(f"bad{suffix}", str(tmp_path))
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("data", json.dumps({"learning_rate": 1.0}))
    with pytest.raises(InputError, match="was not written by one of PPO, SAC, TD3, A2C"):
        load_policy("other.zip", str(tmp_path))
    with pytest.raises(InputError, match="no such policy file"):
        load_policy("missing.pt", str(tmp_path))
    with pytest.raises(InputError, match="is not a file .*no plug-in is installed|plug-ins: "):
        load_policy("nothing")


def write_onnx(path: Path, weights: np.ndarray) -> None:
    """Write an ONNX model with one linear layer."""
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    ends = [helper.make_tensor_value_info(n, kind, [None, s]) for n, s in zip("xy", weights.shape, strict=True)]
    node = helper.make_node("MatMul", ["x", "w"], ["y"])
    graph = helper.make_graph([node], "g", ends[:1], ends[1:], [onnx.numpy_helper.from_array(weights, "w")])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)


def test_an_onnx_policy_of_a_task_follows_a_scenario(tmp_path):
    """Proportional joint control as an ONNX file with the observation of TrackTrajectory."""
    pytest.importorskip("onnxruntime")
    env = MachineEnv("TrackTrajectory", variants=1)
    names = [field.name for field in env.core.setup.fields]
    env.close()
    weights = np.zeros((len(names), 3), np.float32)
    for column, axis in enumerate(("swing", "boom", "stick")):
        gain = -4.0 if axis == "stick" else 4.0  # a longer cylinder of the stick reduces the angle
        weights[names.index(f"reference.{axis}"), column] = gain
        weights[names.index(f"angle.{axis}"), column] = -gain
    write_onnx(tmp_path / "net.onnx", weights)
    scenario = load_scenario("excitation", {"duration": "3.0", "sensors": "ideal"})
    chosen = with_policy(scenario, PolicyChoice(str(tmp_path / "net.onnx"), "hydrotele/TrackTrajectory-v0"))
    assert chosen.pilot.observation == tuple(names) and chosen.pilot.reference == scenario.pilot
    run = run_scenario(chosen)
    closed = with_policy(scenario, PolicyChoice(str(tmp_path / "net.onnx"), "TrackTrajectory"))
    write_onnx(tmp_path / "net.onnx", 0.0 * weights)
    still = run_scenario(closed)
    errors = [sum(one["rms"] for one in each.summary["tracking"].values()) for each in (run, still)]
    assert errors[0] < 0.6 * errors[1], "the policy tracks the reference, closed valves do not"
    write_onnx(tmp_path / "net.onnx", weights[:7])
    with pytest.raises(InputError, match="needs an observation of 7 values, but 35 are listed"):
        run_scenario(chosen)
    with pytest.raises(InputError, match="say what it observes"):
        run_scenario(with_policy(scenario, PolicyChoice(str(tmp_path / "net.onnx"), None)))


def test_the_task_of_a_trained_policy_is_read_from_its_folder(tmp_path):
    (tmp_path / "net.onnx").write_text("")
    plan = {"task": "hydrotele/TrackTrajectory-v0", "options": {"action": "joint_rate", "control_rate": 25.0}}
    (tmp_path / TRAINING_FILE).write_text(json.dumps({"plan": plan}))
    pilot = with_policy(load_scenario("excitation"), PolicyChoice(str(tmp_path / "net.onnx"), None)).pilot
    assert (pilot.action, pilot.rate, len(pilot.observation)) == ("joint_rate", 25.0, 35)
    (tmp_path / TRAINING_FILE).write_text("{}")
    with pytest.raises(InputError, match="training.json: is damaged"):
        with_policy(load_scenario("excitation"), PolicyChoice(str(tmp_path / "net.onnx"), None))
