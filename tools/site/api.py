"""Page of the Python API: signatures and docstrings of the public names."""

import hydrotele

TOPICS = {
    "Machines": ("load_machine", "save_machine", "shipped_machines", "Machine"),
    "Effects": ("apply_effect", "load_effects", "EFFECTS"),
    "Simulation": ("load_scenario", "shipped_scenarios", "Scenario", "run_scenario", "Run", "replay_log", "Replay"),
    "Models": ("build_plant", "rest_state", "initial_state", "Plant", "linearise", "LinearModel"),
    "Logs": ("load_log", "load_logs", "save_log", "Log", "load_dataset", "Dataset"),
    "Find the gap": ("find_gap", "Gap", "gap_document", "write_patch"),
    "Identify": ("identify_dynamics", "identify_gravity", "endpoint_force_of_log"),
    "Control and learning": (
        "make_controller", "PythonTask", "TaskState", "ObservationField", "draw_uniform", "draw_uniform_between",
        "compiled", "PilotState", "allow_policy",
    ),
    "Importers": ("Importer", "make_recording", "Recording"),
    "Errors": ("InputError",),
}  # fmt: skip
"""Topic -> public names; every name of `hydrotele.__all__` has one."""

EFFECT_NAMES = (
    "Effect", "Parameter", "Term", "DriveState", "law", "term_parameter", "with_terms", "with_value",
)  # fmt: skip


DATA = {"hydrotele.EFFECTS": "Effects of the library by name: `dict[str, hydrotele.effects.Effect]`."}
"""Public name that is neither a class nor a function -> its description."""


def directive(name: str) -> str:
    """Return the autodoc directive of a public name, such as `hydrotele.load_machine`."""
    module, _, attribute = name.rpartition(".")
    value = getattr(__import__(module, fromlist=[attribute]), attribute)
    if name in DATA:
        return f".. py:data:: {name}\n\n   {DATA[name]}"
    kind = "autoclass" if isinstance(value, type) else "autofunction"
    options = "\n   :members:\n   :exclude-members: model_config, renamed" if kind == "autoclass" else ""
    return f".. {kind}:: {name}{options}"


def list_pages() -> dict[str, str]:
    """Return {path of the page: its text}."""
    parts = [
        "# Python API",
        "This page lists the public functions and classes, by topic. Each entry gives arguments with shapes and units,"
        " the result, errors, and an example. Units are SI, angles in radians; `(n, 3)` is the shape of an array.",
        "`import hydrotele` gives all names except those of `hydrotele.effects`. [From Python](../api.md) is a short"
        " overview; [Custom effects](../effects.md) explains the names of `hydrotele.effects`.",
    ]
    groups = {title: [f"hydrotele.{name}" for name in names] for title, names in TOPICS.items()}
    groups["Definition of effects"] = [f"hydrotele.effects.{name}" for name in EFFECT_NAMES]
    for title, names in groups.items():
        body = "\n\n".join(directive(name) for name in names)
        parts.append(f"## {title}\n\n```{{eval-rst}}\n{body}\n```")
    assert {n for names in TOPICS.values() for n in names} == set(hydrotele.__all__)
    return {"python.md": "\n\n".join(parts) + "\n"}
