"""Finds where a model and measured logs disagree, names what is missing and patches the model."""
