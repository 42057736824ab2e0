"""Baseline controllers, which use only the observation and the parameters of the machine without effects."""
