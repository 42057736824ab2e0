"""Posterior samples of a gap search: their intervals, their machines, and the bands that they predict."""

import dataclasses
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.cli import main as cli
from hydrotele.core.errors import InputError
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.envs.variants import make_variants
from hydrotele.estimate.evidence import draw_truncated_normal
from hydrotele.estimate.hypothesis import Guess, Hypothesis, calibration, hypotheses
from hydrotele.gap.bands import prediction_band
from hydrotele.gap.find import find_gap
from hydrotele.gap.patched import write_patch
from hydrotele.gap.posterior import POSTERIOR_FILE, machine_of_sample, read_posterior, sample_posterior, write_posterior
from hydrotele.logs.log import Log, save_log
from hydrotele.machine.log_channels import default_channel_unit
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.replay import replay_log
from hydrotele.simulate.record import SimulationFailed
from tests.small_machines import simulate_data

NOISE = {"position": 2e-5, "pressure_head": 1e4, "pressure_rod": 1e4}
CHANNELS = ("position.slide", "pressure_head.slide", "pressure_rod.slide")
DEADBAND = "valve_deadband.slide.deadband"


def invoke(*words):
    """Exit status, stdout and stderr; `main` turns an InputError into 2."""
    result = CliRunner().invoke(cli.app, [str(w) for w in words], terminal_width=200)
    if isinstance(result.exception, InputError):
        return 2, result.stdout, str(result.exception)
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


def check_marginals(posterior, name, low, high):
    """Mean and standard deviation of a column agree with a reported interval within 4 standard errors."""
    column, sd = posterior.samples[:, posterior.names.index(name)], (high - low) / (2 * 1.96)
    assert abs(np.mean(column) - 0.5 * (low + high)) < 4.0 * sd / np.sqrt(len(column))
    assert abs(np.std(column) / sd - 1.0) < 4.0 / np.sqrt(2.0 * len(column))


@pytest.fixture(scope="module")
def data():
    rig = load_machine("rig")
    truth = rig.replace("axes.slide.valve.deadband", rig.axes["slide"].valve.deadband + 0.02)
    return simulate_data(truth, CHANNELS, NOISE, model=rig, period=0.005, rows=600, noise_stated=True)


@pytest.fixture(scope="module")
def gap(data):
    return find_gap(data, effects=("valve_deadband",), jobs=1)


@pytest.fixture(scope="module")
def site(data, gap, tmp_path_factory):
    """Logs of both runs, and the parts of a result folder of `hydrotele gap` that the readers need."""
    folder = tmp_path_factory.mktemp("posterior")
    write_folder(gap, folder / "gap_rig")
    (folder / "logs").mkdir()
    for run, name in ((data.fit[0], "fit_1"), (data.heldout, "test_1")):
        columns = {"command.slide": run.command[:, 0]} | dict(zip(CHANNELS, run.reading.T, strict=True))
        units = {channel: default_channel_unit(channel) for channel in columns}
        time = run.period * np.arange(len(run.reading))
        save_log(Log(time, columns, units, {"machine": "rig"}), folder / "logs" / f"{name}.parquet")
    return folder


def write_folder(gap, folder):
    (folder / "patched").mkdir(parents=True)
    write_patch(gap, folder / "patched")
    write_posterior(gap.posterior, folder)
    (folder / "gap.json").write_text("{}")
    summary = {"kind": "gap", "machine": gap.machine.name, "tool": gap.machine.tool}
    (folder / "summary.json").write_text(json.dumps(summary))


def test_samples_have_the_reported_interval_and_give_machines(gap, site):
    posterior = read_posterior(site / "gap_rig")
    assert posterior.names == (DEADBAND,) and posterior.units == ("1",) and posterior.samples.shape == (200, 1)
    np.testing.assert_array_equal(posterior.samples, gap.posterior.samples)
    estimate = gap.effects[0].parameters["deadband"]
    check_marginals(posterior, DEADBAND, estimate.low, estimate.high)
    at_estimate = dataclasses.replace(posterior, samples=np.array([[estimate.value]]))
    assert machine_of_sample(at_estimate, 0).axes == gap.patched.axes
    assert machine_of_sample(posterior, 7).axes["slide"].valve.deadband == posterior.samples[7, 0]
    assert posterior.noise == pytest.approx({c: found for c, (found, _) in gap.noise.items()})


