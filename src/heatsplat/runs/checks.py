"""What a run's configuration is refused for before anything is read, measured or built."""

from __future__ import annotations

from typing import Any

from heatsplat.composition import keys_of
from heatsplat.contracts import SceneError
from heatsplat.effects import assembly
from heatsplat.runs.budget import seconds_of


def checked(config: dict[str, Any]) -> dict[str, Any]:
    """The configuration with ``budget`` in seconds.

    Raises:
        SceneError: settings contradict each other or lie out of range.
    """
    if config["budget"] is not None:
        config = config | {"budget": seconds_of(config["budget"])}
        if "max_steps" in keys_of(config["overrides"]):
            raise SceneError("budget chooses the number of steps, and max_steps gives it: leave out one of them")
    if assembly.chooses(config):
        replaced = ("thermal.", "thermal=", "sensor.", "sensor=")
        idle = [text for text in config["overrides"] if text.lstrip("+~").startswith(replaced)]
        if idle:
            raise SceneError(
                f"{idle[0]} would be replaced: effects={config['effects']['select']} puts thermal model and sensor together. "
                "Set its parts by effects.states.*, effects.parts.* and effects.sensor.*, or choose a method that has its own."
            )
    return config
