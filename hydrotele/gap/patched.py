"""The patched machine as a folder: `machine.yaml` with the effects in it, `effects.yaml`."""

from pathlib import Path

import yaml

from hydrotele.gap.customary import in_customary_units
from hydrotele.gap.description import effect_title, learned_title, number_title
from hydrotele.gap.result import Estimate, Gap, effect_document, finite, gap_document
from hydrotele.machine.machine_file import MACHINE_FILE, save_machine

EFFECTS_FILE = "effects.yaml"


def has_patch(gap: Gap) -> bool:
    """Whether anything was changed: effects named, numbers calibrated, laws learned."""
    return bool(gap.effects or gap.calibration or gap.learned)


def write_patch(gap: Gap, folder: Path) -> None:
    """Write the patched machine, which `load_machine(folder)` reads, and what was changed.

    `machine.yaml` is the complete machine; its head says in comments what the effects are.
    `effects.yaml` has their values, units and 95 % intervals, and the values of the given model;
    so it has the calibrated numbers and the learned laws.

    Args:
        gap: what the search yields.
        folder: an existing folder.
    """
    file = folder / MACHINE_FILE
    save_machine(gap.patched, file)
    add_head(gap, file)
    write_effects(gap, folder)


def add_head(gap: Gap, file: Path) -> None:
    """Say in comments at the head of a YAML file what the effects are.

    Args:
        gap: what the search yields.
        file: of the patched model.
    """
    head = "".join(f"# {line}\n" for line in _head(gap))
    file.write_text(head + file.read_text(encoding="utf-8"), encoding="utf-8")


def write_effects(gap: Gap, folder: Path) -> None:
    """Write `effects.yaml`: effects, calibrated numbers and learned laws, with the given values.

    Args:
        gap: what the search yields.
        folder: an existing folder.
    """
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
    document = gap_document(gap)
    record |= {key: document[key] for key in ("calibration", "learned", "jitter")}
    text = yaml.safe_dump(finite(record), sort_keys=False, default_flow_style=None)
    (folder / EFFECTS_FILE).write_text(text, encoding="utf-8")


def _head(gap: Gap) -> list[str]:
    lines = [f"{gap.machine.name} with what `hydrotele gap` found (verdict: {gap.verdict}):"]
    for effect in gap.effects:
        lines.append(f"- {effect_title(effect)}, probability {effect.probability:.3f}")
        for name, estimate in effect.parameters.items():
            lines.append(f"    {name}: {_found(estimate, name)}")
    for key, estimate in gap.calibration.items():
        lines.append(f"- calibrated {number_title(key)}: {_found(estimate, key)}")
    for law in gap.learned:
        lines.append(f"- learned {learned_title(law)} (see terms): {law.formula} [{law.unit}]")
    found, stated = gap.jitter
    if found != stated:
        lines.append(f"- jitter of the sensors: {1e3 * found:.3g} ms, was {1e3 * stated:.3g} ms")
    return [*lines, f"Values, units and intervals for programs are in {EFFECTS_FILE}."]


def _found(estimate: Estimate, name: str) -> str:
    s = in_customary_units(estimate, name)
    return f"{s.value} {s.unit} (95 %: {s.low} .. {s.high}), was {s.nominal}"
