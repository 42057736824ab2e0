"""The learning example at its smallest: it learns, writes, reads back and compares."""

import sys

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="the extra `learn` is not installed")

from tools.studies import learn  # noqa: E402 - after the skip


def test_a_policy_is_learned_written_read_back_and_compared(tmp_path, monkeypatch, capsys):
    words = ["learn.py", "TrackTrajectory", "--out", f"{tmp_path}", "--minutes", "0.02"]
    words += ["--envs", "4", "--threads", "1", "--variants", "2", "--episodes", "2"]
    words += ["--steps", "8", "--batch", "16", "--width", "8"]
    monkeypatch.setattr(sys, "argv", words)
    learn.main()
    first = capsys.readouterr().out
    kept = np.load(tmp_path / "normalisation.npz")
    assert np.isfinite(kept["mean"]).all() and (kept["scale"] > 0.0).all()
    monkeypatch.setattr(sys, "argv", [*words, "--judge"])
    learn.main()
    assert capsys.readouterr().out == first
    rows = [line.split("|")[1].strip() for line in first.splitlines() if line.startswith("|")]
    assert rows[2] == "learned" and rows[3].startswith("reference")
    assert first in (tmp_path / "scores.md").read_text()


def test_differences_are_those_of_the_same_episodes():
    units = {"return": "1"}
    ours = learn.Scores({"return": np.array([2.0, 5.0, 4.0])}, units)
    theirs = learn.Scores({"return": np.array([1.0, 3.0, 1.0])}, units)
    # gains 1, 2, 3: mean 2, standard error 1 / sqrt(3)
    said = learn.difference([("a", ours), ("b", theirs)], "return")
    assert said == "return: +2, 3.5 standard errors"
