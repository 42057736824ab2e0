"""Recorded episodes are read back by Minari and repeat bit for bit in the recovered environment."""

import numpy as np
import pytest

minari = pytest.importorskip("minari", reason="the extra `minari` is not installed")

from typer.testing import CliRunner  # noqa: E402

from hydrotele.cli import main as cli  # noqa: E402
from hydrotele.envs.offline_dataset import average_over_steps  # noqa: E402
from hydrotele.logs.log import load_log  # noqa: E402


@pytest.fixture(autouse=True)
def _own_datasets(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))


def record(*words):
    return CliRunner().invoke(cli.app, ["record", *map(str, words)])


def test_episodes_of_a_controller_repeat_in_the_recovered_environment():
    words = ["TrackTrajectory", "--episodes", 2, "--seed", 5, "--set", "duration=0.4", "--set", "variants=2"]
    done = record(*words, "--dataset", "track/test-v0")
    assert done.exit_code == 0, done.output
    found = minari.load_dataset("track/test-v0")
    env = found.recover_environment()
    assert (found.total_episodes, found.total_steps) == (2, 40)
    assert found.observation_space == env.observation_space and found.action_space == env.action_space
    for number, episode in enumerate(found.iterate_episodes()):
        seen, _ = env.reset(seed=5 + number)
        assert np.array_equal(seen, episode.observations[0])
        for step, action in enumerate(episode.actions):
            seen, reward, terminated, truncated, _ = env.step(action)
            assert np.array_equal(seen, episode.observations[step + 1]) and reward == episode.rewards[step]
            assert (terminated, truncated) == (episode.terminations[step], episode.truncations[step])
        assert truncated
    again = record(*words, "--dataset", "track/test-v0")
    assert isinstance(again.exception, Exception) and "exists already" in str(again.exception)
    assert record(*words, "--dataset", "track/test-v0", "--force").exit_code == 0


def test_a_log_becomes_an_episode_with_its_motion(tmp_path):
    run = CliRunner().invoke(
        cli.app, ["run", "zhu_up", "--out", f"{tmp_path}/run", "--set", "duration=2.0", "--no-review"]
    )
    assert run.exit_code == 0, run.output
    done = record("StraightLine", "--log", tmp_path / "run", "--dataset", "line/driven-v0", "--json")
    assert done.exit_code == 0, done.output
    found = minari.load_dataset("line/driven-v0")
    episode, env = found[0], found.recover_environment()
    names = [field.name for field in env.unwrapped.core.setup.fields]
    log = load_log(tmp_path / "run" / "measured.parquet")
    time = np.arange(len(episode.observations)) / 50.0
    for axis in env.unwrapped.core.setup.axes:
        logged = np.interp(time, log.time - log.time[0], log[f"angle.{axis}"])
        # the log's sensors are noisy and its chambers start at other pressures
        assert episode.observations[:, names.index(f"angle.{axis}")] == pytest.approx(logged, abs=0.01)


def test_a_log_without_the_axes_of_the_task_is_refused(tmp_path):
    words = ["run", "excitation", "--out", f"{tmp_path}/run", "--set", "duration=0.5", "--no-review"]
    assert CliRunner().invoke(cli.app, words).exit_code == 0
    done = record("ReachFeller", "--log", tmp_path / "run", "--dataset", "reach/driven-v0")
    assert "command.tilt" in str(done.exception)


def test_a_bad_name_is_refused_before_the_episodes_run():
    assert "track/driven-v0" in str(record("TrackTrajectory", "--dataset", "a b").exception)


def test_commands_are_averaged_over_steps():
    time, values = np.array([0.0, 0.1, 0.2, 0.3, 0.4]), np.array([1.0, 0.0, 1.0, 1.0, 5.0])
    assert average_over_steps(time, values, np.array([0.0, 0.2, 0.4])) == pytest.approx([0.5, 1.0])
