"""Baseline controllers, which use only the observation and the nominal machine."""
