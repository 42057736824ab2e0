"""Finds where a model and measured logs disagree, names the missing effect and patches the model."""
