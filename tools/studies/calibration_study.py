"""Study the coverage and accuracy of kinematic calibration; the first argument selects the study.

    python tools/studies/calibration_study.py mukca --trials 200

mukca   robots with random errors, calibrated from simulated postures with their ball in sockets:
        fraction of 95 % intervals that contain the true value, bias and standard deviation per
        parameter, held-out error compared with the noise.
"""

import argparse
import dataclasses
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from hydrotele.calibrate.socket_calibration import SocketOptions, calibrate_sockets, evaluate_robot
from hydrotele.calibrate.socket_measurement import RobotErrors, add_random_errors, simulate_sockets
from hydrotele.identify.identifiability import STATUS_COMBINATION, STATUS_FULL
from hydrotele.kinematics.serial_robot_files import load_robot

PLACES = {
    "left": (0.45, 0.25, 0.05), "right": (0.45, -0.30, 0.05), "front": (0.60, 0.0, 0.05),
    "high": (0.45, 0.0, 0.40),
}  # fmt: skip
JUDGED = {"unseen": (0.50, 0.15, 0.20)}


@dataclasses.dataclass(frozen=True)
class Trial:
    """Of one robot: parameters with truth, estimate and standard deviation, and errors [mm]."""

    names: tuple[str, ...]
    told: tuple[str, ...]
    error: np.ndarray
    std: np.ndarray
    combinations: np.ndarray
    heldout: float
    tip: float
    seconds: float


def mukca_trial(seed: int, robot_name: str, rows: int, errors: RobotErrors, same: bool) -> Trial:
    rng = np.random.default_rng([19, seed])
    nominal = load_robot(robot_name)
    drawn = np.random.default_rng(19) if same else rng
    true, values = add_random_errors(nominal, errors, drawn)
    sockets = simulate_sockets(true, PLACES, rows, errors, rng)
    begin = time.perf_counter()
    found = calibrate_sockets(nominal, sockets, SocketOptions(model="rigid"))
    seconds = time.perf_counter() - begin
    fit = found.fit
    error = fit.values - np.array([values[name] for name in fit.names])
    told = dict(zip(fit.identifiability.names, fit.identifiability.status, strict=True))
    order = [fit.names.index(name) for name in fit.identifiability.names]
    weights = fit.identifiability.combination
    spread = np.sqrt(np.einsum("ij,jk,ik->i", weights, fit.covariance[np.ix_(order, order)],
                               weights))  # fmt: skip
    unseen = simulate_sockets(true, JUDGED, rows, errors, rng)
    exact = dataclasses.replace(errors, play=0.0, encoder=0.0)
    clean = simulate_sockets(true, JUDGED, rows, exact, rng)
    return Trial(
        fit.names, tuple(told[name] for name in fit.names), error, fit.standard_deviations,
        weights @ error[order] / spread, 1e3 * evaluate_robot(found.robot, unseen).rms,
        1e3 * evaluate_robot(found.robot, clean).rms, seconds,
    )  # fmt: skip


def mukca(asked: argparse.Namespace) -> str:
    errors = RobotErrors(encoder=asked.encoder, play=asked.play)
    seeds = range(asked.seed, asked.seed + asked.trials)
    many = len(seeds)
    with ProcessPoolExecutor(asked.jobs) as pool:
        trials = []
        for trial in pool.map(mukca_trial, seeds, [asked.robot] * many, [asked.rows] * many,
                              [errors] * many, [asked.same] * many):  # fmt: skip
            trials.append(trial)
            if len(trials) % 20 == 0:
                print(f"{len(trials)} of {many}", file=sys.stderr, flush=True)
    error = np.array([t.error for t in trials])
    inside = np.abs(error) <= 1.959964 * np.array([t.std for t in trials])
    full = np.array([[s == STATUS_FULL for s in t.told] for t in trials])
    some = np.array([[s in (STATUS_FULL, STATUS_COMBINATION) for s in t.told] for t in trials])
    z = np.concatenate([t.combinations for t in trials])
    ball = inside[:, [k for k, n in enumerate(trials[0].names) if n.endswith(".tool")]]
    heldout = np.array([t.heldout for t in trials])
    tip = np.array([t.tip for t in trials])
    lines = [
        "This study asks whether the reported intervals are right."
        f" {many} simulated `{asked.robot}` robots with {'the same' if asked.same else 'random'}"
        " errors are calibrated. The standard deviations of the errors are: lengths 0.3 mm, tilts 1 mrad, "
        "joint offsets 3 mrad, ball 2 mm."
        f" Each is measured at 4 places with 2 sockets and {asked.rows} postures, with a ball play of"
        f" {1e3 * asked.play:g} mm and encoder noise of {1e6 * asked.encoder:g} urad.", "",
        "| intervals of | number | contain the true value [%] |", "| --- | ---: | ---: |",
        f"| identifiable parameters | {full.sum()} | {100 * inside[full].mean():.1f} |",
        f"| parameters identifiable only in combinations, split by the prior (not reported) |"
        f" {(some & ~full).sum()} | {100 * inside[some & ~full].mean():.1f} |",
        f"| identifiable combinations | {len(z)} | {100 * np.mean(np.abs(z) <= 1.959964):.1f} |",
        f"| the ball | {ball.size} | {100 * ball.mean():.1f} |", "",
        f"Held-out place: RMS distance {heldout.mean():.4f} mm (ball play alone"
        f" {1e3 * asked.play * 3**0.5:.4f}), without noise {tip.mean():.4f} mm (largest"
        f" {tip.max():.4f}). Median time of a calibration"
        f" {np.median([t.seconds for t in trials]):.2f} s.", "",
        "| parameter | identifiable in [%] | bias | std | stated std | coverage [%] |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]  # fmt: skip
    for k, name in enumerate(trials[0].names):
        if not some[:, k].any():
            continue
        stated = np.mean([t.std[k] for t in trials])
        lines.append(
            f"| {name} | {100 * full[:, k].mean():.0f} | {1e3 * error[:, k].mean():.3f} |"
            f" {1e3 * error[:, k].std(ddof=1):.3f} | {1e3 * stated:.3f} |"
            f" {100 * inside[:, k].mean():.1f} |"
        )
    lines += [
        "",
        "Bias and standard deviations in mm and mrad. Bias, standard deviations and coverage are over all"
        f" {many} data sets, also those in which the parameter is identifiable only in a combination.",
        "",
    ]
    return "\n".join(lines)


STUDIES = {"mukca": mukca}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--rows", type=int, default=20, help="postures per socket")
    parser.add_argument("--play", type=float, default=1e-4, help="of the ball, in m")
    parser.add_argument("--encoder", type=float, default=0.0, help="noise in rad")
    parser.add_argument("--same", action="store_true", help="the same errors for every seed")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    text = STUDIES[asked.study](asked)
    print(text)
    if asked.out:
        asked.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
