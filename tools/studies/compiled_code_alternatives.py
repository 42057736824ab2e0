"""Compare ways to ship compiled code: loading time and speed.

    python tools/studies/compiled_code_alternatives.py        # needs a filled cache and a C compiler `cc`

(a) Stored numba code, as `core.code_cache` loads it, for the functions of an environment.
(b) The same object code loaded by llvmlite alone, without numba's types and wrappers.
(c) One law, the step of a valve spool, written in C and compiled for the same processor; time per call in a loop.
"""

import argparse
import ctypes
import subprocess
import tempfile
import time
from pathlib import Path

import gymnasium
from llvmlite import binding

import hydrotele.envs  # noqa: F401, registers the environments
from hydrotele.core import target_processor
from hydrotele.core.code_cache import CodeCache
from hydrotele.core.compiled import compiled
from hydrotele.hydraulics.laws import spool_step

CALLS = 2_000_000
REPETITIONS = 7
SPOOL = (50.0, 0.9, 1.0e-3, 20.0)  # bandwidth [rad/s], damping [1], time step [s], slew limit [1/s]
LAW = """
#include <math.h>
static void spool_step(double *spool, double *rate, double u, double w, double z, double dt, double limit) {
    int parts = 1 + (int)(w * dt / 0.5);
    double h = dt / parts, w2 = w * w, c = 2.0 * z * w, e = *spool - u, v = *rate;
    for (int k = 0; k < parts; ++k) {
        double e0 = e, v0 = v;
        double v1 = -w2 * e - c * v, v2 = -w2 * v - c * v1, v3 = -w2 * v1 - c * v2, v4 = -w2 * v2 - c * v3;
        e += h * (v + h * (v1 / 2 + h * (v2 / 6 + h * v3 / 24)));
        v += h * (v1 + h * (v2 / 2 + h * (v3 / 6 + h * v4 / 24)));
        if (limit > 0.0 && fabs(v) > limit) {
            v = copysign(limit, v);
            e = e0 + 0.5 * h * (fmin(fmax(v0, -limit), limit) + v);
        }
    }
    *spool = e + u, *rate = v;
}
double run(long calls, double w, double z, double dt, double limit) {
    double spool = 0.0, rate = 0.0, sum = 0.0;
    for (long k = 0; k < calls; ++k) {
        spool_step(&spool, &rate, (k & 255) < 128 ? 1.0 : -1.0, w, z, dt, limit);
        sum += spool;
    }
    return sum;
}
"""


@compiled
def run_spool(calls, w, z, dt, limit):
    """Return the sum of the spool's positions over many steps with alternating commands."""
    spool, rate, total = 0.0, 0.0, 0.0
    for k in range(calls):
        spool, rate = spool_step(spool, rate, 1.0 if k & 255 < 128 else -1.0, w, z, dt, limit)
        total += spool
    return total


def load_environment() -> tuple[float, list[tuple[bytes, str]]]:
    """Make an environment; return the processor time of loading its code [s], and (object code, symbol) of each."""
    found: list[tuple[bytes, str]] = []
    depth, spent = [0], [0.0]
    load, restore = CodeCache.load_overload, target_processor._Library._unserialize.__func__

    def timed(self, *args):
        depth[0] += 1
        start = time.process_time()
        try:
            return load(self, *args)
        finally:
            depth[0] -= 1
            spent[0] += 0.0 if depth[0] else time.process_time() - start

    def recorded(cls, codegen, state):
        _, kind, data = state
        if kind == "linked":
            found.append((data[0], next(name for name in data[1] if not name.startswith((".", "_ZN08NumbaEnv")))))
        return restore(cls, codegen, state)

    CodeCache.load_overload, target_processor._Library._unserialize = timed, classmethod(recorded)
    env = gymnasium.make("hydrotele/TrackTrajectory-v0")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    return spent[0], found


def load_objects(codes: list[tuple[bytes, str]]) -> float:
    """Load object code with llvmlite alone; return the processor time [s]."""
    machine = binding.Target.from_triple(binding.get_process_triple()).create_target_machine()
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
    start = time.process_time()
    for code, symbol in codes:
        engine.add_object_file(binding.ObjectFileRef.from_data(code))
        engine.finalize_object()
        assert engine.get_function_address(symbol)
    return time.process_time() - start


def compile_c(folder: Path):
    """Compile the law in C for the level of x86-64 of the shipped code, and return the function `run`."""
    (folder / "law.c").write_text(LAW)
    options = ["-O3", f"-march={target_processor.processor_name()}", "-shared", "-fPIC"]
    subprocess.run(["cc", *options, "-o", "law.so", "law.c", "-lm"], cwd=folder, check=True)
    run = ctypes.CDLL(str(folder / "law.so")).run
    run.restype, run.argtypes = ctypes.c_double, [ctypes.c_long, *[ctypes.c_double] * 4]
    return run


def nanoseconds_per_call(run) -> float:
    """Return the shortest processor time per step of the law [ns] over several repetitions."""
    times = []
    for _ in range(REPETITIONS):
        start = time.process_time()
        run(CALLS, *SPOOL)
        times.append(time.process_time() - start)
    return min(times) / CALLS * 1e9


def main() -> None:
    """Print the loading times and the speed of the law."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    seconds, codes = load_environment()
    size = sum(len(code) for code, _ in codes) / 1e6
    print(f"(a) stored numba code: {seconds * 1e3:.0f} ms")
    print(f"(b) object code alone: {load_objects(codes) * 1e3:.0f} ms for {len(codes)} functions, {size:.2f} MB")
    with tempfile.TemporaryDirectory() as folder:
        run_c = compile_c(Path(folder))
        difference = abs(run_c(CALLS, *SPOOL) / run_spool(CALLS, *SPOOL) - 1.0)
        print(f"(a), (b) law: {nanoseconds_per_call(run_spool):.2f} ns per call")
        print(f"(c) law: {nanoseconds_per_call(run_c):.2f} ns per call; relative difference {difference:.1e}")


if __name__ == "__main__":
    main()
