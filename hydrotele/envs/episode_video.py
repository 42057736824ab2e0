"""Write an episode of a controller or policy as a video."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from hydrotele.envs.controllers.controller import Controller
from hydrotele.envs.policy_scores import make_environment_id
from hydrotele.show.video import write_frames

_SIZE = (640, 480)  # pixel
_MAX_FRAME_RATE = 25.0  # Hz


def write_episode_video(task: str, options: dict[str, Any], policy: Controller, path: Path, seed: int = 0) -> None:
    """Render one episode in real time.

    Args:
        task: name of a shipped task, or gymnasium id.
        options: options of the environment.
        policy: controller or policy that acts.
        path: MP4 file.
        seed: seed of the episode.

    Raises:
        InputError: imageio-ffmpeg is not installed, OpenGL does not work, or the file cannot be written.
    """
    width, height = _SIZE
    env = gymnasium.make(make_environment_id(task), render_mode="rgb_array", width=width, height=height, **options)
    rate = float(env.metadata["render_fps"])
    steps_per_frame = max(1, round(rate / _MAX_FRAME_RATE))

    def draw_frames() -> Iterator[np.ndarray]:
        observation, _ = env.reset(seed=seed)
        policy.begin(1)
        over, step = False, 0
        while not over:
            if step % steps_per_frame == 0:
                yield np.asarray(env.render())
            action = np.asarray(policy(observation[None]), np.float32)[0]
            observation, _, terminated, truncated, _ = env.step(action)
            over, step = terminated or truncated, step + 1

    try:
        write_frames(path, _SIZE, rate / steps_per_frame, draw_frames())
    finally:
        env.close()
