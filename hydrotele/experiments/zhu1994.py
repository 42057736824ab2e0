"""The machine experiments of Zhu 1994, chapter 6, with simulated operators.

Every row quotes the thesis or says that it is ours. Operators are drawn from the published spread,
one per seed; a claim has to hold for all of them.
"""

from collections.abc import Callable, Sequence
from typing import Any

from hydrotele.experiments import zhu_felling, zhu_forces, zhu_motion
from hydrotele.experiments.finding import Changes, Experiment, Finding, Progress, Sample, performed

EXPERIMENTS: tuple[Experiment, ...] = (
    *zhu_motion.EXPERIMENTS,
    *zhu_forces.EXPERIMENTS,
    *zhu_felling.EXPERIMENTS,
    *zhu_forces.FALSE_FORCE,
)


def zhu1994(seeds: int = 20, jobs: int | None = None, progress: Progress | None = None
            ) -> list[Finding]:  # fmt: skip
    """Run all experiments.

    Args:
        seeds: operators of every experiment; long ones take fewer.
        jobs: processes; as many as there are cores by default.
        progress: called with what is done and the share that is done.

    Returns:
        The findings.
    """
    asked = [(one, {}, one.repetitions(seeds)) for one in EXPERIMENTS]
    measured = _measured(asked, jobs, progress)
    return [
        claim.finding(samples)
        for one, samples in zip(EXPERIMENTS, measured, strict=True)
        for claim in one.claims
    ]


def broken_findings(
    names: Sequence[str] = (), jobs: int | None = None, progress: Progress | None = None
) -> list[Finding]:
    """Judge every claim by a run that is deliberately broken, as the claim says.

    Args:
        names: of the claims; all by default.
        jobs: processes; as many as there are cores by default.
        progress: called with what is done and the share that is done.

    Returns:
        Per claim a finding that should not be ok; `explanation` says how it was broken.
    """
    chosen = [(one, claim) for one in EXPERIMENTS for claim in one.claims
              if not names or claim.name in names]  # fmt: skip
    asked = [(one, claim.broken, 1) for one, claim in chosen]
    findings = []
    for (_, claim), samples in zip(chosen, _measured(asked, jobs, progress), strict=True):
        findings.append(claim.finding(samples)._replace(explanation=claim.broken_how))
    return findings


def _measured(
    asked: Sequence[tuple[Experiment, Changes, int]], jobs: int | None, progress: Progress | None
) -> list[list[Sample]]:
    """Samples of every experiment, each with its changes and number of repetitions."""
    tasks: list[tuple[Callable[..., Any], tuple]] = [
        (one.measure, (seed, dict(changes)))
        for one, changes, count in asked
        for seed in range(1, count + 1)
    ]
    names = [one.name for one, _, count in asked for _ in range(count)]
    results = []
    for number, result in enumerate(performed(tasks, jobs)):
        results.append(result)
        if progress:
            progress(names[number], (number + 1) / len(tasks))
    found, begin = [], 0
    for *_, count in asked:
        found.append(results[begin : begin + count])
        begin += count
    return found
