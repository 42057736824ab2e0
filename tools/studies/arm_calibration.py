"""Study the calibration of an excavator arm with an external calibrator.

    python tools/studies/arm_calibration.py noise --seeds 200
    python tools/studies/arm_calibration.py bad-data --trials 200 --clean 200
    python tools/studies/arm_calibration.py tip --machines 20
    python tools/studies/arm_calibration.py speed

Each prints a Markdown section; `--out FILE` writes it. Truth, noise and corruption are simulated by
`hydrotele.experiments.calibrator_readings`; the identification sees readings only.
"""

import argparse
import dataclasses
import time

import numpy as np

from hydrotele.calibrate.arm_identification import identify_arm, identify_jointly
from hydrotele.calibrate.arm_poses import add_held_link_drift
from hydrotele.calibrate.bad_data import identify_without_bad_data
from hydrotele.calibrate.calibration_loop import build_loop, unit_of
from hydrotele.calibrate.link_sweeps import DRIFT_FREE_SWEEPS, PUBLISHED_SWEEPS, generate_sweep_poses
from hydrotele.calibrate.machine_correction import update_machine_geometry
from hydrotele.experiments.calibrator_readings import (
    compute_tip_errors,
    find_true_parameters,
    perturb_loop,
    simulate_readings,
)
from hydrotele.machine.machine_file import load_machine

TRUTH = 1992  # seed of the machine whose noise is studied


