"""Environments on a CUDA device, in numba's simulator of CUDA, which runs the kernels as Python code."""

import os
import subprocess
import sys

import numpy as np
import pytest

from hydrotele.batch import as_dlpack

SIMULATED = """
import sys
import gymnasium
import numpy as np
import pytest
import hydrotele.envs
task, action = sys.argv[1:]
options = dict(duration=0.06, variants=2, sensors="real", autoreset_mode="SameStep", action=action, precision="mixed")
cpu, cuda = (gymnasium.make_vec(f"hydrotele/{task}-v0", 2, device=d, **options) for d in ("cpu", "cuda"))
def are_equal(one, two):
    return all(np.array_equal(a, b.copy_to_host()) for a, b in zip(one[:-1], two[:-1], strict=True))
with pytest.raises(RuntimeError, match="reset before"):
    cuda.step(np.zeros(cuda.action_space.shape))
assert are_equal(cpu.reset(seed=3), cuda.reset(seed=3))
rng = np.random.default_rng(0)
for step in range(4):  # the episodes of three steps end and begin anew on the device
    action = rng.uniform(-1.5, 1.5, cpu.action_space.shape).astype(np.float32)
    one, two = cpu.step(action), cuda.step(action)
    assert are_equal(one, two), step
    if one[3].any():
        assert np.array_equal(np.stack(one[4]["final_obs"]), two[4]["final_obs"].copy_to_host())
    if step == 1:
        state = cuda.unwrapped.get_state()
assert one[3].sum() == 0
cuda.unwrapped.set_state(state)
assert cuda.unwrapped.core.episodes.copy_to_host()["step"].tolist() == [2, 2]
for env in (cpu, cuda):
    env.unwrapped.core.set_difficulty(0.5)
mask = {"reset_mask": np.array([False, True])}
assert np.array_equal(cpu.reset(options=mask, seed=8)[0][1], cuda.reset(options=mask, seed=8)[0].copy_to_host()[1])
with pytest.raises(ValueError, match="must be"):
    cuda.step(np.zeros(2))
print("equal")
"""


@pytest.mark.parametrize(
    ("task", "action"),
    [("TrackTrajectory", "joint_rate"), ("StraightLine", "resolved_motion"), ("ReachFeller", "resolved_motion")],
)
def test_episodes_have_the_bits_of_the_cpu(task, action):
    """Observations, rewards and ends are equal, also after an autoreset and a reset of chosen episodes."""
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1", "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(
        [sys.executable, "-c", SIMULATED, task, action], env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == "equal", done.stderr[-2000:]


def test_arrays_of_the_cpu_are_read_through_dlpack_without_a_copy():
    values = np.arange(6.0).reshape(2, 3)
    assert np.shares_memory(np.from_dlpack(as_dlpack(values)), values)
