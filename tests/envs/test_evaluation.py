"""Scores are those of whole episodes, each counted once."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.catalogue import make_controller
from hydrotele.envs.episode import DISABLED, NEXT_STEP
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.evaluation import evaluate_controller, tabulate_scores
from hydrotele.envs.stable_baselines import AgentInterface, find_reference_and_measured_columns
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.envs.variants import typical_variation
from hydrotele.machine.machine_file import load_machine


def _core(count=3, autoreset=DISABLED, **choices) -> TaskCore:
    options = {"variants": 2, "duration": 0.5, **choices}
    return TaskCore(TASKS["TrackTrajectory"], Options(**options), count, 1, autoreset)


def test_figures_are_those_of_the_episodes():
    core = _core()
    scores = evaluate_controller(core, make_controller("random", core.setup), 6, seed=4)
    alone = _core(count=1)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (25, 3, 3))  # as the controller draws them for the batch
    for number in range(3):
        alone.reset(np.array([4 + number]))
        total, errors = 0.0, []
        for action in actions:
            alone.step(action[number : number + 1])
            total += alone.reward[0]
            errors.append(alone.measures[0, 0])
        assert scores.results["return"][number] == pytest.approx(total, rel=1e-12)
        found = [scores.results[f"tip_error {what}"][number] for what in ("mean", "RMS", "final")]
        squared = np.sqrt(np.mean(np.square(errors)))
        assert found == pytest.approx([np.mean(errors), squared, errors[-1]], rel=1e-9)
    assert len(scores.results["return"]) == 6
    assert scores.results["length"] == pytest.approx(np.full(6, 0.5))
    assert scores.standard_error("return") == pytest.approx(scores.results["return"].std(ddof=1) / 6**0.5)
    assert f"{scores.mean('return'):.4g} ±" in tabulate_scores([("random", scores)], ["return"])


def test_an_episode_that_ended_early_counts_no_further(monkeypatch):
    core = _core()
    step = core.step

    def faulty(action):
        step(action)
        if core.episodes["step"][1] == 7:
            core.episodes["over"][1] = 1

    monkeypatch.setattr(core, "step", faulty)
    scores = evaluate_controller(core, make_controller("zero", core.setup), 3)
    assert scores.results["length"] == pytest.approx([0.5, 0.14, 0.5])
    assert scores.results["return"][1] <= 7.0


def test_a_core_that_begins_anew_by_itself_is_refused():
    core = _core(autoreset=NEXT_STEP)
    with pytest.raises(InputError, match="DISABLED"):
        evaluate_controller(core, make_controller("zero", core.setup), 1)


def test_the_usual_spread_suits_every_task_and_changes_the_machine():
    for task in TASKS.values():
        assert typical_variation(load_machine(task.machine, task.tool))
    core = _core(randomise=typical_variation(load_machine("cat215", "none")))
    first, second = core.setup.variants.machines
    assert first.axes["boom"].valve != second.axes["boom"].valve
    assert first.axes["swing"].command_delay == first.axes["boom"].command_delay


def test_an_agent_sees_errors_and_the_past_and_corrects_a_law():
    core = _core()
    law = make_controller("reference", core.setup)
    view, alone = (
        AgentInterface(core.setup, 3, law, max_fraction=0.25),
        AgentInterface(core.setup, 2),
    )
    fields = [field.name for field in core.setup.fields]
    asked, measured = find_reference_and_measured_columns(core.setup)
    pairs = {(fields[a], fields[m]) for a, m in zip(asked, measured, strict=True)}
    assert ("reference.boom", "angle.boom") in pairs
    assert ("reference_rate.boom", "rate.boom") in pairs
    sliding = core.setup._replace(fields=[f._replace(name=f"{what}.slide") for f, what in
                                  zip(core.setup.fields, ("position", "reference"), strict=False)])  # fmt: skip
    assert [columns.tolist() for columns in find_reference_and_measured_columns(sliding)] == [[1], [0]]
    names = ("tip.r", "log.r", "goal.r")
    timber = core.setup._replace(fields=[f._replace(name=n) for f, n in zip(core.setup.fields, names, strict=False)])
    assert [columns.tolist() for columns in find_reference_and_measured_columns(timber)] == [[1, 2, 2], [0, 1, 0]]
    core.reset(np.arange(3))
    view.begin(3)
    alone.begin(3)
    seen = view.make_agent_observation(core.observation)
    width = alone.observation_size // 2
    assert seen.shape == (3, view.observation_size) == (3, 3 * width + 3)
    first = core.observation.copy()
    given = view.make_environment_action(np.ones((3, 3)))
    law.begin(3)
    assert given == pytest.approx(np.clip(np.clip(law(first), -1, 1) + 0.25, -1, 1), abs=1e-6)
    assert np.array_equal(alone.make_environment_action(2.0 * np.ones((3, 3))), np.ones((3, 3)))
    alone.make_agent_observation(core.observation)
    core.step(given)
    later = alone.make_agent_observation(core.observation)
    assert np.array_equal(later[:, : len(fields)], core.observation)
    assert np.array_equal(later[:, width : width + len(fields)], first)
    place = len(fields) + list(asked).index(fields.index("reference.boom"))
    error = core.observation[:, fields.index("reference.boom")]
    error = error - core.observation[:, fields.index("angle.boom")]
    assert np.array_equal(later[:, place], error)
    last = alone.make_final_agent_observation(core.observation, np.array([1]))
    assert np.array_equal(last[0, :width], later[1, :width])
    assert np.array_equal(last[0, width:], later[1, :width])
    alone.reset(np.array([False, True, False]))
    anew = alone.make_agent_observation(core.observation)
    assert np.array_equal(anew[1, :width], anew[1, width:])
