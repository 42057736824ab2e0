"""Environments with another machine or tool than that of the task."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.envs.gymnasium_env import MachineEnv
from hydrotele.machine.machine_file import load_machine, save_machine


def test_tracking_on_the_feller_buncher():
    env = MachineEnv("TrackTrajectory", machine="cat325", variants=2)
    seen, _ = env.reset(seed=0)
    assert env.core.setup.axes == ("swing", "boom", "stick", "tilt", "head")
    assert env.observation_space.contains(seen) and env.action_space.shape == (5,)
    assert np.isfinite(env.step(np.zeros(5))[1])
    env.close()


def test_a_machine_folder_and_a_loaded_machine_give_the_same_bits_as_the_shipped_one(tmp_path):
    machine = load_machine("cat215", "bucket")
    (tmp_path / "copy").mkdir()
    save_machine(machine, tmp_path / "copy" / "machine.yaml")
    seen = []
    for option in (None, tmp_path / "copy", str(tmp_path / "copy"), machine):
        env = MachineEnv("StraightLine", machine=option, variants=2)
        env.reset(seed=4)
        seen.append([env.step(np.full(4, 0.3))[0] for _ in range(10)])
        env.close()
    assert all(np.array_equal(seen[0], other) for other in seen[1:])


def test_another_tool():
    env = MachineEnv("TrackTrajectory", tool="grapple", variants=1)
    assert env.core.setup.machine.tool == "grapple"
    env.close()
    env = MachineEnv("StraightLine", machine="cat215", variants=1)
    assert env.core.setup.machine.tool == "bucket", "the tool of the task, not the first of the machine"
    env.close()


def test_servo_settings_replace_those_of_the_task():
    env = MachineEnv("ReachFeller", servo={"axis_gains": {"swing": 0.5}}, variants=1)
    assert env.core.setup.task.servo.axis_gains == {"swing": 0.5}
    env.close()
    env = MachineEnv("HoldForce", servo={"lead": 0.02}, variants=1)
    assert (env.core.setup.task.servo.lead, env.core.setup.task.servo.position_gain) == (0.02, 5.0)
    env.close()
    with pytest.raises(InputError, match="servo.*gain"):
        MachineEnv("ReachFeller", servo={"gain": 2.0}, variants=1)


def test_a_line_for_a_larger_machine_is_longer_and_higher():
    """Lengths follow the reach of the machine; the bounds are those of the CAT 215 times its ratio."""
    small, large = (MachineEnv("StraightLine", machine=name, variants=1) for name in ("cat215", "cat325"))
    ratio = float(large.core.parameters["parameters"][0])
    assert float(small.core.parameters["parameters"][0]) == 1.0 and 1.1 < ratio < 2.0
    small.close()
    large.close()


@pytest.mark.parametrize(
    ("task", "options", "said"),
    [
        ("TrackTrajectory", {"machine": "rig"}, "needs a machine with swing, boom, stick; rig .* has no `arm`"),
        ("StraightLine", {"machine": "cat215", "tool": "grapple"}, "lacks tool; it has the tools bucket"),
        ("ReachFeller", {"machine": "cat215", "tool": "bucket"}, "lacks head"),
        ("PlaceLog", {"tool": "grapple"}, "lacks claw"),
        ("Grade", {"machine": "cat325"}, "no bucket"),
        ("TrackTrajectory", {"machine": "cat216"}, "did you mean 'cat215'"),
        ("TrackTrajectory", {"tool": "shovel"}, "no tool 'shovel'"),
        ("TrackTrajectory", {"machine": 3}, "machine"),
    ],
)
def test_an_unsuitable_machine_is_refused_with_the_reason(task, options, said):
    with pytest.raises(InputError, match=said):
        MachineEnv(task, variants=1, **options)


def test_a_loaded_machine_keeps_its_tool():
    with pytest.raises(InputError, match="loaded with the tool 'bucket'"):
        MachineEnv("TrackTrajectory", machine=load_machine("cat215", "bucket"), tool="none", variants=1)
