"""Compile the CUDA kernel of a batch without a CUDA device, and print compile time, registers and memory.

    python tools/validation/batch_kernel.py --tool bucket
    python tools/validation/batch_kernel.py --task TrackTrajectory

It needs `hydrotele[gpu]`. numba-cuda and NVVM make PTX for compute capability 9.0, nvJitLink makes the
machine code.
"""

import argparse
import re
import time
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
from numba import from_dtype, typeof, types

from hydrotele.batch.batch import Batch
from hydrotele.batch.cuda_kernel import make_cuda_kernels, make_element_kernel
from hydrotele.batch.machine_step import NO_TASK
from hydrotele.batch.mechanism_code import trace_mechanism
from hydrotele.core.device import import_cuda
from hydrotele.envs.episode import NEXT_STEP
from hydrotele.envs.task_catalogue import make_task_core
from hydrotele.machine.machine_file import load_machine

CAPABILITY = (9, 0)


def device_type(value: Any) -> Any:
    """Return numba's type of a value on the device: matrices with several rows are stored column by column."""
    if hasattr(value, "_fields"):
        return types.NamedTuple([device_type(part) for part in value], type(value))
    if isinstance(value, np.ndarray):
        layout = "F" if value.ndim > 1 and len(value) > 1 else "C"
        return types.Array(from_dtype(value.dtype), value.ndim, layout)
    return typeof(value)


def link_machine_code(ptx: str) -> dict[str, Any]:
    """Link PTX to machine code; return processor time [s], size, stack and spilled registers [byte]."""
    nvjitlink, begin = import_module("cuda.bindings.nvjitlink"), time.process_time()
    linker = nvjitlink.create(2, [f"-arch=sm_{CAPABILITY[0]}{CAPABILITY[1]}", "-verbose"])
    code = ptx.encode()
    nvjitlink.add_data(linker, nvjitlink.InputType.PTX, code, len(code), "batch.ptx")
    nvjitlink.complete(linker)
    elapsed = time.process_time() - begin
    report = bytearray(nvjitlink.get_info_log_size(linker))
    nvjitlink.get_info_log(linker, report)
    text = report.decode()
    return {
        "cubin_s": round(elapsed, 1), "ptx_lines": ptx.count("\n"),
        "cubin_bytes": nvjitlink.get_linked_cubin_size(linker),
        "stack_bytes": max(int(n) for n in re.findall(r"(\d+) bytes stack frame", text)),
        "spill_bytes": max(int(n) for n in re.findall(r"(\d+) bytes spill stores", text)),
    }  # fmt: skip


def compile_to_ptx(kernel: Any, *arguments: Any) -> tuple[str, float]:
    """Return the PTX of a kernel for the types of its arguments, and the processor time [s]."""
    begin = time.process_time()
    signature = types.void(*map(device_type, arguments))
    ptx, _ = import_cuda().compile(kernel.py_func, signature, cc=CAPABILITY, output="ptx", abi="numba")
    return ptx, round(time.process_time() - begin, 1)


def compile_kernels(batch: Batch, precision: str) -> dict[str, dict[str, Any]]:
    """Compile the kernels that advance a batch; return their figures by name."""
    code = trace_mechanism(batch._single, batch.model, precision)
    kernels = make_cuda_kernels(batch._single, code, batch.task, batch.machine.terms)
    found = {}
    for name in ("step", "before", "after"):
        if (kernel := getattr(kernels, name)) is not None:
            arrays = NO_TASK.arrays if name == "step" else batch.task_arrays
            given = (batch.model, batch.machines, batch._noise, batch._timing, arrays, kernels.source)
            ptx, elapsed = compile_to_ptx(kernel, *given, *((1,) if name == "step" else ()))
            found[name] = {"ptx_s": elapsed} | link_machine_code(ptx)
    return found


def compile_begin(core: Any) -> dict[str, Any]:
    """Compile the kernel that begins episodes of an environment."""
    kernel, batch = make_element_kernel(core._functions.begin_one), core.batch
    records = (batch.task_arrays, batch.model, batch.machines)
    ptx, elapsed = compile_to_ptx(kernel, *records, np.zeros(0, np.uint64), np.zeros(2, np.int64))
    return {"ptx_s": elapsed} | link_machine_code(ptx)


def main() -> None:
    """Compile and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tool", default="bucket", help="tool of the cat215")
    parser.add_argument("--task", help="environment, such as TrackTrajectory, instead of the machine alone")
    parser.add_argument("--precision", choices=["mixed", "double"], default="mixed", help="of mass matrix and forces")
    chosen = parser.parse_args()
    dispatcher = import_module("numba.cuda.dispatcher")
    setattr(dispatcher, "get_current_device", lambda: SimpleNamespace(compute_capability=CAPABILITY))  # noqa: B010
    if chosen.task:
        core: Any = make_task_core(chosen.task, {"device": "cpu"}, 8, 1, NEXT_STEP)
        kernels = {"begin of episodes": compile_begin(core), **compile_kernels(core.batch, chosen.precision)}
    else:
        batch = Batch(load_machine("cat215", chosen.tool), 8, threads=1)
        kernels = compile_kernels(batch, chosen.precision)
    for title, figures in kernels.items():
        print(title)
        for name, value in figures.items():
            print(f"    {name:12} {value}")


if __name__ == "__main__":
    main()