def test_effects_and_calibrated_parameters_keep_their_correlations_and_survive_a_file(gap, tmp_path):
    """Of 500 samples, a 2.5 % quantile is known to 0.12 standard deviations, a correlation to 0.045."""
    rig = load_machine("rig")
    group = calibration(rig)
    effects = [h for h in hypotheses(rig, ["valve_deadband", "internal_leakage"])]
    guess = Guess((*((h, np.full(h.size, 2.0)) for h in effects), (group, np.zeros(group.size))))
    size, rng = len(guess.deviation), np.random.default_rng(1)
    mixed = rng.normal(size=(size, size))
    covariance = 0.01 * (mixed @ mixed.T / size + np.eye(size))
    posterior = sample_posterior(rig, [(guess, covariance)], {}, 500)
    again = sample_posterior(rig, [(guess, covariance)], {}, 500)
    np.testing.assert_array_equal(posterior.samples, again.samples)
    assert posterior.calibrated == set(group.parameters) and len(posterior.names) == size
    parameters = [p for h in guess.hypotheses for p in h.parameters.values()]
    scale = np.array([p.prior_std for p in parameters]) * np.sqrt(np.diag(covariance))
    middle = np.array([p.nominal + d * p.prior_std for p, d in zip(parameters, guess.deviation, strict=True)])
    quantiles = (np.quantile(posterior.samples, (0.025, 0.975), axis=0) - middle) / scale
    np.testing.assert_allclose(quantiles, np.outer([-1.96, 1.96], np.ones(size)), atol=0.48)
    expected = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(np.corrcoef(posterior.samples.T), expected, atol=0.18)
    few = dataclasses.replace(posterior, samples=posterior.samples[:3])
    write_folder(dataclasses.replace(gap, posterior=few), tmp_path / "gap")
    read = read_posterior(tmp_path / "gap")
    assert read.names == posterior.names and read.units == posterior.units
    deviation = (posterior.samples[2] - np.array([p.nominal for p in parameters])) / [p.prior_std for p in parameters]
    assert machine_of_sample(read, 2).links == guess.at(deviation).machine(rig).links


def test_learned_laws_are_in_the_machine_that_the_samples_change():
    rig = load_machine("rig")
    (effect,) = hypotheses(rig, ["valve_deadband"])
    law = Hypothesis("learned_force", "slide", {}, lambda machine, _: machine.replace("axes.slide.valve.damping", 0.5))
    guess = Guess(((effect, np.ones(1)), (law, np.zeros(0))))
    posterior = sample_posterior(rig, [(guess, 0.01 * np.eye(1))], {}, 5)
    assert posterior.names == (DEADBAND,) and machine_of_sample(posterior, 3).axes["slide"].valve.damping == 0.5


def test_a_later_fit_replaces_an_earlier_one_of_the_same_parameter():
    rig = load_machine("rig")
    group, (effect,) = calibration(rig), hypotheses(rig, ["valve_deadband"])
    first = Guess(((group, np.zeros(group.size)),)), 0.01 * np.eye(group.size)
    posterior = sample_posterior(rig, [first, (Guess(((effect, np.ones(1)),)), 0.01 * np.eye(1))], {}, 5)
    assert posterior.names.count(DEADBAND) == 1 and DEADBAND not in posterior.calibrated
    assert sample_posterior(rig, [(Guess(), np.zeros((0, 0)))], {}) is None


