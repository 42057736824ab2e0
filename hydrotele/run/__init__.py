"""Simulated runs of scenarios, interactive driving, replays of logs, and parameter sweeps."""
