"""The public names of hydrotele and where they are, for type checkers."""

from .control.endpoint_force import endpoint_force_of_log
from .control.gravity_model import identify_gravity
from .core.compiled import compiled
from .core.errors import InputError
from .effects import EFFECTS, apply_effect, load_effects
from .envs.controllers.catalogue import make_controller
from .envs.episode import draw_uniform, draw_uniform_between
from .envs.observation import ObservationField
from .envs.python_task import PythonTask, TaskState
from .estimate.linear_model import LinearModel, linearise
from .gap.find import find_gap
from .gap.patched import write_patch
from .gap.result import Gap, gap_document
from .identify.identification import identify_dynamics
from .importers.plugin_importers import Importer, make_recording
from .importers.recordings import Recording
from .logs.dataset import Dataset, load_dataset
from .logs.log import Log, load_log, load_logs, save_log
from .machine.machine import Machine
from .machine.machine_file import load_machine, save_machine, shipped_machines
from .run.policy import PilotState, allow_policy
from .run.replay import Replay, replay_log
from .run.run import Run, run_scenario
from .scenario.scenario import Scenario, load_scenario, shipped_scenarios
from .simulate.plant import Plant, build_plant, initial_state, rest_state

__version__: str
__all__ = [
    "Dataset", "EFFECTS", "Gap", "Importer", "InputError", "LinearModel", "Log", "Machine",
    "ObservationField", "PilotState", "Plant", "PythonTask", "Recording", "Replay", "Run",
    "Scenario", "TaskState", "allow_policy", "apply_effect", "build_plant", "compiled",
    "draw_uniform", "draw_uniform_between", "endpoint_force_of_log", "find_gap", "gap_document",
    "identify_dynamics", "identify_gravity", "initial_state", "linearise", "load_dataset",
    "load_effects", "load_log", "load_logs", "load_machine", "load_scenario", "make_controller",
    "make_recording", "replay_log", "rest_state", "run_scenario", "save_log", "save_machine",
    "shipped_machines",
    "shipped_scenarios", "write_patch",
]  # fmt: skip
