"""The patched machine as a folder: `machine.yaml` with the effects in it, `effects.yaml`."""

from pathlib import Path

import yaml

from hydrotele.gap.customary import said
from hydrotele.gap.gap_json import effect_document, finite
from hydrotele.gap.result import Gap
from hydrotele.gap.words import effect_title
from hydrotele.machine_file import MACHINE_FILE, save_machine

EFFECTS_FILE = "effects.yaml"


def has_patch(gap: Gap) -> bool:
    """Whether there is something to patch: an effect was named, for certain or as the best."""
    return gap.verdict != "no_gap" and bool(gap.effects)


def write_patch(gap: Gap, folder: Path) -> None:
    """Write the patched machine, which `load_machine(folder)` reads, and what was changed.

    `machine.yaml` is the complete machine; its head says in comments what the effects are.
    `effects.yaml` has their values, units and 95 % intervals, and the values of the given model.

    Args:
        gap: what the search yields.
        folder: an existing folder.
    """
    file = folder / MACHINE_FILE
    save_machine(gap.patched, file)
    head = "".join(f"# {line}\n" for line in _head(gap))
    file.write_text(head + file.read_text(encoding="utf-8"), encoding="utf-8")
    record = {
        "machine": gap.machine.name,
        "tool": gap.machine.tool,
        "verdict": gap.verdict,
        "effects": [],
    }
    for effect in gap.effects:
        document = effect_document(effect)
        for name, estimate in effect.parameters.items():
            document["parameters"][name]["nominal"] = estimate.nominal
        record["effects"].append(document)
    text = yaml.safe_dump(finite(record), sort_keys=False, default_flow_style=None)
    (folder / EFFECTS_FILE).write_text(text, encoding="utf-8")


def _head(gap: Gap) -> list[str]:
    lines = [f"{gap.machine.name} with what `hydrotele gap` found (verdict: {gap.verdict}):"]
    for effect in gap.effects:
        lines.append(f"- {effect_title(effect)}, probability {effect.probability:.3f}")
        for name, estimate in effect.parameters.items():
            s = said(estimate, name)
            lines.append(
                f"    {name}: {s.value} {s.unit} (95 %: {s.low} .. {s.high}), was {s.nominal}"
            )
    return [*lines, f"Values, units and intervals for programs are in {EFFECTS_FILE}."]
