"""Plug-ins for hydrotele: an effect, two tasks, a pilot and an importer for the test rig."""
