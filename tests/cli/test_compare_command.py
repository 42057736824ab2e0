"""`hydrotele compare`: the better machine has the smaller error, in table, JSON and picture."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.cli import main as cli
from hydrotele.core.errors import InputError
from hydrotele.effects import apply_effect
from hydrotele.logs.log import save_log
from hydrotele.machine.machine_file import load_machine, save_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario

ASYMMETRY = ("friction_asymmetry", "slide", {"coulomb_asymmetry": 0.0, "viscous_asymmetry": 0.3})


def invoke(*words):
    """Exit status, stdout and stderr; `main` turns an InputError into 2."""
    result = CliRunner().invoke(cli.app, [str(w) for w in words], terminal_width=200)
    if isinstance(result.exception, InputError):
        return 2, result.stdout, str(result.exception)
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Runs of EMPS with viscous friction that depends on the direction, and the patched machine."""
    folder = tmp_path_factory.mktemp("compare")
    (folder / "logs").mkdir()
    for k, name in enumerate(("fit_1", "fit_2", "test_1")):
        time = np.arange(600) / 50.0
        volts = 2.0 * np.sin((4.0 + 0.3 * k) * time) + 0.15  # stays clear of the end stops
        pilot = {
            "kind": "table", "quantity": "command", "interpolate": "hold", "time": time.tolist(),
            "columns": {"slide": volts.tolist()},
        }  # fmt: skip
        name_, place, parameters = ASYMMETRY
        scenario = Scenario(
            name=name, machine="emps", control_rate=50, log_rate=50, duration=12.0, ground=False,
            pilot=pilot, effects=[{"name": name_, "location": place, "parameters": parameters}],
        )  # fmt: skip
        save_log(run_scenario(scenario).measured, folder / "logs" / f"{name}.parquet")
    patched = folder / "gap_logs" / "patched"
    patched.mkdir(parents=True)
    save_machine(apply_effect(load_machine("emps"), *ASYMMETRY), patched / "machine.yaml")
    return folder


def test_the_patched_machine_is_better_in_json_table_and_folder(site):
    gap, target = site / "gap_logs", site / "compared"
    words = ("compare", "emps", gap, "--data", site / "logs", "--horizons", "1,5,60",
             "--baseline", "table", "--out", target)  # fmt: skip
    code, stdout, stderr = invoke(*words, "--json")
    assert code == 0, stderr
    found = json.loads(stdout)
    assert found["evaluated_runs"] == ["test_1"] and found["fitted_runs"] == ["fit_1", "fit_2"]
    nominal, patched, table = found["models"]
    assert (nominal["kind"], patched["name"], table["kind"]) == ("machine", str(gap), "baseline")
    for horizon in ("1", "5", "end"):  # 60 s do not fit into 12 s
        errors = [m["mean"]["horizons"][horizon]["position.slide"] for m in found["models"]]
        assert errors[1] < 0.2 * errors[0] and errors[1] < errors[2]
    assert set(nominal["mean"]["horizons"]) == {"1", "5", "end"}
    assert found == json.loads((target / "compare.json").read_text(encoding="utf-8"))
    assert (target / "free_run.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((target / "summary.json").read_text(encoding="utf-8"))["kind"] == "compare"
    code, stdout, _ = invoke(*words)
    assert code == 0 and "position.slide" in stdout and "whole run" in stdout and "mm" in stdout


def test_all_runs_and_their_mean(site):
    code, stdout, stderr = invoke("compare", "emps", "-d", site / "logs", "--all", "--json",
                                  "--horizons", "2", "--heldout", "fit_1")  # fmt: skip
    assert code == 0, stderr
    (model,) = json.loads(stdout)["models"]
    each = [run["horizons"]["2"]["rms"]["position.slide"] for run in model["runs"]]
    assert [run["run"] for run in model["runs"]][-1] == "fit_1" and len(each) >= 2
    mean = model["mean"]["horizons"]["2"]["position.slide"]
    assert mean == pytest.approx(np.mean(each), rel=1e-12)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--horizons", "1,x"), "positive numbers"),
        (("--horizons", "0.001"), "at least 0.02 s, the log's sample period"),
        (("--baseline", "tables"), "table"),
        (("cat215",), "axes"),
        (("--heldout", "test_9"), "test_1"),
    ],
)
def test_what_cannot_be_compared_is_refused(site, more, said):
    code, stdout, stderr = invoke("compare", "emps", *more, "--data", site / "logs")
    assert (code, stdout) == (2, "") and said in stderr
