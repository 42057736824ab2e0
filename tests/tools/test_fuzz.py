"""A few damaged files of every kind end in one sentence.

`tools/validation/fuzz.py` tries thousands.
"""

from collections import Counter

import pytest

from tools.validation import fuzz


@pytest.mark.nightly
def test_damaged_files_end_in_one_sentence():
    verdicts = [fuzz.judge(seed) for seed in range(1000, 1050)]
    assert [(v.seed, v.kind, v.defect, v.words[-300:]) for v in verdicts if v.defect] == []
    assert len(Counter(v.kind for v in verdicts)) >= 8
    assert sum(v.words.startswith("error ") for v in verdicts) > 25, "most of them are damaged"


def test_what_counts_as_a_defect():
    assert fuzz._defect(2, "error a.yaml:3: is wrong", 0.1) == ""
    assert fuzz._defect(1, "Traceback (most recent call last):", 0.1) == "traceback"
    assert fuzz._defect(-11, "", 0.1) == "SIGSEGV"
    assert fuzz._defect(-9, "", 61.0) == "hang"
    assert fuzz._defect(2, "error " + "x" * 3000, 0.1) == "long message"
    assert fuzz._defect(1, "", 0.1) == "exit status 1"
