"""Mechanisms with closed loops: joint tree, loop closures, inverse dynamics, regressor."""
