"""Hash results of scenarios, environments and a gap search, to compare two checkouts bit by bit.

    python tools/validation/hash_results.py > new.txt
    (cd ../other && PYTHONPATH=. python tools/validation/hash_results.py) | diff - new.txt

One line per result: its name and a digest of all numbers. Equal lines mean equal bits.
"""

import argparse
import hashlib
from pathlib import Path

import gymnasium
import numpy as np

from hydrotele.envs import TASK_NAMES
from hydrotele.gap.find import find_gap
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.dataset_reduction import select_exciting_segments
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario

MEASURED = Path(__file__).resolve().parents[2] / "tests" / "data" / "measured"
SCENARIOS = {
    "dig": "3", "zhu_up": "2", "excitation": "3", "press_stiffness": "2", "fell_tree": "2",
    "feller_steps": "2", "eha_strokes": "2", "ec20_steps": "2",
}  # fmt: skip
"""Name of each scenario and its simulated time [s]."""


def hash_scenario(name: str, seconds: str) -> str:
    """Digest of all columns of both logs of a run."""
    run, found = run_scenario(load_scenario(name, {"duration": seconds})), hashlib.sha256()
    for log in (run.measured, run.truth):
        for column in log.columns:
            found.update(np.ascontiguousarray(log[column]).tobytes())
    return found.hexdigest()[:16]


def hash_environment(name: str, steps: int = 60) -> str:
    """Digest of observations and rewards under random actions."""
    env, found = gymnasium.make(f"hydrotele/{name}-v0"), hashlib.sha256()
    found.update(np.asarray(env.reset(seed=1)[0]).tobytes())
    env.action_space.seed(1)
    for _ in range(steps):
        observation, reward, *_ = env.step(env.action_space.sample())
        found.update(np.asarray(observation).tobytes() + np.float64(reward).tobytes())
    env.close()
    return found.hexdigest()[:16]


def hash_gap() -> str:
    """Digest of prediction errors, noise and calibration of a search with two effects."""
    data = select_exciting_segments(load_dataset([MEASURED / "open_04"], load_machine("cat215")), 10.0)
    gap = find_gap(data, effects=("valve_gain", "command_delay"))
    return hashlib.sha256(repr((gap.size, gap.noise, gap.calibration)).encode()).hexdigest()[:16]


def main() -> None:
    """Print all digests."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for name, seconds in SCENARIOS.items():
        print(f"scenario {name} {hash_scenario(name, seconds)}", flush=True)
    for name in TASK_NAMES:
        print(f"environment {name} {hash_environment(name)}", flush=True)
    print(f"gap {hash_gap()}", flush=True)


if __name__ == "__main__":
    main()
