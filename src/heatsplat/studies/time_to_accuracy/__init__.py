"""How long recipes take until they are as good as a reference."""

from heatsplat.studies.time_to_accuracy.study import run as run
