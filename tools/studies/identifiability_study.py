"""Determine the identifiable parameters of the CAT 215; compare with Khoshzaban's Table 13.

    python tools/studies/identifiability_study.py [--out docs/results/identifiability.md]

82 parameters: swing, boom, stick, two tubes and two rods with ten each, Coulomb friction and offset
of the drives, friction of joints and pins. The motion is 300 independent random states. The
cylinders end in pins, or in ball joints that carry no moment about the cylinders' axes.
"""

from hydrotele.experiments.khoshzaban_dynamics import TABLE_13, count_parameters
from hydrotele.experiments.khoshzaban_models import find_base
from tools.studies.study import options, publish

ENDS = (("ball joints (Eq. 4.23)", True), ("pins", False))


def report() -> str:
    """The tables."""
    bases = {said: find_base("complete", ball) for said, ball in ENDS}
    lines = [
        "| ends of the cylinders | rank | unidentifiable | linearly identifiable |"
        " fully identifiable | singular values at the rank |",
        "| --- | ---: | ---: | ---: | ---: | --- |",
        "| Khoshzaban, Table 13 | | " + " | ".join(map(str, TABLE_13.values())) + " | |",
    ]
    for said, base in bases.items():
        counts = " | ".join(str(n) for n in count_parameters(base.told).values())
        gap = "{:.1g}, {:.1g}".format(*base.told.gap)
        lines.append(f"| {said} | {len(base.told.base)} | {counts} | {gap} |")
    lines += ["", TEXT, "", "Fully identifiable parameters:", ""]
    for said, base in bases.items():
        told = zip(base.told.names, base.told.status, strict=True)
        lines.append(f"- {said}: {', '.join(n for n, status in told if status == 'full')}")
    return "\n".join(lines) + "\n"


TEXT = """\
As in the thesis (p. 100), unidentifiable counts the columns that have no effect and those for
which others can stand: 82 less the rank. Linearly identifiable are the remaining parameters that
stand for a combination. Singular values are those on either side of the rank, over the largest,
of columns of length 1. Nine parameters of the swing have no effect in either case: all but Izz.

Both counts are exact, under different assumptions. The thesis lets cylinders end in spherical
joints and sets the moment about their axes to zero (Eq. 4.23), while tube and rod turn with the
links as pins would turn them. `machine_setup(..., ball_joints=True)` is this model; it has the
thesis' 31, 24 and 27. Pins carry the moment that turns tubes and rods about the cylinders' axes
when the machine swings. Six combinations, which Eq. 4.23 separates, can then no longer be
separated from the inertias of the links. The two models differ by the inertia of tubes and rods
about their axes, 10 kg m^2 each in Table 13: 0.05 % of the swing's torque in his simulated
motions, and nothing in the cylinders' forces.

The regressor agrees with MuJoCo's inverse dynamics of the closed chain (pins) to 1e-8, and for
both assumptions with the thesis' recursion of wrenches from stick to swing (Eqs 4.20 to 4.47),
which `tests/experiments/test_khoshzaban_dynamics.py` derives a second time. The null space does
not depend on the states that are drawn."""


if __name__ == "__main__":
    asked = options(__doc__)
    publish(report(), "Identifiability of the complete model", asked)
