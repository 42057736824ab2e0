"""Hydraulic laws, the circuit made of them, and a Machine's numbers for it; used on both sides."""
