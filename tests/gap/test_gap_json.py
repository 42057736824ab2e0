"""`gap.json` has the fixed keys, is strict JSON, and says what the Gap says."""

import dataclasses
import json

import numpy as np
import pytest

from hydrotele.gap.result import gap_document

_KEYS = {
    "verdict", "effects", "calibration", "learned", "unknown", "lacks", "noise", "jitter", "gap",
    "tests", "laws", "next_experiment", "unused_channels", "notes", "seconds",
}  # fmt: skip


def _read(gap) -> dict:
    """Through the text, which must be strict JSON."""
    return json.loads(json.dumps(gap_document(gap), allow_nan=False))


@pytest.mark.parametrize("verdict", ["named", "partly", "no_gap", "unknown", "ambiguous"])
def test_keys_are_the_fixed_ones(gap_of, verdict):
    document = _read(gap_of(verdict))
    assert document.keys() == _KEYS and document["verdict"] == verdict
    assert document["gap"].keys() == {"metric", "before", "after", "noise_floor"}
    assert document["jitter"] == {"found": 0.0, "stated": 0.0}
    assert (document["unknown"] is None) == (verdict not in ("unknown", "partly"))
    assert (document["next_experiment"] is None) == (verdict != "ambiguous")


def test_an_effect_in_full(gap_of):
    (effect,) = _read(gap_of("ambiguous"))["effects"]
    assert effect == {
        "name": "length_offset",
        "location": "boom",
        "probability": 0.62,
        "mechanism_probability": 0.62,
        "share": None,
        "parameters": {"offset": {"value": -0.0061, "unit": "m", "ci95": [-0.0066, -0.0056]}},
        "alternatives": [{"name": "pin_offset", "location": "boom", "probability": 0.37, "same": False}],
    }


def test_an_unknown_in_full(gap_of):
    unknown = _read(gap_of("unknown"))["unknown"]
    assert unknown.keys() == {"law", "channel", "depends_on", "windows", "description"}
    assert unknown["windows"] == [[3.0, 4.6]]
    assert unknown["law"] == "force" and unknown["depends_on"] == ["length.boom"]


def test_calibration_laws_lacks_and_noise(gap_of):
    document = _read(gap_of("partly"))
    assert document["effects"][0]["share"] == 0.63
    assert document["calibration"]["valve_gain.boom.ratio"] == {
        "value": 1.04, "nominal": 1.0, "unit": "1", "ci95": [1.035, 1.045],
    }  # fmt: skip
    (law,) = document["learned"]
    assert law["balance"] == "force" and law["axis"] == "boom" and law["resembles"] is None
    assert len(law["points"]) == len(law["values"]) == len(law["spread"]) == 41
    assert document["lacks"][1] == {
        "balance": "command", "axis": "stick", "size": 0.002, "unit": "1", "part": 0.004,
    }  # fmt: skip
    assert document["noise"] == {
        "angle.boom": {"found": 1.2e-3, "stated": 1e-3},
        "length.boom": {"found": 1.2e-3, "stated": None},
    }
    assert document["tests"]["mean square"]["passed"] is True


def test_laws_carry_unit_and_null_for_what_is_not_known(gap_of):
    force = _read(gap_of("named"))["laws"]["force"]
    assert force["unit"] == "N m"
    assert force["places"]["boom"] == {"before": 21000.0, "after": 2600.0, "noise": 2500.0}
    assert force["places"]["stick"]["noise"] is None


def test_numbers_of_any_kind_come_out_plain(gap_of):
    size = dataclasses.replace(gap_of("named").size, before=np.float32(2.5), after=np.inf)
    experiment = {"reason": "x", "scenario": {"time": np.arange(3), "loud": np.bool_(True)}}
    gap = dataclasses.replace(gap_of("named"), size=size, next_experiment=experiment, seconds=np.nan)
    document = _read(gap)
    assert document["gap"]["before"] == 2.5 and document["gap"]["after"] is None
    assert document["next_experiment"]["scenario"] == {"time": [0, 1, 2], "loud": True}
    assert document["seconds"] is None
