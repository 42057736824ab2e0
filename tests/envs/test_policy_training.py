"""Training at its smallest: it writes, is read back, continues and is compared."""

import json

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="the extra `learn` is not installed")

import torch  # noqa: E402 - after the skip
from gymnasium.spaces import Box  # noqa: E402
from stable_baselines3 import PPO  # noqa: E402
from typer.testing import CliRunner  # noqa: E402

from hydrotele.cli import main as cli  # noqa: E402
from hydrotele.envs import policy_training  # noqa: E402
from hydrotele.envs.learning_curve import TrainingPlan, TrainingState  # noqa: E402

OPTIONS = {"variants": 2, "duration": 0.4, "control_rate": 25.0}
SMALL = {"minutes": None, "num_envs": 4, "threads": 1, "rollout_steps": 8, "batch": 16, "epochs": 1, "width": 8}


def train(*words):
    done = CliRunner().invoke(cli.app, ["train", *map(str, words), "--json", "--episodes", "4"])
    assert done.exit_code == 0, (done.output, done.exception)
    return json.loads(done.stdout)


def test_a_policy_is_trained_compared_and_continued(tmp_path):
    settings = [word for key, value in OPTIONS.items() for word in ("--set", f"{key}={value}")]
    words = ["TrackTrajectory", "--steps", 512, "--envs", 8, "--threads", 1, "--out", tmp_path / "out", *settings]
    first = train(*words)
    assert set(first["scores"]) == {"policy", "zero", "reference"} and first["steps"] == 512
    for name in ("policy.zip", "training.json", "learning_curve.csv", "learning_curve.png", "scores.json"):
        assert (tmp_path / "out" / name).stat().st_size > 0
    second = train("--resume", "--steps", 1024, "--out", tmp_path / "out")
    assert second["steps"] == 1024 and second["scores"]["zero"] == first["scores"]["zero"]
    rows = np.genfromtxt(tmp_path / "out" / "learning_curve.csv", delimiter=",", names=True)
    assert (np.diff(rows["steps"]) >= 0).all() and rows["steps"][-1] == 1024
    again = CliRunner().invoke(cli.app, ["train", *map(str, words)])
    assert "--resume" in str(again.exception)
    # the file is one of stable-baselines3 whose input is the plain observation
    policy = PPO.load(tmp_path / "out" / "policy.zip", device="cpu")
    assert policy.predict(np.zeros((3, 35), np.float32))[0].shape == (3, 3)


def test_the_same_seed_gives_the_same_policy(tmp_path):
    values = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        plan = TrainingPlan("hydrotele/TrackTrajectory-v0", OPTIONS, steps=128, seed=4, **SMALL)
        model = policy_training.train_policy(TrainingState(plan), tmp_path / name)
        values.append(torch.cat([parameter.detach().flatten() for parameter in model.policy.parameters()]))
    assert torch.equal(*values)


def test_the_normalisation_is_that_of_all_values():
    rng = np.random.default_rng(0)
    parts = [rng.normal(3.0, 2.0, (20, 5, 4)), rng.normal(-1.0, 0.5, (7, 4))]
    made = policy_training.NormalisingExtractor(Box(-9.0, 9.0, (4,)), reference=(2,), measured=(0,))
    for part in parts:
        made.update_statistics(part)
    whole = np.concatenate([part.reshape(-1, 4) for part in parts])
    whole = np.concatenate([whole, whole[:, 2:3] - whole[:, :1]], axis=1)
    assert made.mean.numpy() == pytest.approx(whole.mean(0), abs=1e-9)
    assert made.variance.numpy() == pytest.approx(whole.var(0), abs=1e-9)
    features = made(torch.as_tensor(whole[:, :4])).numpy()
    assert features[:, :5].mean(0) == pytest.approx(np.zeros(5), abs=1e-5)
    assert features[:, :5].std(0) == pytest.approx(np.ones(5), abs=1e-4)
    rms = np.sqrt((whole[:, 4] ** 2).mean())
    assert features[:, 5] == pytest.approx(np.arcsinh(100.0 * whole[:, 4] / rms) / np.arcsinh(100.0), abs=1e-5)


def test_a_file_that_is_no_policy_is_refused(tmp_path):
    file = tmp_path / "policy.zip"
    file.write_bytes(b"not a zip file")
    with pytest.raises(Exception, match="policy"):
        policy_training.load_policy(file)
