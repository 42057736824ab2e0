"""Runs of scenarios: with one clock, live, or as a replay of a log."""
