"""Metrics: pure functions that compare two images [H, W, C] in [0, 1] and need no gradient; one file each."""
