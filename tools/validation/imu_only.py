"""Check `calibrate imu` and `gap` on logs of a CAT 215 that has IMUs and pressures but no joint sensors.

    python tools/validation/imu_only.py --out runs/imu --trials 5 --seed 1
    python tools/validation/imu_only.py --out runs/imu --trials 20 --seed 100 --no-gap

Each trial draws the mounting errors, biases and one hidden effect, and simulates four runs of 50 s,
which rest for 5 s at both ends. The machine file given to the commands has the nominal mounting and
no bias. The pose at the start of the first run, and the slew angle at the start of the others, are
known with a standard deviation of 0.1 deg. Prints one line per trial and the summary.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import yaml

from hydrotele.effects import EFFECTS
from hydrotele.logs.log import load_log, save_log
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.pilots import TablePilot
from hydrotele.scenario.scenario import PlantedEffect
from tools.validation.blind.draw import draw_effect
from tools.validation.blind.motions import RATE, motions

POSITIONS = {"swing": [0.5, 0.3, 0.4], "boom": [2.5, 0.0, 0.9], "stick": [0.9, 0.1, 0.2]}  # m, in the link's frame
GYRO_NOISE, ACCELEROMETER_NOISE = 0.0012, 0.03  # rad/s and m/s^2 at 50 Hz: 0.014 deg/s and 0.6 mg per sqrt(Hz)
ROTATION_SD, GYRO_BIAS_SD, ACCELEROMETER_BIAS_SD = np.radians(3.0), 0.005, 0.03  # of the drawn errors
POSE_SD = np.radians(0.1)
REST = 5.0  # s at rest at the start and at the end of each run
LIMIT = 0.3  # deg
WITHOUT_MEANING = ("angle_", "length_", "clock_offset", "base_tilt", "link_length")  # joint sensors and geometry


def write_machine(folder: Path, errors: dict[str, dict], gyro_noise: float) -> None:
    """Write a CAT 215 with IMUs; `errors` are further facts of each IMU."""
    mounted = {
        f"{link}_imu": {"type": "imu", "link": link, "position": position, "gyro_noise": gyro_noise,
                        "accelerometer_noise": ACCELEROMETER_NOISE, **errors.get(link, {})}
        for link, position in POSITIONS.items()
    }  # fmt: skip
    sensors = {
        "rate": RATE, "absent": ["angle", "position", "length"], "mounted": mounted,
        "pressure": {"accuracy_psi": 5, "bits": 12, "span_psi": 5000},
    }  # fmt: skip
    folder.mkdir(parents=True)
    facts = {"name": "cat215", "extends": {"machine": "cat215", "tool": "none"}, "sensors": {"imu": sensors}}
    (folder / "machine.yaml").write_text(yaml.safe_dump(facts, sort_keys=False))


def simulate(
    folder: Path, rng: np.random.Generator, effect: str | None, gyro_noise: float
) -> tuple[dict, dict[str, dict], list[str]]:
    """Write machines and logs of a trial; return its hidden effect, the true angles, and known poses."""
    errors = {
        link: {"rotation": rng.normal(0.0, ROTATION_SD, 3).tolist(),
               "gyro_bias": rng.normal(0.0, GYRO_BIAS_SD, 3).tolist(),
               "accelerometer_bias": rng.normal(0.0, ACCELEROMETER_BIAS_SD, 3).tolist()}
        for link in POSITIONS
    }  # fmt: skip
    write_machine(folder / "true", errors, gyro_noise)
    write_machine(folder / "nominal", {}, gyro_noise)
    (folder / "logs").mkdir()
    nominal = load_machine("cat215")
    planted = draw_effect(nominal, rng)
    while planted.name.startswith(WITHOUT_MEANING) or (effect and planted.name != effect):
        planted = draw_effect(nominal, rng)
    hidden = PlantedEffect(name=planted.name, location=planted.location, parameters=planted.parameters)
    truth, poses = {}, []
    for scenario in motions(nominal, rng):
        pilot = scenario.pilot
        assert isinstance(pilot, TablePilot)
        rows = round(REST * RATE)
        columns = {a: [q[0]] * rows + list(q) + [q[-1]] * rows for a, q in pilot.columns.items()}
        count = len(next(iter(columns.values())))
        pilot = pilot.model_copy(update={"columns": columns, "time": tuple(np.arange(count) / RATE)})
        own = scenario.model_copy(update={
            "machine": str(folder / "true"), "sensors": "imu", "pilot": pilot, "duration": count / RATE,
            "effects": (hidden,)})  # fmt: skip
        run = run_scenario(own)
        save_log(run.measured, folder / "logs" / f"{own.name}.parquet")
        truth[own.name] = {axis: run.truth[f"angle.{axis}"] for axis in POSITIONS}
        known = POSITIONS if not poses else ("swing",)
        at = round(1.0 * RATE)
        values = (f"{a}={truth[own.name][a][at] + rng.normal(0.0, POSE_SD):.6f}" for a in known)
        poses.append(f"{own.name}@1.0 {' '.join(values)}")
    return hidden.model_dump(), truth, poses


def main() -> None:
    """Run the trials and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--effect", choices=sorted(EFFECTS), help="hidden effect; default: drawn")
    parser.add_argument("--gyro-noise", type=float, default=GYRO_NOISE, help="rad/s per reading at 50 Hz")
    parser.add_argument("--no-gap", action="store_true")
    arguments = parser.parse_args()
    errors, ratios, answers = [], [], []
    for trial in range(arguments.seed, arguments.seed + arguments.trials):
        folder = arguments.out.resolve() / f"{trial:04d}"
        hidden, truth, poses = simulate(folder, np.random.default_rng(trial), arguments.effect, arguments.gyro_noise)
        command = [sys.executable, "-m", "hydrotele"]
        calibrate = [*command, "calibrate", "imu", "--data", str(folder / "logs"), "--machine", str(folder / "nominal"),
                     "--out", str(folder / "calibrated"), "--json"]  # fmt: skip
        for pose in poses:
            calibrate += ["--pose", pose]
        found = json.loads(subprocess.run(calibrate, check=True, capture_output=True, text=True).stdout)
        texts = []
        for name, angles in truth.items():
            log = load_log(folder / "calibrated" / "logs" / f"{name}.parquet")
            for axis, angle in angles.items():
                error = np.degrees(log[f"angle.{axis}"] - angle)
                errors.append((axis, float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())))
                stated = np.degrees(np.hypot(*found["runs"][name][axis].values()))
                ratios.append(errors[-1][1] / stated)
                texts.append(f"{axis} {errors[-1][1]:.2f}/{errors[-1][2]:.2f}")
        print(f"trial {trial}: RMS/max error [deg]: {', '.join(texts)}", flush=True)
        if arguments.no_gap:
            continue
        gap = [*command, "gap", "--data", str(folder / "calibrated/logs"), "--machine",
               str(folder / "calibrated/machine.yaml"), "--out", str(folder / "gap"),
               "--json"]  # fmt: skip
        result = subprocess.run(gap, check=False, capture_output=True, text=True)
        document = json.loads((folder / "gap" / "gap.json").read_text()) if not result.returncode else {}
        named = [f"{e['name']}({e['location']})" for e in document.get("effects", [])]
        answers.append(f"{hidden['name']}({hidden['location']})" in named)
        print(
            f"  hidden {hidden}, named {', '.join(named) or result.stderr[-300:] or document.get('verdict')}",
            flush=True,
        )
    for axis in POSITIONS:
        rms, high = (np.array([e[k] for e in errors if e[0] == axis]) for k in (1, 2))
        print(f"{axis}: RMS error median {np.median(rms):.3f}, largest {rms.max():.3f} deg; largest error"
              f" {high.max():.3f} deg; runs with RMS <= {LIMIT} deg: {np.sum(rms <= LIMIT)} of {len(rms)}, with"
              f" largest error <= {LIMIT} deg: {np.sum(high <= LIMIT)}")  # fmt: skip
    print(f"RMS error / stated standard deviation: RMS {np.sqrt(np.mean(np.square(ratios))):.2f}")
    if answers:
        print(f"gap named the hidden effect at its location in {sum(answers)} of {len(answers)} trials")


if __name__ == "__main__":
    main()
