"""Options of `hydrotele calibrate` outside their range are refused with option, value and range."""

import json

import pytest
from typer.testing import CliRunner

from hydrotele.cli.main import app
from hydrotele.core.errors import InputError

KINDS = {"arm": "arm calibration", "linkage": "linkage calibration", "design": "calibrator design"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("hybrid --data . --posterior 1", "--posterior 1: must be a number of MCMC steps from 40 to 100000"),
        ("hybrid --data . --seed 99999999999", "--seed 1e+11: must be a random seed from 0 to 4.29497e+09"),
        (
            "hybrid --simulate {0} --errors inf",
            "--errors: must be a finite number, not inf",
        ),
        (
            "hybrid --simulate {0} --errors 1e6",
            "--errors 1e+06: must be a factor on errors of 1 mm and 1 mrad from 0 to 50",
        ),
        (
            "hybrid --simulate {0} --noise inf",
            "--noise: must be a finite number, not inf",
        ),
        ("scara --simulate {0} --seed -1", "--seed -1: must be a random seed from 0 to 4.29497e+09"),
        ("scara --simulate {0} --noise inf", "--noise: must be a finite number, not inf"),
        ("mukca --data . --distance inf", "--distance: must be a finite number, not inf"),
    ],
)
def test_options_out_of_range_are_refused(tmp_path, words, message):
    with pytest.raises(InputError) as found:
        CliRunner().invoke(app, ["calibrate", *words.format(tmp_path / "new").split()], catch_exceptions=False)
    assert str(found.value) == message
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("words", ["arm --data .", "linkage --data .", "design"])
def test_result_of_another_calibration_is_not_replaced(tmp_path, words):
    for kind in {"arm calibration", "linkage calibration", "calibrator design"} - {KINDS[words.split()[0]]}:
        (tmp_path / "summary.json").write_text(json.dumps({"kind": kind}))
        with pytest.raises(InputError, match=f"was not written by a {KINDS[words.split()[0]]}"):
            CliRunner().invoke(app, ["calibrate", *words.split(), "--out", str(tmp_path)], catch_exceptions=False)


def test_noise_below_rounding_is_refused(tmp_path):
    folder = tmp_path / "h"
    CliRunner().invoke(app, ["calibrate", "hybrid", "--simulate", str(folder), "--poses", "12", "--heldout", "0"])
    path = folder / "measurement.yaml"
    text = path.read_text()
    for key in ("leg_mm: 0.01", "wire_mm: 0.02"):
        text = text.replace(key, f"{key.split()[0]} 1.0e-300")
    path.write_text(text)
    with pytest.raises(
        InputError, match=r"measurement.yaml: the stated noise gives the legs .* 0 mm: state noise from 1e"
    ):
        CliRunner().invoke(app, ["calibrate", "hybrid", "--data", str(folder)], catch_exceptions=False)
