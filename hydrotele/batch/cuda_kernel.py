"""Batch on a CUDA device: a kernel with the functions of `machine_step`, one thread per machine.

numba-cuda compiles the same Python functions as those of the CPU; `core.device` makes their CUDA forms. The
work space of a machine is in the local memory of its thread. Arrays with one row per machine are stored
column by column, so that neighbouring threads read neighbouring numbers.
"""

import functools
import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hydrotele.batch import machine_step
from hydrotele.batch.machine_step import NO_TASK, Lanes, Machines, Noise, Task, Timing
from hydrotele.batch.mechanism_code import ARRAYS, PROGRAMS, MechanismCode
from hydrotele.core.compiled import cache_folder, source_digest
from hydrotele.core.device import import_cuda, is_simulated, make_device_function
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_file
from hydrotele.core.tracing import make_device_program
from hydrotele.estimate.reduced_model import Model
from hydrotele.terms.law import LAWS
from hydrotele.terms.table import law_index, make_law_functions
from hydrotele.terms.term import Term

THREADS_PER_BLOCK = 64


class Kernels(NamedTuple):
    """CUDA kernels of a batch, with the arguments (Model, Machines, Noise, Timing, arrays of the task, source).

    Attributes:
        step: advances the machines; it has the number of control periods as a seventh argument.
        before: runs the task's function before a control period; None without a task.
        after: runs the task's function after a control period; None without a task.
        source: `MechanismCode.parameters`, the sixth argument.
    """

    step: Any
    before: Any
    after: Any
    source: np.ndarray


def make_cuda_kernels(model: Model, code: MechanismCode, task: Task, terms: Sequence[Term]) -> Kernels:
    """Return the CUDA kernels for machines with the structure of a model.

    Args:
        model: Model of one machine; the sizes of its work space are constants of the kernels.
        code: its traced mechanism.
        task: the task, `machine_step.NO_TASK` for none.
        terms: terms of the machine.
    """
    replaced: dict[Any, Any] = {}
    lanes = machine_step.make_lanes(model, code, 1)
    replaced |= make_law_functions(terms, lambda function: make_device_function(function, replaced))
    for name in PROGRAMS:
        replaced[getattr(machine_step, f"run_{name}")] = make_device_program(getattr(code, name), ARRAYS)
    scope = {"run_block": make_device_function(machine_step.run_block, replaced)}
    parts = [getattr(code, name).digest for name in PROGRAMS]
    parts += [repr([term.law for term in terms]), str([law_index(term.law) for term in terms])]
    laws = [LAWS[term.law].function.__module__ for term in terms]
    call = "run_block(model, lanes, machines, noise, timing, task, periods, i, 1)"
    step = _jit_kernel(_kernel_source(lanes, "periods", call), scope, (), laws, parts)
    if task is NO_TASK:
        return Kernels(step, None, None, code.parameters)
    poses = dict.fromkeys(PROGRAMS, code.pose) | {"move": code.move, "correct": code.correct}
    before = _make_task_kernel(lanes, machine_step.do_before, machine_step.before_period, task.before, {})
    after = _make_task_kernel(lanes, machine_step.do_after, machine_step.after_period, task.after, poses)
    return Kernels(step, before, after, code.parameters)


def _make_task_kernel(lanes: Lanes, caller: Any, stub: Any, function: Any, programs: dict[str, Any]) -> Any:
    """Return the kernel that calls a function of a task by `machine_step.run_task`.

    Args:
        lanes: work space of one machine.
        caller: function of `machine_step` that calls `stub`.
        stub: function that stands for that of the task.
        function: the function of the task.
        programs: programs that place the mechanism; the others are left out.
    """
    replaced: dict[Any, Any] = {}
    for name, program in programs.items():
        replaced[getattr(machine_step, f"run_{name}")] = make_device_program(program, ARRAYS)
    replaced[stub] = make_device_function(function, replaced)
    replaced[machine_step.do_stage] = make_device_function(caller, replaced)
    scope = {"run_task": make_device_function(machine_step.run_task, replaced)}
    source = _kernel_source(lanes, "", "run_task(model, lanes, machines, noise, timing, task, i)")
    return _jit_kernel(source, scope, (function,), (), [program.digest for program in programs.values()])


