"""Move the slide of the test rig to a position: once in plain Python, once compiled."""

import numpy as np

import hydrotele as ht

TOLERANCE = 0.005  # m


class MoveSlide(ht.PythonTask):
    """Task in plain Python."""

    description = "The slide of the test rig moves to a position and stays there for a second."
    machine, action, duration = "rig", "valve", 6.0
    observation = (ht.ObservationField("position_error", "m", -1.0, 1.0),)
    measures = (("position_error", "m"),)

    def start(self, machine, rng):
        """Start positions of a variant of the machine."""
        return {"slide": rng.uniform(0.05, 0.45)}

    def reset(self, rng):
        """Goal of a new episode, and the time since which the slide is there."""
        return [rng.uniform(0.05, 0.45), 0.0]

    def observe(self, state):
        """Values in addition to the readings of the machine."""
        return [state.goal[0] - state.position[0]]

    def reward(self, state, action):
        """Return minus the true error [m], and note the time at which the slide was last away from the goal."""
        error = abs(state.goal[0] - state.true_position[0])
        state.measures[0] = error
        if error > TOLERANCE:
            state.goal[1] = state.time
        return -error

    def terminated(self, state):
        """Return whether the slide has been at the goal for a second."""
        return state.time - state.goal[1] > 1.0


@ht.compiled
def draw_goal(rng):
    """Goal of a new episode; `rng` is for draw_uniform and draw_uniform_between."""
    return np.array([ht.draw_uniform_between(rng, 0.05, 0.45), 0.0])


@ht.compiled
def observe(state):
    """As above."""
    return np.array([state.goal[0] - state.position[0]])


@ht.compiled
def compute_reward(state, action):
    """As above."""
    error = abs(state.goal[0] - state.true_position[0])
    state.measures[0] = error
    if error > TOLERANCE:
        state.goal[1] = state.time
    return -error


@ht.compiled
def has_arrived(state):
    """As above."""
    return state.time - state.goal[1] > 1.0


class MoveSlideCompiled(MoveSlide):
    """The same task with compiled functions."""

    reset = staticmethod(draw_goal)
    observe = staticmethod(observe)
    reward = staticmethod(compute_reward)
    terminated = staticmethod(has_arrived)
