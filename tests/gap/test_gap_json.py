"""`gap.json` has the fixed keys, is strict JSON, and says what the Gap says."""

import dataclasses
import json

import numpy as np
import pytest

from hydrotele.gap.gap_json import gap_document

_KEYS = {"verdict", "effects", "unknown", "gap", "next_experiment", "laws", "seconds"}


def _read(gap) -> dict:
    """Through the text, which must be strict JSON."""
    return json.loads(json.dumps(gap_document(gap), allow_nan=False))


@pytest.mark.parametrize("verdict", ["named", "no_gap", "unknown", "ambiguous"])
def test_keys_are_the_fixed_ones(gap_of, verdict):
    document = _read(gap_of(verdict))
    assert document.keys() == _KEYS and document["verdict"] == verdict
    assert document["gap"].keys() == {"metric", "before", "after", "noise_floor"}
    assert (document["unknown"] is None) == (verdict != "unknown")
    assert (document["next_experiment"] is None) == (verdict != "ambiguous")


def test_an_effect_in_full(gap_of):
    (effect,) = _read(gap_of("ambiguous"))["effects"]
    assert effect == {
        "name": "length_offset",
        "location": "boom",
        "probability": 0.62,
        "parameters": {"offset": {"value": -0.0061, "unit": "m", "ci95": [-0.0066, -0.0056]}},
        "alternatives": [{"name": "pin_offset", "location": "boom", "probability": 0.37}],
    }


def test_an_unknown_in_full(gap_of):
    unknown = _read(gap_of("unknown"))["unknown"]
    assert unknown.keys() == {"law", "depends_on", "description"}
    assert unknown["law"] == "force" and unknown["depends_on"] == ["length.boom"]


def test_laws_carry_unit_and_null_for_what_is_not_known(gap_of):
    force = _read(gap_of("named"))["laws"]["force"]
    assert force["unit"] == "N m"
    assert force["places"]["boom"] == {"before": 21000.0, "after": 2600.0, "noise": 2500.0}
    assert force["places"]["stick"]["noise"] is None


def test_numbers_of_any_kind_come_out_plain(gap_of):
    size = dataclasses.replace(gap_of("named").size, before=np.float32(2.5), after=np.inf)
    experiment = {"reason": "x", "scenario": {"time": np.arange(3), "loud": np.bool_(True)}}
    gap = dataclasses.replace(
        gap_of("named"), size=size, next_experiment=experiment, seconds=np.nan
    )
    document = _read(gap)
    assert document["gap"]["before"] == 2.5 and document["gap"]["after"] is None
    assert document["next_experiment"]["scenario"] == {"time": [0, 1, 2], "loud": True}
    assert document["seconds"] is None
