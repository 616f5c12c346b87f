"""Hydra looks for launchers in this namespace."""
