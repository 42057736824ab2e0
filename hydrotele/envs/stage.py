"""What a camera sees of a running task: the machine of an episode with its looks, and its goal."""

import copy

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS

from hydrotele.control.resolved_motion import arm_facts
from hydrotele.core.errors import InputError
from hydrotele.envs.goals import goal_markers
from hydrotele.kinematics.task import ALONG, BASE_RADIUS, BOOM, STICK
from hydrotele.show.canvas import Canvas
from hydrotele.show.markers import Marker
from hydrotele.show.pose import model_with_looks
from hydrotele.simulate.fleet import STATE
from hydrotele.tasks.core import TaskCore

_AZIMUTH, _ELEVATION = 232.0, -20.0  # degree: from ahead, aside and above
_KEPT = 16  # compiled machines
FREE = -1

Camera = str | int | None


class Stage:
    """One model with looks that follows the simulations of a task, whichever is asked for.

    Attributes:
        model: with looks; its numbers become those of the machine of the episode that is shown.
        data: its state, complete.
    """

    def __init__(self, core: TaskCore) -> None:
        """Compile the machine of the first variant.

        Args:
            core: the running task.
        """
        self._core = core
        self._compiled: dict[tuple[int, str], mujoco.MjModel] = {}
        self._shown = self._looks(0)
        self.model = copy.copy(self._shown)
        self.data = mujoco.MjData(self.model)
        self._canvas: Canvas | None = None

    def _looks(self, variant: int) -> mujoco.MjModel:
        """Model of a variant, compiled when it is first asked for."""
        variants, task = self._core.setup.variants, self._core.setup.task
        machine, things = variants.machines[variant], variants.surroundings[variant]
        key = id(machine), repr(things)
        if key not in self._compiled:
            model = model_with_looks(machine, task.ground, things)
            assert mujoco.mj_stateSize(model, STATE) == self._core.simulations.state.shape[1]
            self._look_from_afar(model)
            self._compiled[key] = model
            while len(self._compiled) > _KEPT:
                self._compiled.pop(next(iter(self._compiled)))
        return self._compiled[key]

    def _look_from_afar(self, model: mujoco.MjModel) -> None:
        """Let MuJoCo's free camera show all that the arm reaches."""
        machine = self._core.setup.machine
        if machine.arm:
            numbers = arm_facts(machine)[0]
            far = float(numbers[[BASE_RADIUS, BOOM, STICK]].sum() + abs(numbers[ALONG]))
            model.stat.center[:] = 0.40 * far, 0.0, 0.18 * far
            model.stat.extent = far
        model.vis.global_.azimuth, model.vis.global_.elevation = _AZIMUTH, _ELEVATION

    def show(self, number: int = 0) -> None:
        """Bring model and data to where a simulation is.

        Args:
            number: of the simulation.
        """
        variant = int(self._core.memory["variant"][number])
        if (wanted := self._looks(variant)) is not self._shown:
            copy_numbers(wanted, self.model)
            self._shown = wanted
        mujoco.mj_setState(self.model, self.data, self._core.simulations.state[number], STATE)
        mujoco.mj_forward(self.model, self.data)

    def markers(self, number: int = 0) -> list[Marker]:
        """Goal of the episode of a simulation."""
        return goal_markers(self._core, number)

    def camera(self, which: Camera = None) -> mujoco.MjvCamera:
        """Look a camera up.

        Args:
            which: name or number of a camera of the machine; None, -1 or `free` for one that shows
                all that the arm reaches.

        Returns:
            The camera.

        Raises:
            InputError: there is no such camera.
        """
        camera = mujoco.MjvCamera()
        names = [self.model.camera(i).name for i in range(self.model.ncam)]
        if which is None or which == FREE or which == "free":
            mujoco.mjv_defaultFreeCamera(self.model, camera)
            return camera
        if which in names:
            which = names.index(which)
        if not (isinstance(which, (int, np.integer)) and 0 <= which < len(names)):
            raise InputError(f"camera {which!r}", f"choose one of {', '.join((*names, 'free'))}")
        camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, int(which)
        return camera

    def picture(
        self, number: int = 0, width: int = 640, height: int = 480, camera: Camera = None
    ) -> np.ndarray:
        """Draw a simulation; OpenGL stays open for the next one of the same size.

        Args:
            number: of the simulation.
            width: [pixel].
            height: [pixel].
            camera: as of `camera`.

        Returns:
            (height, width, 3) uint8.

        Raises:
            InputError: there is no such camera, the size is not possible, or no OpenGL works.
        """
        view = self.camera(camera)
        if self._canvas is None or self._canvas.size != (width, height):
            self.close()
            self._canvas = Canvas(self.model, width, height)
        self.show(number)
        return self._canvas.draw(self.model, self.data, view, self.markers(number))

    def close(self) -> None:
        """Give OpenGL back."""
        if self._canvas:
            self._canvas.close()
            self._canvas = None


def copy_numbers(source: mujoco.MjModel, target: mujoco.MjModel) -> None:
    """Give a model the numbers of another one of the same structure.

    Args:
        source: whose.
        target: written.
    """
    for name in MODEL_FIELDS:
        if not name.startswith("opt."):
            getattr(target, name)[...] = getattr(source, name)
