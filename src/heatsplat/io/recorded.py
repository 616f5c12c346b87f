"""What Hydra wrote down of a run in the run's folder. A damaged file is a ValueError that names it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from heatsplat.io.command_lines import as_dict

OVERRIDES = Path(".hydra") / "overrides.yaml"
CONFIG = Path(".hydra") / "config.yaml"


def overrides_of(place: Path) -> dict[str, str]:
    """What the command line said of the run in a folder: key -> value, as text; empty where nothing was written down."""
    return as_dict(told_of(place))


def told_of(place: Path) -> list[str]:
    """The arguments of the command line themselves, of which a key may have several; the last of them counts."""
    return [*map(str, _read(place / OVERRIDES, list))]


def config_of(place: Path) -> dict[str, Any]:
    """The configuration of the run in a folder, as composed; empty where none was written down."""
    return _read(place / CONFIG, dict)


def _read(path: Path, kind: type) -> Any:
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8")) if path.exists() else None
    except (yaml.YAMLError, ValueError) as error:  # of UTF-8, too
        raise ValueError(f"{path} cannot be read: {' '.join(str(error).split())}") from error
    if found is not None and not isinstance(found, kind):
        raise ValueError(f"{path} holds {type(found).__name__}, not {kind.__name__}")
    return found or kind()
