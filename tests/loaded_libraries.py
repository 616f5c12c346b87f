"""What the server of ``commands`` loads first, in the way commands do, which is quicker."""

from heatsplat.training.machine import loading

with loading():
    import heatsplat.runs.run  # noqa: F401
