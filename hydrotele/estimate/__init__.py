"""Estimation along logs: a Kalman filter of a machine, its noise, and free runs."""