@pytest.mark.parametrize("size", [1, 20])
def test_samples_end_at_bounds_and_at_the_domain(size):
    """20 estimates at their bounds leave one sample of a million inside: the Gibbs sampler draws these."""
    bounds = np.zeros(size), np.full(size, 9.0)
    found = draw_truncated_normal(np.zeros(size), np.eye(size), bounds, lambda d: d[0] < 1.0, 50)
    assert found.shape == (50, size) and found.min() >= 0.0 and found[:, 0].max() < 1.0
    if size > 1:  # half of a normal distribution has the mean sqrt(2 / pi) and the standard deviation 0.6
        assert found[:, 1:].mean() == pytest.approx(np.sqrt(2.0 / np.pi), abs=4 * 0.6 / np.sqrt(50 * (size - 1)))


def test_a_band_holds_predictions_and_noise():
    rng = np.random.default_rng(0)
    band = prediction_band(rng.normal(size=(4000, 2, 1)), np.array([2.0]))
    assert band.width == pytest.approx(2 * 1.96, rel=0.06)
    assert band.high - band.low == pytest.approx(2 * 1.96 * np.sqrt(5.0), rel=0.03)


def test_compare_states_width_and_coverage_of_the_band(site, tmp_path):
    words = ("compare", "rig", site / "gap_rig", "-d", site / "logs", "--horizons", "0.5", "--bands", "8")
    code, out, err = invoke(*words, "--json", "--out", tmp_path / "out")
    assert code == 0, err
    nominal, corrected = json.loads(out)["models"]
    assert "bands" not in nominal["mean"] and corrected["samples"] == 8
    band = corrected["mean"]["bands"]["0.5"]
    assert 0.0 < band["width"]["position.slide"] < 2.0 * nominal["mean"]["horizons"]["0.5"]["position.slide"]
    # the model is right but for start states: windows of 0.5 s begin at estimates as good as a few readings
    assert all(0.85 < fraction <= 1.0 for fraction in band["inside"].values())
    assert (tmp_path / "out" / "free_run.png").is_file()
    code, out, _ = invoke(*words[:-2], "--bands", "0", "--json")
    assert code == 0 and "bands" not in json.loads(out)["models"][1]["mean"]
    assert "no missing laws" in " ".join(invoke(*words)[1].split())


def test_replay_draws_the_band_of_the_samples(site, tmp_path, monkeypatch):
    monkeypatch.setattr("hydrotele.show.recording.write_recording", lambda path, entries: None)  # takes seconds
    log = site / "logs" / "test_1.parquet"
    words = ("replay", log, "--machine", site / "gap_rig", "--timestep", "0.005")
    code, out, err = invoke(*words, "--bands", "3", "--json", "--out", tmp_path / "out")
    assert code == 0, err
    band = json.loads(out)["channels"]["position.slide"]["band"]
    assert band["width"] > 0.0 and 0.0 <= band["inside"] <= 1.0 and band["samples"] == 3
    written = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert written["replays"][0]["channels"]["position.slide"]["band"] == band
    code, out, _ = invoke(*words, "--json")
    assert code == 0 and "band" not in json.loads(out)["channels"]["position.slide"]


def test_a_sampled_machine_whose_simulation_diverges_is_left_out_of_the_band(site, monkeypatch):
    """The first replay is that of the corrected machine, those after it are of the samples."""
    calls, diverging = [], {2}

    def replay(*arguments):
        calls.append(arguments)
        if len(calls) in diverging:
            raise SimulationFailed("unstable")
        return replay_log(*arguments)

    monkeypatch.setattr("hydrotele.cli.replay_command.replay_log", replay)
    log = site / "logs" / "test_1.parquet"
    words = ("replay", log, "--machine", site / "gap_rig", "--timestep", "0.005", "--bands", "3", "--json")
    code, out, err = invoke(*words)
    assert code == 0 and "1 of 3 sampled machines diverged" in err
    assert json.loads(out)["channels"]["position.slide"]["band"]["samples"] == 2
    calls.clear()
    diverging.update({3, 4})
    result = CliRunner().invoke(cli.app, [str(w) for w in words])
    assert result.exit_code != 0 and "no band can be computed" in str(result.exception)