def _kernel_source(lanes: Lanes, argument: str, call: str) -> str:
    """Return the source of a kernel that allocates the work space of a machine in its thread and makes a call."""
    arrays = {name: value for name, value in lanes._asdict().items() if name not in ("source", "has_closures")}
    body = [line for name, array in arrays.items() for line in _local_array(name, array)]
    names = ", ".join(f"{name}={name}" for name in arrays)
    body += [f"lanes = Lanes({names}, source=source, has_closures={lanes.has_closures})", call]
    head = [f"def kernel(model, machines, noise, timing, task, source{', ' * bool(argument)}{argument}):"]
    head += ["    i = cuda.grid(1)", "    if i < machines.state.shape[0]:"]
    return "\n".join([*head, *(f"        {line}" for line in body), ""])  # local arrays have constant sizes


def make_element_kernel(function: Any) -> Any:
    """Return a CUDA kernel that calls `function(*arguments, k)` for each element k of its last array argument."""
    code = getattr(function, "py_func", function).__code__
    *names, last, _ = code.co_varnames[: code.co_argcount]
    text = f"def kernel({', '.join([*names, last])}):\n    k = cuda.grid(1)\n"
    text += f"    if k < {last}.shape[0]:\n        run_element({', '.join([*names, last])}, k)\n"
    return _jit_kernel(text, {"run_element": make_device_function(function, {})}, (function,))


def _jit_kernel(
    text: str, scope: dict[str, Any], functions: Sequence[Any], modules: Sequence[str] = (), parts: Sequence[str] = ()
) -> Any:
    """Return the CUDA kernel with the name `kernel` of a source text, to be stored in the cache folder if possible.

    Args:
        text: source of the kernel.
        scope: functions that it calls.
        functions: compiled functions that it calls, besides those of this package's batch.
        modules: names of further modules on whose source the code depends.
        parts: further texts that change with the code.
    """
    path = _store_source(text, functions, modules, parts)
    scope = {"cuda": import_cuda(), "Lanes": Lanes, "real": np.float64, **scope}
    exec(compile(text, path or "<kernel of a batch>", "exec"), scope)
    return import_cuda().jit(scope["kernel"], cache=path is not None)


def _store_source(text: str, functions: Sequence[Any], modules: Sequence[str], parts: Sequence[str]) -> str | None:
    """Write the source of a kernel to the cache folder and return its path; numba-cuda stores the code next to it.

    The name of the folder depends on all that the code depends on; the arguments are those of `_jit_kernel`. Returns
    None, for no cache, with laws or tasks of other packages or without a cache folder.
    """
    modules = [__name__, *(f.py_func.__module__ for f in functions), *modules]
    folder = cache_folder()
    if folder is None or any(module.partition(".")[0] != "hydrotele" for module in modules):
        return None
    parts = [text, *map(source_digest, modules), *parts, *(f.py_func.__qualname__ for f in functions)]
    path = folder / f"cuda_{hashlib.sha256(repr(parts).encode()).hexdigest()[:16]}" / "kernel.py"
    try:
        path.parent.mkdir(mode=0o700, exist_ok=True)
        if not path.exists():
            with atomic_file(path, ".py") as part:
                part.write_text(text)
    except OSError:
        return None
    return str(path)


def _local_array(name: str, values: np.ndarray) -> list[str]:
    """Return the source lines that allocate an array with some values in the local memory of a thread."""
    sizes = tuple(max(1, size) for size in values.shape)  # CUDA has no empty arrays
    lines, indices = [f"{name} = cuda.local.array({sizes}, real)"], []
    for depth, size in enumerate(sizes):
        lines.append(f"{'    ' * depth}for i{depth} in range({size}):")
        indices.append(f"i{depth}")
    lines.append(f"{'    ' * len(sizes)}{name}[{', '.join(indices)}] = 0.0")
    return lines + [f"{name}[{', '.join(map(str, k))}] = {values[tuple(k)]}" for k in np.argwhere(values)]


