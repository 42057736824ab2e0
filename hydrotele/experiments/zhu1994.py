"""The machine experiments of Zhu 1994, chapter 6, with a simulated operator."""

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from hydrotele.experiments import felling, forces, motion
from hydrotele.experiments.finding import Finding

Progress = Callable[[str, float], None]


def zhu1994(seeds: int = 20, jobs: int | None = None, progress: Progress | None = None
            ) -> list[Finding]:  # fmt: skip
    """Run all experiments.

    Args:
        seeds: operators that track a force, with and without reflection.
        jobs: processes; as many as there are cores by default.
        progress: called with what is done and the share that is done.

    Returns:
        The findings, in the order of the thesis.
    """
    tasks: list[tuple[Callable[..., Any], tuple]] = [
        *((motion.line, (way,)) for way in ("up", "down", "out", "in")),
        (forces.hold_by_feel, ()),
        (forces.direct_force, ()),
        (motion.rate_against_position, ()),
        (felling.tree, ()),
        (motion.feller_steps, ()),
        (felling.tip_over, ()),
    ]
    single = len(tasks)
    for reflection in ("stiffness", "none"):
        tasks += [(forces.tracking_error, (reflection, seed)) for seed in range(1, seeds + 1)]
    results: list[Any] = []
    for number, result in enumerate(_performed(tasks, jobs)):
        results.append(result)
        if progress:
            progress(_said(tasks[number]), (number + 1) / len(tasks))
    findings: list[Finding] = []
    for result in results[:single]:
        findings += [result] if isinstance(result, Finding) else list(result)
    tracked = results[single:]
    findings.insert(7, forces.tracking(tracked[:seeds], tracked[seeds:]))
    return findings


def _said(task) -> str:
    function, arguments = task
    return " ".join([function.__name__.replace("_", " "), *map(str, arguments)])


def _performed(tasks, jobs: int | None):
    """Results in order, from processes of their own if there are several."""
    count = jobs or os.cpu_count() or 1
    if count == 1:
        for function, arguments in tasks:
            yield function(*arguments)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, mp_context=context) as pool:
        waiting = [pool.submit(function, *arguments) for function, arguments in tasks]
        for future in waiting:
            yield future.result()
