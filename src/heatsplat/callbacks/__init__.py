"""Callbacks: what measures, draws and reports a run. They know the training module by its public attributes."""