class CudaRunner:
    """Runs the kernel of a batch on the present CUDA device."""

    def __init__(self, model: Model, code: MechanismCode, task: Any, terms: Sequence[Term]) -> None:
        """Make the kernels; they are compiled on their first launch.

        Raises:
            InputError: there is no CUDA device.
        """
        self._cuda = import_cuda()
        if not self._cuda.is_available():
            raise InputError("device cuda", "there is no CUDA device or driver on this computer: use device cpu")
        self._kernels = make_cuda_kernels(model, code, task, terms)
        self._source = self._copy_to_device(self._kernels.source)
        self._element_kernels: dict[Any, Any] = {}

    def run(self, model: Model, machines: Machines, noise: Noise, timing: Timing, arrays: Any, periods: int) -> None:
        """Launch the kernel; the call does not wait for its end."""
        grid = (len(machines.state) + THREADS_PER_BLOCK - 1) // THREADS_PER_BLOCK, THREADS_PER_BLOCK
        kernels, given = self._kernels, (model, machines, noise, timing, arrays, self._source)
        if kernels.before is None:
            kernels.step[grid](*given, periods)
            return
        for _ in range(periods):
            kernels.before[grid](*given)
            kernels.step[grid](*given[:4], NO_TASK.arrays, self._source, 1)
            kernels.after[grid](*given)

    def launch(self, function: Any, *arguments: Any) -> None:
        """Run a function for each element of its last array; the call does not wait for its end."""
        if function not in self._element_kernels:
            self._element_kernels[function] = make_element_kernel(function)
        blocks = (len(arguments[-1]) + THREADS_PER_BLOCK - 1) // THREADS_PER_BLOCK
        self._element_kernels[function][blocks, THREADS_PER_BLOCK](*map(self.upload, arguments))

    def synchronise(self) -> None:
        """Wait until the device has done all launched kernels."""
        self._cuda.synchronize()

    def upload(self, record: Any) -> Any:
        """Return a NamedTuple with its arrays copied to the device, nested ones included."""
        if isinstance(record, tuple):
            return record._make(self.upload(part) for part in record)  # pyright: ignore[reportAttributeAccessIssue]
        return self._copy_to_device(record) if isinstance(record, np.ndarray) else record

    def _copy_to_device(self, array: np.ndarray) -> Any:
        if array.size == 0:
            whole = self._cuda.to_device(np.zeros(tuple(max(1, size) for size in array.shape), array.dtype))
            return whole[tuple(slice(size) for size in array.shape)]
        copy = self._cuda.to_device(np.asfortranarray(array) if len(array) > 1 else array)
        return copy.view(np.recarray) if array.dtype.names and is_simulated() else copy  # for fields as attributes

    def assign(self, array: Any, values: Any) -> None:
        """Copy values of the CPU or of the device into an array of the device."""
        if hasattr(values, "__cuda_array_interface__"):
            _copy_values(self._cuda)[64, 128](array, self._cuda.as_cuda_array(values))
        elif is_simulated():
            array[...] = values
        else:
            whole = np.broadcast_to(np.asarray(values, array.dtype), array.shape)
            array.copy_to_device(np.asfortranarray(whole) if len(whole) > 1 else np.ascontiguousarray(whole))

    def assign_rows(self, array: Any, rows: np.ndarray, values: Any) -> None:
        """Copy values of the CPU into some rows of an array of the device."""
        host = array.copy_to_host()
        host[rows] = values
        array.copy_to_device(np.asfortranarray(host))

    def read(self, array: Any) -> np.ndarray:
        """Return a copy of an array in the memory of the CPU."""
        return array.copy_to_host()

    def repeat(self, values: Any, count: int) -> Any:
        """Return a device array with one row, repeated."""
        return self._copy_to_device(np.repeat(values.copy_to_host()[:1], count, axis=0))


@functools.cache
def _copy_values(cuda: Any) -> Any:
    """Return the kernel that copies a matrix, or one row to all rows, of another layout."""

    @cuda.jit
    def copy_values(target, source):
        size = target.shape[0] * target.shape[1]
        for k in range(cuda.grid(1), size, cuda.gridsize(1)):
            i, j = k % target.shape[0], k // target.shape[0]
            target[i, j] = source[i, j] if source.ndim == 2 else source[j]

    return copy_values
