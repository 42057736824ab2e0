"""The reduced models of `tests/multibody/conftest.py`, here too."""

from tests.multibody.conftest import machine_of, move_at_random, reduced_of

__all__ = ["machine_of", "move_at_random", "reduced_of"]