def noise(seeds: int) -> str:
    """Bias, spread and coverage of both identifications over seeds of sensor noise."""
    nominal = build_loop(load_machine("calibrator"))
    true = perturb_loop(nominal, np.random.default_rng(TRUTH))
    clean = [generate_sweep_poses(true, link, sweep) for link, sweep in DRIFT_FREE_SWEEPS.items()]
    errors, inside, spreads = [], [], []
    names: tuple[str, ...] = ()
    for seed in range(seeds):
        rng = np.random.default_rng([TRUTH, seed])
        stages = [simulate_readings(true, one, rng) for one in clean]
        one = identify_arm(nominal, stages)
        both = [one, identify_jointly(one, stages)]
        names = one.names
        truth = find_true_parameters(true, nominal, names, clean)
        errors.append([fit.values - truth for fit in both])
        spreads.append([fit.standard_deviations for fit in both])
        inside.append([(fit.intervals[:, 0] <= truth) & (truth <= fit.intervals[:, 1])
                       for fit in both])  # fmt: skip
    error, cover, spread = np.array(errors), np.array(inside), np.array(spreads)
    rms = np.sqrt(np.mean(error**2, axis=0))
    lines = [
        "This study asks whether the identification is unbiased, whether its intervals are right, and whether the"
        " joint identification is more accurate than the hierarchical one."
        f" {seeds} simulated measurements have uniform sensor noise within 0.1 deg in"
        f" {sum(len(c.theta) for c in clean)} poses; the machine differs from nominal by N(0, 30 mm) and N(0, 1 deg).",
        "",
        "Columns: bias with its standard error, standard deviation (std) and coverage of the 95 % intervals, first for"
        " the hierarchical and then for the joint identification. Lengths are in mm, angles in mdeg; smaller is better,"
        " coverage should be 95 %. The last column is the ratio of the RMS errors; below 1 the joint identification is"
        " more accurate.",
        "",
        "Rows: a parameter and the stage (`pitch`, ...) in which it is identified. p_xy, p_z: distance of the ball from"
        " the moving axis and its height along it; alpha, a, d, beta: Denavit-Hartenberg parameters, with Hayati's"
        " angle beta; held: constant angle of a held joint; offset: zero of an angle sensor (`calibrator_yoke`,"
        " `calibrator_twist`: joints 6 and 7, of the calibrator).",
        "",
        "| parameter | bias, hierarchical | std | coverage 95 % | bias, joint | std |"
        " coverage 95 % | RMS joint / hierarchical |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]  # fmt: skip
    for k, name in enumerate(names):
        scale = 1e3 if unit_of(name) == "m" else 1e3 * np.degrees(1.0)
        cells = [name]
        for m in range(2):
            std = scale * error[:, m, k].std(ddof=1)
            cells += [f"{scale * error[:, m, k].mean():.2f} +- {std / np.sqrt(seeds):.2f}",
                      f"{std:.2f}", f"{100 * cover[:, m, k].mean():.1f} %"]  # fmt: skip
        cells.append(f"{rms[1, k] / rms[0, k]:.3f}")
        lines.append("| " + " | ".join(cells) + " |")
    z = error.mean(axis=0) / (error.std(axis=0, ddof=1) / np.sqrt(seeds))
    ratio, told = rms[1] / rms[0], np.mean(spread[:, 1], axis=0) / np.mean(spread[:, 0], axis=0)
    lines += [
        "",
        f"Largest ratio of bias to its standard error: {np.abs(z[0]).max():.2f} hierarchical,"
        f" {np.abs(z[1]).max():.2f} joint. Mean coverage {100 * cover[:, 0].mean():.1f} % and"
        f" {100 * cover[:, 1].mean():.1f} %; by parameter"
        f" {100 * cover[:, 0].mean(axis=0).min():.1f} to"
        f" {100 * cover[:, 0].mean(axis=0).max():.1f} % and"
        f" {100 * cover[:, 1].mean(axis=0).min():.1f} to"
        f" {100 * cover[:, 1].mean(axis=0).max():.1f} % (binomial standard error"
        f" {100 * np.sqrt(0.05 * 0.95 / seeds):.1f} %). Ratio of the RMS errors, joint to"
        f" hierarchical: {ratio.min():.2f} to {ratio.max():.2f}; expected from the covariances"
        f" {told.min():.2f} to {told.max():.2f}.",
    ]
    return "\n".join(lines)


def corrupted(theta: np.ndarray, rng: np.random.Generator, joint: int) -> tuple[np.ndarray, slice]:
    """A stage's readings with one joint wrong in a region: offset, scatter or a bend and back."""
    count = len(theta)
    length = int(rng.integers(count // 10, count // 3))
    first = int(rng.integers(0, count - length))
    size = np.radians(rng.uniform(1.0, 4.0)) * rng.choice([-1.0, 1.0])
    kind = int(rng.integers(3))
    form = (np.ones(length), rng.standard_normal(length),
            np.sin(np.pi * (np.arange(length) + 0.5) / length))[kind]  # fmt: skip
    theta = theta.copy()
    theta[first : first + length, joint] += size * form
    return theta, slice(first, first + length)


def bad_data(trials: int, clean_trials: int, poses: int = 150) -> str:
    """Hidden corruption: found regions and joints, false alarms, errors with and without."""
    nominal = build_loop(load_machine("calibrator"))
    lines, alarms = [], {}
    cases = {"fixed": DRIFT_FREE_SWEEPS, "drifting": PUBLISHED_SWEEPS}
    for word, sweeps in cases.items():
        alarms[word] = 0
        for trial in range(clean_trials // 2):
            rng = np.random.default_rng([1, trial])
            true = perturb_loop(nominal, rng)
            clean = [generate_sweep_poses(true, n, s._replace(poses=poses), trial)
                     for n, s in sweeps.items()]  # fmt: skip
            stages = [add_held_link_drift(nominal, simulate_readings(true, c, rng)) for c in clean]
            alarms[word] += bool(identify_without_bad_data(nominal, stages).regions)
    places = joints = possible = 0
    before, after = [], []
    misses = []
    for trial in range(trials):
        rng = np.random.default_rng([2, trial])
        true = perturb_loop(nominal, rng)
        clean = [generate_sweep_poses(true, n, s._replace(poses=poses), trial) for n, s in DRIFT_FREE_SWEEPS.items()]
        stages = [add_held_link_drift(nominal, simulate_readings(true, c, rng)) for c in clean]
        which, joint = int(rng.integers(len(stages))), int(rng.integers(4))
        theta, region = corrupted(stages[which].theta, rng, joint)
        stages[which] = dataclasses.replace(stages[which], theta=theta)
        link, name = stages[which].link, nominal.links[nominal.powered_count + joint]
        cleaned = identify_without_bad_data(nominal, stages)
        plain = identify_arm(nominal, stages)
        marked = np.zeros(poses, bool)
        for r in cleaned.regions:
            if r.link == link:
                marked[r.first : r.last + 1] = True
        asked = np.zeros(poses, bool)
        asked[region] = True
        overlap = (marked & asked).sum() / max((marked | asked).sum(), 1)
        found = overlap >= 0.5 and all(r.link == link for r in cleaned.regions)
        right = found and all(r.joint == name for r in cleaned.regions)
        maybe = found and all(name in r.possible for r in cleaned.regions)
        places, joints, possible = places + found, joints + right, possible + maybe
        if not right:
            said = "; ".join(f"{r.joint or 'arm sensor'} {r.first}-{r.last}" for r in cleaned.regions)
            misses.append(f"trial {trial}: {link}, {name} {region.start}-{region.stop - 1}, found"
                          f" {said or 'nothing'}, overlap {overlap:.2f}")  # fmt: skip
        truth = find_true_parameters(true, nominal, plain.names, clean)
        scale = identify_scale(plain)
        before.append(np.mean(((plain.values - truth) / scale) ** 2))
        after.append(np.mean(((cleaned.fit.values - truth) / scale) ** 2))
    one, two = np.sqrt(np.mean(before)), np.sqrt(np.mean(after))
    each = np.sqrt(np.array(before) / np.array(after))
    half = clean_trials // 2
    lines += [
        "This study asks whether the program "
        "finds corrupted readings without help."
        " There are"
        f" {trials} measurements of {poses} poses per link, each of a different machine. One joint"
        " of the calibrator has an error of 1 to 4 deg in 10 to 33 % of the poses of one link (an offset, scatter or a"
        " temporary bend). A *region* is the range of consecutive poses that the program excludes. It counts as found"
        " if it overlaps the true one by at least half. \"Held links drifting\": measurements without bad data in which"
        " links drift; a region found there is a false alarm.", "",
        "| | |", "| --- | --- |",
        f"| region found (overlap over union at least 0.5, no other region) |"
        f" {100 * places / max(trials, 1):.1f} % |",
        f"| region found and joint identified | {100 * joints / max(trials, 1):.1f} % |",
        "| region found and joint among the possible ones |"
        f" {100 * possible / max(trials, 1):.1f} % |",
        f"| false alarms, held links fixed | {alarms['fixed']} of {half} |",
        f"| false alarms, held links drifting | {alarms['drifting']} of {half} |",
        "| RMS error of all parameters relative to their expected sizes, with bad data (lower is better) |"
        f" {one:.4f} |",
        f"| the same after the program has excluded the regions that it found | {two:.4f}, {one / two:.1f} "
        "times smaller |",
        "| ratio of both errors in single trials: median, 10 % quantile |"
        f" {np.median(each):.1f},"
        f" {np.quantile(each, 0.1):.1f} |",
        "", "Trials in which the joint is not identified (stage, joint and poses with the error; joint and poses found;"
        " overlap):", *(f"- {m}" for m in misses),
    ]  # fmt: skip
    return "\n".join(lines)


def identify_scale(fit) -> np.ndarray:
    """Expected size of every parameter: 0.1 m and 5 deg."""
    return np.array([0.1 if unit_of(n) == "m" else np.radians(5.0) for n in fit.names])


def tip(machines: int) -> str:
    """Error of the arm's tip when resolved motion uses the nominal or the calibrated machine."""
    rows = ["| machine | nominal, RMS [mm] | calibrated, RMS [mm] |", "| --- | --- | --- |"]
    pairs = []
    nominal = load_machine("calibrator")
    for seed in range(machines):
        loop = build_loop(nominal)
        rng = np.random.default_rng([3, seed])
        true = perturb_loop(loop, rng, sensor_offset=0.5)
        clean = [generate_sweep_poses(true, link, sweep) for link, sweep in DRIFT_FREE_SWEEPS.items()]
        stages = [simulate_readings(true, one, rng) for one in clean]
        pairs.append(compute_tip_errors(nominal, update_machine_geometry(nominal, loop, true), true, stages))
        rows.append(f"| {seed} | {1e3 * pairs[-1][0]:.1f} | {1e3 * pairs[-1][1]:.1f} |")
    one, two = np.sqrt(np.mean(np.square(pairs), axis=0))
    rows += ["", f"RMS of all machines: {1e3 * one:.1f} mm nominal, {1e3 * two:.1f} mm calibrated,"
             f" {one / two:.1f} times smaller."]  # fmt: skip
    return "\n".join(rows)


def speed() -> str:
    """Time of the hierarchical and the joint identification over the number of poses."""
    nominal = build_loop(load_machine("calibrator"))
    true = perturb_loop(nominal, np.random.default_rng(TRUTH))
    rows = [
        "CPU time of one process with one thread, for the hierarchical identification and for the joint"
        " identification that follows it.",
        "",
    ]
    rows += ["| poses | hierarchical [s] | then joint [s] |", "| --- | --- | --- |"]
    for poses in (100, 200, 400, 800):
        rng = np.random.default_rng(5)
        stages = [simulate_readings(true, generate_sweep_poses(true, n, s._replace(poses=poses)), rng)
                  for n, s in DRIFT_FREE_SWEEPS.items()]  # fmt: skip
        times = []
        for _ in range(3):
            begin = time.process_time()
            fit = identify_arm(nominal, stages)
            middle = time.process_time()
            identify_jointly(fit, stages)
            times.append((middle - begin, time.process_time() - middle))
        one, two = np.min(times, axis=0)
        rows.append(f"| {4 * poses} | {one:.2f} | {two:.2f} |")
    return "\n".join(rows)


def main() -> None:
    """Run one study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=("noise", "bad-data", "tip", "speed"))
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--clean", type=int, default=200)
    parser.add_argument("--machines", type=int, default=20)
    parser.add_argument("--out")
    asked = parser.parse_args()
    made = {
        "noise": lambda: noise(asked.seeds),
        "bad-data": lambda: bad_data(asked.trials, asked.clean),
        "tip": lambda: tip(asked.machines),
        "speed": speed,
    }[asked.study]()
    print(made)
    if asked.out:
        with open(asked.out, "w", encoding="utf-8") as file:
            file.write(made + "\n")


if __name__ == "__main__":
    main()
