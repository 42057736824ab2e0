"""Compute workspace, singularities and speed of the hexapod PaLiDA, or design its excitation.

    python tools/studies/palida_study.py [--picture docs/validation/palida_workspace.png]
        [--out docs/validation/palida_kinematics.md]
    python tools/studies/palida_study.py --design 1 [--seed 1] [--iterations 12]

The map shows the condition number of the inverse Jacobian (leg rates per pose rates, rotations
counted at the radius of the platform's joints) over three cuts through the home pose; 1 is best,
infinite at a singularity. The line bounds what strokes and hinges allow. With `--design 1` the
excitation that comes with the model is designed and written again, which takes minutes.
"""

import json
import time
from pathlib import Path

import numpy as np

from hydrotele.core.files import models_folder
from hydrotele.experiments.palida import (
    HOME_POSE,
    STROKE,
    compute_force_covariance,
    load_excitation,
    load_robot,
    make_drive_limits,
)
from hydrotele.identify.excitation import design_motion
from hydrotele.multibody.closed_chain_kinematics import find_assemblies, joint_jacobian, solve_joint_positions
from tools.studies.study import options, publish

RADIUS = 0.085  # m, at which rotations count
HINGES = {"alpha": (-0.8, 0.8), "beta": (-0.2, 1.3)}  # rad
CELLS = 41
CUTS = (
    ("x [m]", "y [m]", 0, 1, (-0.45, 0.45), (-0.45, 0.45), 1.0),
    ("x [m]", "z [m]", 0, 2, (-0.45, 0.45), (0.25, 0.95), 1.0),
    ("rotation about z [deg]", "z [m]", 5, 2, (-2.1, 2.1), (0.25, 0.95), 180.0 / np.pi),
)

INTRODUCTION = (
    "How well conditioned is the geometry of the hexapod PaLiDA (a platform on six telescopic legs), and can "
    "its pose be computed from leg lengths? This study gives the condition number of its Jacobian, the "
    "number of poses with equal leg lengths, and the computing time of its regressor.\n\n"
    "The inverse Jacobian relates platform to leg velocities. A large condition number means that the pose is near a "
    "singularity, where legs cannot hold the platform. Rotations are multiplied by the radius of the platform's "
    f"joints, {1e3 * RADIUS:g} mm, so that they have the unit of translations. [The map](palida_workspace.png) has "
    "three cuts through the home pose; in each, two coordinates vary and the others are those of the home pose. Light "
    "is good and dark is singular (rotations by 90 deg about z). The white line is the workspace that leg strokes and "
    "hinges allow; it contains the singular poses, too."
)


def cut(
    first: int, second: int, wide: tuple[float, float], high: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Grid values (c,), (c,), condition numbers (c, c) and whether a pose is allowed (c, c)."""
    own, chain = load_robot(), load_robot().setup.chain
    a, b = np.linspace(wide[0], wide[1], CELLS), np.linspace(high[0], high[1], CELLS)
    condition, allowed = np.full((2, CELLS, CELLS), np.nan)
    drives = [chain.index(name) for name in chain.drives]
    scale = np.array([1.0, 1.0, 1.0, RADIUS, RADIUS, RADIUS])
    for row, value in enumerate(b):
        poses = np.tile(HOME_POSE, (CELLS, 1))
        poses[:, first], poses[:, second] = a, value
        middle = CELLS // 2
        out = solve_joint_positions(chain, own.setup.given_joints, poses[middle:])
        back = solve_joint_positions(chain, own.setup.given_joints, poses[middle::-1])
        q = np.concatenate([back[:0:-1], out])
        for column in range(CELLS):
            inverse = joint_jacobian(chain, q[column], chain.drives, own.setup.given_joints) / scale
            condition[row, column] = np.linalg.cond(inverse)
            legs = q[column, drives]
            good = np.all((legs > STROKE[0]) & (legs < STROKE[1]))
            for hinge, (low, top) in HINGES.items():
                angles = q[column, [chain.index(f"{hinge}_{k}") for k in range(1, 7)]]
                good &= bool(np.all((angles > low) & (angles < top)))
            allowed[row, column] = good
    return a, b, condition, allowed


def draw(target: Path) -> None:
    """Write the map."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes, shown = figure.subplots(1, 3), None
    for place, (x, y, first, second, wide, high, unit) in zip(axes, CUTS, strict=True):
        a, b, condition, allowed = cut(first, second, wide, high)
        shown = place.pcolormesh(
            unit * a,
            b,
            np.log10(condition),
            cmap="viridis_r",
            vmin=0.5,
            vmax=3.0,
            shading="nearest",
        )
        place.contour(unit * a, b, allowed, levels=[0.5], colors="white", linewidths=1.6)
        place.set_xlabel(x)
        place.set_ylabel(y)
    assert shown is not None
    bar = figure.colorbar(shown, ax=axes)
    bar.set_label("condition of the inverse Jacobian, log10")
    figure.suptitle("Singularities, and the workspace within stroke and hinge limits (white line)")
    figure.savefig(target, dpi=110)


def speed() -> tuple[int, float]:
    """Rows and processor seconds of the regressor of 20 s at 1 kHz."""
    own, motion = load_robot(), load_excitation()
    whole = motion.evaluate(np.arange(20_000) / 1000.0)
    own.matrix(whole[:, :10])  # compiled before
    started = time.process_time()
    own.matrix(whole)
    return 20_000, time.process_time() - started


def design(seed: int, iterations: int) -> None:
    """Design the excitation and write it beside the model."""
    own = load_robot()
    found = design_motion(
        make_drive_limits(), own.setup, compute_force_covariance(), own.base_parameters.base, period=3.0, harmonics=5,
        starts=1, iterations=iterations, seed=seed,
        progress=lambda stage, fraction: print(stage, f"{fraction:.2f}"),
    )  # fmt: skip
    parts = {
        "period": found.period, "mean": found.mean.tolist(), "sin": found.sin.tolist(),
        "cos": found.cos.tolist(), "criterion": found.criterion, "worst": found.max_utilisation,
    }  # fmt: skip
    target = models_folder() / "palida" / "excitation.json"
    target.write_text(json.dumps(parts, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Run the study."""
    asked = options(__doc__, design=0, seed=1, iterations=12, picture="")
    if asked.design:
        design(asked.seed, asked.iterations)
        return
    if asked.picture:
        draw(Path(asked.picture))
    own, rows = load_robot(), [INTRODUCTION, "", "| quantity | value |", "| --- | --- |"]
    chain = own.setup.chain
    q = solve_joint_positions(chain, own.setup.given_joints, HOME_POSE[None])[0]
    legs = q[[chain.index(name) for name in chain.drives]]
    scale = np.array([1.0, 1.0, 1.0, RADIUS, RADIUS, RADIUS])
    home = np.linalg.cond(joint_jacobian(chain, q, chain.drives, own.setup.given_joints) / scale)
    found = find_assemblies(chain, chain.drives, legs, body="platform", starts=2000)
    rows.append(f"| condition number of the inverse Jacobian at the home pose | {home:.1f} |")
    rows.append(
        f"| poses that have the same leg lengths as the home pose, found from 2000 random starts | {len(found)} |"
    )
    count, seconds = speed()
    rows.append(
        f"| time of the regressor (matrix that relates parameters to drive forces), {count} rows, 24 joints,"
        f" 19 bodies | {seconds:.2f} s on one core |"
    )
    publish("\n".join(rows) + "\n", "Kinematics of the hexapod PaLiDA", asked)


if __name__ == "__main__":
    main()
