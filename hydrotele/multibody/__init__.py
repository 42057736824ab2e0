"""Mechanisms with closed loops: tree, closures, inverse dynamics, regressor."""
