"""Files of stable-baselines3 and TorchScript as policies, with the extra `learn`."""

import sys

sys.modules.setdefault("triton", None)  # its LLVM conflicts with that of OpenGL, see run.policy

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
import stable_baselines3  # noqa: E402
import torch  # noqa: E402

from hydrotele.core.errors import InputError  # noqa: E402
from hydrotele.run.policy import load_policy  # noqa: E402


@pytest.mark.parametrize("kind", ["PPO", "SAC", "TD3", "A2C"])
def test_files_of_stable_baselines_keep_their_actions(tmp_path, kind):
    class Small(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    model = getattr(stable_baselines3, kind)("MlpPolicy", Small(), seed=0, device="cpu")
    model.save(tmp_path / "policy.zip")
    seen = np.array([0.1, -0.2, 0.3, 0.9], np.float32)
    policy = load_policy("policy.zip", str(tmp_path))
    assert policy.needs_observation
    assert np.array_equal(policy.act(seen), model.predict(seen, deterministic=True)[0])
    with pytest.raises(InputError, match="needs an observation of 4 values"):
        policy.act(seen[:3])


@pytest.mark.filterwarnings("ignore:.*torch.jit.*:FutureWarning")
def test_files_of_torchscript_keep_their_actions(tmp_path):
    layer = torch.nn.Linear(3, 2)
    torch.jit.script(layer).save(str(tmp_path / "net.pt"))
    seen = np.array([0.1, -0.2, 0.3], np.float32)
    policy = load_policy("net.pt", str(tmp_path))
    assert policy.act(seen) == pytest.approx(layer(torch.from_numpy(seen)).detach().numpy())
    with pytest.raises(InputError, match="does not accept 2 values"):
        policy.act(seen[:2])
