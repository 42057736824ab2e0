"""Compile the CUDA kernel of a batch without a CUDA device, and print compile time, registers and memory.

    python tools/validation/batch_kernel.py --tool bucket

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

from hydrotele.batch.batch import NO_TASK, Batch
from hydrotele.batch.cuda_kernel import make_cuda_kernel
from hydrotele.core.device import import_cuda
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


def compile_kernel(tool: str) -> dict[str, Any]:
    """Return processor times [s], sizes and nvJitLink's report for the cat215 with a tool."""
    cuda = import_cuda()
    nvjitlink, dispatcher = import_module("cuda.bindings.nvjitlink"), import_module("numba.cuda.dispatcher")
    setattr(dispatcher, "get_current_device", lambda: SimpleNamespace(compute_capability=CAPABILITY))  # noqa: B010
    machine = load_machine("cat215", tool)
    batch = Batch(machine, 8, threads=1)
    begin = time.process_time()
    kernel, parameters = make_cuda_kernel(batch._single, batch.model, NO_TASK, machine.terms)
    records = (batch.model, batch.machines, batch._noise, batch._timing, NO_TASK.arrays)
    signature = types.void(*map(device_type, records), types.int64, device_type(parameters))
    ptx, _ = cuda.compile(kernel.py_func, signature, cc=CAPABILITY, output="ptx", abi="numba")
    made = time.process_time()
    linker = nvjitlink.create(2, [f"-arch=sm_{CAPABILITY[0]}{CAPABILITY[1]}", "-verbose"])
    code = ptx.encode()
    nvjitlink.add_data(linker, nvjitlink.InputType.PTX, code, len(code), "batch.ptx")
    nvjitlink.complete(linker)
    linked = time.process_time()
    report = bytearray(nvjitlink.get_info_log_size(linker))
    nvjitlink.get_info_log(linker, report)
    text = report.decode()
    return {
        "ptx_s": round(made - begin, 1), "cubin_s": round(linked - made, 1), "ptx_lines": ptx.count("\n"),
        "cubin_bytes": nvjitlink.get_linked_cubin_size(linker),
        "stack_bytes": max(int(n) for n in re.findall(r"(\d+) bytes stack frame", text)),
        "spill_bytes": max(int(n) for n in re.findall(r"(\d+) bytes spill stores", text)),
    }  # fmt: skip


def main() -> None:
    """Compile and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tool", default="bucket", help="tool of the cat215")
    for name, value in compile_kernel(parser.parse_args().tool).items():
        print(f"{name:12} {value}")


if __name__ == "__main__":
    main()
