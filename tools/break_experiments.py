"""Every criterion of `hydrotele experiments zhu1994` on a run that is deliberately broken.

    python tools/break_experiments.py [--jobs 2] [--only "NAME,NAME"]
        [--out docs/results/zhu1994_broken.md]

A criterion that still says yes cannot fail in the way that it should: exit status 1.
"""

import sys

from hydrotele.experiments.zhu1994 import broken_findings, zhu1994
from tools.study import options, publish


def _word(ok: bool) -> str:
    return "yes" if ok else "no"


def main() -> None:
    asked = options(__doc__, jobs=2, only="")
    names = [name.strip() for name in asked.only.split(",") if name.strip()]

    def said(name: str, share: float) -> None:
        print(f"{100 * share:3.0f} % {name}", file=sys.stderr, flush=True)

    found = broken_findings(names, asked.jobs, said)
    whole = {one.name: _word(one.ok) for one in zhu1994(1, asked.jobs, said)} if not names else {}
    lines = [
        "| criterion | how it was broken | measured | says | unbroken, one operator |",
        "| --- | --- | --- | --- | --- |",
    ]
    for one in found:
        cells = (one.name, one.explanation, one.simulated, _word(one.ok), whole.get(one.name, ""))
        lines.append(f"| {' | '.join(cells)} |")
    fails = sum(not one.ok for one in found)
    lines.append("")
    lines.append(f"{fails} of {len(found)} criteria say no on their broken run.\n")
    delattr(asked, "only")
    publish("\n".join(lines), "Criteria of zhu1994 on broken runs", asked)
    sys.exit(fails < len(found))


if __name__ == "__main__":
    main()
