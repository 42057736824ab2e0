"""What is wrong with a sweep file is said with file, line, key and what is allowed."""

import pytest

from hydrotele.core.errors import InputError
from hydrotele.core.files import scenarios_folder
from hydrotele.run.sweep_file import MAX_RUNS, load_sweep, shipped_sweeps
from hydrotele.run.sweep_scenarios import check_points, read_base_scenario
from hydrotele.scenario.scenario import shipped_scenarios

EFFECT = "set: {effects: [{name: payload, location: tool, parameters: {mass: 100}}]}\n"


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        ("grid: {}", ":1", "no key is varied"),
        ("grid: {servo.lead: []}", ":2: grid.servo.lead", "at least 1 item"),
        ("grid: {servo.lead: [.nan]}", ":2: grid.servo.lead", "nan is not a finite number"),
        ("grid: {servo.lead: [2026-01-01]}", ":2: grid.servo.lead", "not a finite number"),
        ("grid: {servo.lead: [0.1, 0.1]}", ":2: grid.servo.lead", "0.1 occurs twice"),
        ("grid: {servo.lead: [0], servo.lead: [1]}", ":2", "the key 'servo.lead' occurs twice"),
        ("grid:\n  servo.led: [1]", ":3: grid.servo.led", "did you mean 'lead'"),
        ("grid:\n  servo.lead:\n    - 0.1\n    - 7", ":5: grid.servo.lead", "7: .*less than"),
        ("grid: {servo: [{}], servo.lead: [0]}", ":1", "is part of servo"),
        ("set: {servo.lead: 0}\ngrid: {servo.lead: [1]}", ":1", "given more than once"),
        ("grid: {tool: [bucket, spoon]}", ":2: grid.tool", "no tool 'spoon'; valid: bucket"),
        ("grid: {sensors: [perfect]}", ":2: grid.sensors", "valid: ideal"),
        ("grid: {machine: [nix]}", ":2: grid.machine", "valid: calibrator, cat215"),
        ("grid: {effects.0.parameters.mass: [1]}", ":2: grid.effects", "there is no entry 0"),
        (f"{EFFECT}grid: {{effects.0.parameters.mass: [-4]}}", ":3: grid.effects", "outside 0"),
        (
            f"{EFFECT}grid: {{effects.0.parameters.mas: [4]}}",
            ":3: grid.effects",
            "is not one of them",
        ),
        ("grid: {timestep: [0.001], control_rate: [200, 300]}", ":2", "whole number"),
        (
            "grid: {control_rate: [200, 100], log_rate: [50, 200]}",
            ": run 4 (control_",
            "must divide",
        ),
        ("sample: {count: 3, keys: {servo.lead: {uniform: [2, 0]}}}", ":2: sample.k", "low < high"),
        (
            "sample: {count: 3, keys: {servo.lead: {log_uniform: [0, 1]}}}",
            ":2: sample.k",
            "low > 0",
        ),
        ("sample: {count: 3, keys: {servo.lead: {normal: [0, 0]}}}", ":2: sample.k", "deviation"),
        ("sample: {count: 3, keys: {servo.lead: {choice: [.inf]}}}", ":2: sample.k", "inf is not"),
        ("sample: {count: 3, keys: {servo.lead: {unform: [0]}}}", ":2", "did you mean 'uniform'"),
        ("sample: {count: 3, keys: {servo.lead: {}}}", ":2: sample.k", "exactly one of"),
        ("sample: {count: 3, keys: {servo.lead: {uniform: [1, 2]}}}", ":2: sample.k", "less than"),
        ("sample: {count: 0, keys: {servo.lead: {uniform: [0, 1]}}}", ":2: sample.count", "than"),
        (
            "sample: {count: 2, keys: {servo.lead: {uniform: [-1.7e+308, 1.7e+308]}}}",
            ":2: sample.keys.servo.lead.uniform.0",
            "greater than or equal to -1",
        ),
        ("sample: {count: 2, keys: {servo.lead: {normal: [0, 1e+300]}}}", ":2: sample.k", "less than"),
        ("grid: {servo.lead: [1], servo.lead.x.y: [0]}", ":1", "servo.lead.x.y is part of servo.lead"),
        ("grid: {seed: [1, 2]}\nrepeat: 2", ":1", "seed cannot be varied"),
        ("set: {duration: -1}\nrepeat: 2", ":2: set", "duration: .*greater than 0"),
        ("repeat: 1000000", ":2: repeat", "less than or equal to 50000"),
        ("name: ../etc\nrepeat: 2", ":2: name", "pattern"),
        ("grid: {folder: [a]}", ":2: grid.folder", "remove the key"),
        ("colour: red", ":1", "unknown key 'colour'; valid: description"),
    ],
)
def test_what_is_wrong_is_said_before_the_first_run(text, place, message, tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text(f"scenario: zhu_up\n{text}\n")
    with pytest.raises(InputError, match=message) as error:
        check_points(read_base_scenario(load_sweep(path)))
    assert str(error.value).startswith(f"{path}{place}")


def test_too_many_points_are_refused_without_making_them(tmp_path):
    values = list(range(1000))
    path = tmp_path / "huge.yaml"
    path.write_text(f"scenario: zhu_up\ngrid: {{servo.lead: {values}, seed: {values}}}\n")
    with pytest.raises(InputError, match=f"1000000 runs, more than {MAX_RUNS}"):
        load_sweep(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scenario: zhu_upp\nrepeat: 2\n", "did you mean 'zhu_up'"),
        ("scenario: s.yaml\nrepeat: 2\n", "nor a file in the same folder"),
        (
            (scenarios_folder() / "hold.yaml").read_text(),
            "is a scenario; a sweep file refers to it",
        ),
        ("[1, 2]", "must be a mapping"),
        ("a: [", "is not valid YAML"),
    ],
)
def test_files_that_are_no_sweep(text, message, tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        read_base_scenario(load_sweep(path))
    assert error.value.where.startswith(str(path))
    with pytest.raises(InputError, match="did you mean 'servo_gains'"):
        load_sweep("servo_gain")


def test_a_scenario_beside_the_file_is_found(tmp_path):
    text = (scenarios_folder() / "hold.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(text)
    (tmp_path / "sweep.yaml").write_text("scenario: mine.yaml\ngrid: {duration: [1, 2]}\n")
    base = read_base_scenario(load_sweep(tmp_path / "sweep.yaml"))
    assert len(check_points(base).fingerprints) == 2


def test_shipped_sweeps_are_right_and_no_scenarios():
    assert shipped_sweeps() and not set(shipped_sweeps()) & set(shipped_scenarios())
    for name in shipped_sweeps():
        file = load_sweep(name)
        assert file.name == name and file.sweep.description
        assert len(check_points(read_base_scenario(file)).fingerprints) == file.sweep.runs
