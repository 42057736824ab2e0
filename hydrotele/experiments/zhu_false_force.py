"""Zhu 1994, 6.3.3: force that a model reads from the pressures of a machine that touches nothing."""

EXPERIMENTS = ()
