"""What the server of ``commands`` loads first, in the way commands do, which is quicker; and what a run is composed of."""

from contextlib import ExitStack

from heatsplat.training.machine import loading

with loading():
    import heatsplat.runs.run  # noqa: F401

from quick_compositions import quick_compositions

from heatsplat.composition import compose_unresolved

COMPOSING = ExitStack()  # until a command of another folder ends it, which has configurations of its own
COMPOSING.enter_context(quick_compositions())
compose_unresolved(())
