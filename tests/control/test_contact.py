"""Contact of a tool in logs: states of the tool, force at the tip, masks."""

import dataclasses
import functools

import numpy as np
import pytest

from hydrotele.cli.contact_command import load_dataset_without_contact
from hydrotele.control.contact import _detect_in_run, contact_masks, detect_contact, find_contact_rows
from hydrotele.control.log_forces import ExternalForces
from hydrotele.core.errors import InputError
from hydrotele.logs.log import save_log
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario


@functools.cache
def digging():
    """Return the first 7 s of the scenario dig, 1 s later: the bucket meets the soil at 4.5 s."""
    run = run_scenario(load_scenario("dig", {"duration": "7", "pilot.settle": "1.5"}))
    return load_machine("cat215", "bucket"), RunFiles("dig", (run.measured,)), run.truth


def forces_of(load: np.ndarray, force: np.ndarray, stick: np.ndarray | float = 0.0) -> ExternalForces:
    """Return external forces on a moving arm with a load [kg] and a tip force (b, 2) [N], one parameter error.

    `stick` (b,) is an unmodelled torque of the stick's drive [N m].
    """
    rng, b = np.random.default_rng(3), len(load)
    phase = 0.05 * np.arange(b)
    jacobian = np.zeros((b, 4, 4))
    jacobian[:, 0, 1], jacobian[:, 0, 2], jacobian[:, 0, 3] = 1.0, 2.5 + np.sin(phase), 1.2
    jacobian[:, 2, 1], jacobian[:, 2, 2], jacobian[:, 2, 3] = 6.0 + np.cos(phase), 2.0, 0.4 + 0.3 * np.sin(phase)
    jacobian[:, 1, 0], jacobian[:, 3, 1:] = 1.0, 1.0
    places = np.stack([jacobian[:, 2] - shift * np.array([0.0, 1.0, 1.0, 1.0]) for shift in (1.0, 0.0, 0.5)], axis=2)
    std = np.array([4000.0, 4000.0, 700.0, 200.0])
    error = np.stack([np.zeros(b), 5000.0 * np.sin(phase), 900.0 * np.cos(phase), np.zeros(b)], axis=1)
    tip = np.zeros((b, 4))
    tip[:, [0, 2]] = force
    value = np.einsum("bmi,bm->bi", jacobian, tip) + error - 9.81 * load[:, None] * places[:, :, 2]
    value += std * rng.normal(size=(b, 4))
    value[:, 2] += stick
    return ExternalForces(
        0.1 * np.arange(b), value, np.tile(np.diag(std**2), (b, 1, 1)), error[:, :, None], -9.81 * places,
        np.zeros((b, 4)), np.tile(np.eye(4), (b, 1, 1)), jacobian, np.full(b, 6.0),
    )  # fmt: skip


def test_contact_is_distinguished_from_a_load_that_changes():
    load, force = np.zeros(200), np.zeros((200, 2))
    force[40:80] = (15e3, 5e3)
    load[80:140] = 700.0  # carried, then dropped without contact
    found = _detect_in_run(forces_of(load, force), load_machine("cat215", "bucket"), "run")
    assert found.is_contact[41:79].all()
    assert not found.is_contact[:39].any() and not found.is_contact[82:].any()
    assert found.is_loaded[85:138].all() and not found.is_loaded[145:].any()
    # 4 standard deviations: 30 blocks, two directions
    error = found.force[45:75][:, [0, 2]] - (15e3, 5e3)
    assert (np.abs(error) < 4.0 * found.force_std[45:75][:, [0, 2]]).all()
    assert abs(found.load[110] - 700.0) < 4.0 * found.load_std[110]


def test_upward_force_at_rest_is_contact_because_no_load_has_negative_mass():
    force = np.zeros((120, 2))
    force[60:, 1] = 9e3
    still = forces_of(np.zeros(120), force)
    found = _detect_in_run(still, load_machine("cat215", "bucket"), "run")
    assert found.is_contact[62:].all() and not found.is_contact[:58].any()


def test_unmodelled_force_of_one_drive_is_not_contact():
    stick = np.zeros(120)
    stick[50:80] = 12e3 * np.sin(0.4 * np.arange(30))
    found = _detect_in_run(forces_of(np.zeros(120), np.zeros((120, 2)), stick), load_machine("cat215", "bucket"), "run")
    assert not found.is_contact.any() and not found.is_loaded.any()


def test_bucket_in_soil_is_found_with_its_force():
    machine, files, truth = digging()
    (found,) = detect_contact([files], machine)
    size = np.linalg.norm([truth[f"truth.contact_force.{a}"] for a in "xyz"], axis=0)
    masked = find_contact_rows(found, truth.time)
    assert masked[size > 1e3].mean() > 0.95
    assert masked[size == 0.0].mean() < 0.05
    for task, axis in (("r", "x"), ("z", "z")):
        k = found.task.index(task)
        true = np.interp(found.time, truth.time, truth[f"truth.contact_force.{axis}"])
        # 4 standard deviations over 40 blocks
        assert (np.abs(found.force[:, k] - true) < 4.0 * found.force_std[:, k])[found.time > 4.8].all()


def test_masked_dataset_has_no_contact_and_reports_it(tmp_path):
    machine, files, truth = digging()
    masks = contact_masks(detect_contact([files], machine), [files])
    assert masks and all(mask.run == "dig" for mask in masks)
    save_log(files.logs[0], tmp_path / "dig.parquet")
    data = load_dataset_without_contact([tmp_path / "dig.parquet"], machine, None, None, False, "mask")
    assert "contact is detected in" in data.notes[0]
    size = np.linalg.norm([truth[f"truth.contact_force.{a}"] for a in "xyz"], axis=0)
    first = truth.time[np.argmax(size > 1e3)]
    for run in (*data.fit, data.heldout):
        assert run.start + run.period * len(run.command) < first


def test_missing_pressure_is_named():
    machine, files, _ = digging()
    log = files.logs[0]
    kept = {name: values for name, values in log.columns.items() if name != "pressure_rod.stick"}
    log = dataclasses.replace(log, columns=kept, units={name: log.units[name] for name in kept})
    with pytest.raises(InputError, match=r"pressure_rod\.stick"):
        detect_contact([RunFiles("dig", (log,))], machine)
