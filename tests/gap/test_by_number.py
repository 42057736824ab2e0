"""An effect that does what a calibrated number would do becomes that number."""

from types import SimpleNamespace

import numpy as np
import pytest

from hydrotele.estimate.evidence import Fit, Judged
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, calibration, hypotheses
from hydrotele.gap import search
from hydrotele.machine.machine_file import load_machine

TRUE = 12_000.0  # N m, three times the model's
NUMBER = "coulomb_friction.swing.coulomb"
PLACE = "position_dependent_friction"


class Friction:
    """Evidence that feels how far the friction of the swing at some places is from the true one.

    `bump` is how much of the friction of the position is felt at each place.
    """

    slope_step = 1.0

    def __init__(self, bump: np.ndarray) -> None:
        self.data = SimpleNamespace(machine=load_machine("cat215"))
        self.bump, self.base = bump, Guess()

    def errors(self, guess: Guess, step: float) -> np.ndarray:
        felt = np.full(len(self.bump), -TRUE)
        for hypothesis, deviation in guess.parts:
            values = hypothesis.values(deviation)
            felt += values.get(NUMBER, 0.0)
            if hypothesis.name == "coulomb_friction":
                felt += values["coulomb"]
            if hypothesis.name == PLACE:
                felt += self.bump * values["coulomb"]
        return felt / 100.0

    def base_slopes(self, step: float) -> np.ndarray:
        here = self.errors(self.base, step)
        columns = []
        for index in range(len(self.base.deviation)):
            moved = self.base.deviation
            moved[index] += 0.01
            columns.append((self.errors(self.base.at(moved), step) - here) / 0.01)
        return np.column_stack(columns)

    def judged(self, guess: Guess) -> Judged:
        errors = self.errors(guess, 0.0)
        return Judged(guess, (), float(errors @ errors + guess.deviation @ guess.deviation))

    def set_base(self, judged: Judged) -> Judged:
        self.base = judged.guess
        return judged


def settled(evidence: Friction, judged: Judged) -> tuple[Judged, Fit]:
    """The guess as it is; its information counts each number alike."""
    size = len(judged.guess.deviation)
    evidence.set_base(judged)
    return judged, Fit(judged.guess, judged.loss, 0.0, 0.0, 100.0 * np.eye(size))


@pytest.mark.parametrize(
    ("width", "names"),
    [(50.0, {"coulomb_friction", CALIBRATION}), (0.2, {PLACE, CALIBRATION})],
)
def test_friction_of_all_positions_is_coulomb_friction(monkeypatch, width, names):
    """A bump wider than the range is the constant; one within the range stays what it is."""
    monkeypatch.setattr(search, "fit_until_settled", settled)
    place = np.linspace(-1.0, 1.0, 41)
    evidence = Friction(np.exp(-((place / width) ** 2)))
    candidates = [h for h in hypotheses(evidence.data.machine) if h.location == "swing"]
    effect = next(h for h in candidates if h.name == PLACE)
    group = calibration(evidence.data.machine, frozenset())
    (own,) = (p for key, p in group.parameters.items() if key == NUMBER)
    size = np.zeros(group.size)
    size[list(group.parameters).index(NUMBER)] = 500.0 / own.prior_std
    rest = (TRUE - own.nominal - 500.0 - effect.parameters["coulomb"].nominal) / effect.parameters["coulomb"].prior_std
    bump = np.array([rest if key == "coulomb" else 0.0 for key in effect.parameters])
    now, fit = settled(evidence, evidence.judged(Guess(((effect, bump), (group, size)))))
    found = search._by_number(evidence, search._Grown(now, fit), candidates)
    assert {h.name for h in found.now.guess.hypotheses} == names
    if PLACE not in names:
        value = dict(zip(found.now.guess.names, found.now.guess.deviation, strict=True))
        plain = next(h for h in found.now.guess.hypotheses if h.name == "coulomb_friction")
        told = plain.parameters["coulomb"].nominal + value[NUMBER] * plain.parameters["coulomb"].prior_std
        assert told == pytest.approx(TRUE, rel=0.01)  # the bump falls by 0.04 % within the range
        assert not any(CALIBRATION in n and NUMBER in n for n in found.now.guess.names)
