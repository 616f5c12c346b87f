"""The data sets of the papers: where they come from, how they lie on disk, and which scenes are there."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from heatsplat.contracts import SceneError
from heatsplat.studies.published.figures import AVERAGE, read_yaml


@dataclass(frozen=True)
class Source:
    """A data set.

    Args:
        key: of it in sources.yaml.
        name: with the paper that it is of.
        url: where it is got.
        layout: lines that say what a scene's folder holds.
        any: paths in a scene's folder; one of them is there.
        scenes: key in the tables -> other names of the scene's folder.
        groups: printed means -> the scenes that they are of.
        unsure: what is inferred or missing, a sentence; empty for nothing.
    """

    key: str
    name: str
    url: str
    layout: tuple[str, ...]
    any: tuple[str, ...]
    scenes: Mapping[str, tuple[str, ...]]
    groups: Mapping[str, tuple[str, ...]]
    unsure: str = ""

    def members(self, scene: str) -> tuple[str, ...]:
        """The scenes of which a printed figure is: one, those of a group, or all; () for a name of no such scene."""
        if scene == AVERAGE:
            return tuple(self.scenes)
        return self.groups.get(scene, (scene,) if scene in self.scenes else ())

    def find(self, root: Path | None, told: Mapping[str, str] | None = None) -> dict[str, str]:
        """Scenes on disk: key -> name of its folder below ``root``.

        Args:
            root: folder of the data set, or None.
            told: key -> folder, for folders that are called otherwise.

        Raises:
            SceneError: ``told`` is of no scene.
        """
        names = self._names(told)
        if root is None or not root.is_dir():
            return {}
        folders = sorted(
            path for path in root.iterdir() if path.is_dir() and any((path / p).exists() for p in self.any)
        )
        by_name = {_plain(path.name): path.name for path in folders}
        found = {key: next((by_name[name] for name in of if name in by_name), None) for key, of in names.items()}
        whole = {path.name for path in folders}
        found |= {key: str(name) for key, name in (told or {}).items() if str(name) in whole}  # before any likeness
        return {key: folder for key, folder in found.items() if folder}

    def scene_of(self, folder: str, told: Mapping[str, str] | None = None) -> str | None:
        """Key of the scene whose folder has this name, whether it is on disk or not; None for none."""
        return next((key for key, names in self._names(told).items() if _plain(folder) in names), None)

    def _names(self, told: Mapping[str, str] | None) -> dict[str, list[str]]:
        """Key of each scene -> what its folder may be called, without case and punctuation."""
        told = {} if told is None else told
        if not isinstance(told, Mapping):
            one = next(iter(self.scenes))
            raise SceneError(f"table.folders={told}: give folders by scene, such as 'table.folders={{{one}: NAME}}'")
        if unknown := [str(key) for key in told if key not in self.scenes]:
            raise SceneError(
                f"table.folders: {', '.join(unknown)} is no scene of {self.name}; there are {', '.join(self.scenes)}"
            )
        # In a data set with numbered copies the told name wins over any likeness.
        names = {key: [told[key]] if key in told else [key, *others] for key, others in self.scenes.items()}
        return {key: [_plain(str(name)) for name in of] for key, of in names.items()}


def source(key: str) -> Source:
    """A data set by its key in sources.yaml.

    Raises:
        SceneError: no such data set.
    """
    entries = read_yaml("sources")
    if key not in entries:
        raise SceneError(f"table.source={key}: there are {', '.join(entries)}")
    entry = dict(entries[key])
    return Source(
        key,
        entry["name"],
        entry["url"],
        tuple(entry["layout"]),
        tuple(entry["any"]),
        {name: tuple(others) for name, others in entry["scenes"].items()},
        {name: tuple(scenes) for name, scenes in entry.get("groups", {}).items()},
        entry.get("unsure", ""),
    )


def _plain(name: str) -> str:
    """A folder's name without case, punctuation and accents, in any script."""
    return "".join(letter for letter in unicodedata.normalize("NFKD", name.casefold()) if letter.isalnum())
