"""Hydra looks for sweepers in this namespace."""