def test_a_posterior_that_is_missing_or_wrong_is_refused(site, tmp_path):
    log = site / "logs" / "test_1.parquet"
    for machine, bands, said in (
        ("rig", 3, "no gap.json"),
        (site / "gap_rig", 1, "at least 2"),
    ):
        code, _, err = invoke("replay", log, "--machine", machine, "--bands", bands, "--json")
        assert code == 2 and said in err
    assert "needs --machine" in invoke("replay", log, "--bands", 3, "--json")[2]
    code, _, err = invoke("compare", "rig", "-d", site / "logs", "--bands", 3)
    assert code == 2 and POSTERIOR_FILE in err
    (tmp_path / "gap.json").write_text("{}")
    with pytest.raises(InputError, match="changed no parameter"):
        read_posterior(tmp_path)


def damage(folder, posterior, gap, **changed):
    write_folder(dataclasses.replace(gap, posterior=dataclasses.replace(posterior, **changed)), folder)
    return folder


def test_a_damaged_posterior_is_refused(gap, tmp_path):
    posterior = gap.posterior
    whole = damage(tmp_path / "a", posterior, gap)
    (whole / POSTERIOR_FILE).write_bytes((whole / POSTERIOR_FILE).read_bytes()[:-30])
    with pytest.raises(InputError, match="not a readable Parquet file"):
        read_posterior(whole)
    for number, (changed, said) in enumerate((
        ({"names": ("no_effect.slide.deadband",)}, "--effects FILE.py"),
        ({"names": ("valve_deadband.boom.deadband",)}, "no location 'boom'"),
        ({"names": ("mass.boom",), "calibrated": frozenset(["mass.boom"])}, "no uncertain parameter of rig"),
        ({"names": ("valve_deadband.slide.width",)}, "cannot be applied"),
        ({"samples": np.full((3, 1), np.nan)}, "not finite"),
        ({"samples": np.zeros((0, 1))}, "no posterior samples"),
        ({"machine": load_machine("emps")}, "repeat `hydrotele gap`"),
    )):  # fmt: skip
        with pytest.raises(InputError, match=said):
            read_posterior(damage(tmp_path / str(number), posterior, gap, **changed))
    (damage(tmp_path / "b", posterior, gap) / "posterior" / "machine.yaml").unlink()
    with pytest.raises(InputError, match=r"machine\.yaml"):
        read_posterior(tmp_path / "b")


def test_every_variant_of_an_environment_is_a_sample(gap, site, tmp_path):
    task = TASKS["TrackTrajectory"]
    machine = load_machine(task.machine, task.tool)
    effect = next(h for h in hypotheses(machine, ["valve_deadband"]) if h.location == "boom")
    posterior = sample_posterior(machine, [(Guess(((effect, np.ones(1)),)), 0.01 * np.eye(1))], {}, 9)
    write_folder(dataclasses.replace(gap, machine=machine, patched=machine, posterior=posterior), tmp_path / "gap")
    load = {"name": "payload", "location": "tool", "parameters": {"mass": [100.0, 200.0]}}
    machines = make_variants(task, Options(randomise=(str(tmp_path / "gap"), load), variants=3), machine).machines
    drawn = {m.axes["boom"].valve.deadband for m in machines}
    assert len(drawn) == 3 and drawn <= set(posterior.samples[:, 0].tolist())
    assert all(100.0 <= m.links["payload"].mass <= 200.0 for m in machines)
    for wrong, said in ((site / "gap_rig", "the task needs"), (site / "logs", "no gap.json")):
        with pytest.raises(InputError, match=said):
            make_variants(task, Options(randomise=str(wrong), variants=1), machine)
    with pytest.raises(InputError, match="not several"):
        make_variants(task, Options(randomise=("a", "b"), variants=1), machine)
