"""Which frames are held out for testing: pure functions from names or an order to (train, test) positions.

Positions index the frames as they were passed. ``order`` lists positions in time order (name order without times).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from heatsplat.contracts import SceneError, check_option
from heatsplat.datamodules.side_files import found_file, json_object, read_text, shortened

Positions = tuple[list[int], list[int]]

ALL = "all"  # rule that holds nothing out
TRAIN_WORDS = ("train",)
TEST_WORDS = ("test", "eval", "val")


def _complement(count: int, test: Sequence[int]) -> Positions:
    held_out = set(test)
    return [i for i in range(count) if i not in held_out], sorted(held_out)


def every_nth(names: Sequence[str], n: int = 8) -> Positions:
    """Every n-th name in plain string order is test, the first one included (3DGS, Thermal3D-GS)."""
    order = sorted(range(len(names)), key=lambda i: names[i])
    return _complement(len(names), order[::n])


def every_frame(names: Sequence[str]) -> Positions:
    """All frames are training frames; those that ``every_nth`` would hold out are test frames, too."""
    return list(range(len(names))), every_nth(names)[1]


def quarter_centre(order: Sequence[int]) -> Positions:
    """The middle eighth of each quarter of the recording is test (RHD's split, as ETGS's code does it).

    Frames are cut into four parts of n // 4 (the last takes the rest); in a part of m frames the max(1, m // 8) frames
    that begin at (m - count) // 2 are test.
    """
    n = len(order)
    test: list[int] = []
    for part in range(4):
        frames = order[part * (n // 4) : (part + 1) * (n // 4) if part < 3 else n]
        count = min(len(frames), max(1, len(frames) // 8))
        start = (len(frames) - count) // 2
        test += frames[start : start + count]
    return _complement(n, test)


def block(order: Sequence[int], fraction: float = 0.125, position: float = 0.5) -> Positions:
    """One contiguous stretch of the recording is test: the hard case for a model of time.

    Args:
        order: positions in time order.
        fraction: share of the frames to hold out, in (0, 1).
        position: where the stretch lies: 0 at the beginning, 1 at the end (extrapolation), 0.5 in the middle.
    """
    count = min(max(1, round(fraction * len(order))), len(order))
    start = round(position * (len(order) - count))
    return _complement(len(order), order[start : start + count])


def subset_of_words(words: Sequence[str], name: str, rule: str) -> str:
    """The subset that ``words`` speak of, "train" or "test". Raises SceneError naming ``name`` when it is neither."""
    lowered = [word.lower() for word in words]
    is_train = any(key in word for word in lowered for key in TRAIN_WORDS)
    is_test = any(key in word for word in lowered for key in TEST_WORDS)
    if is_train == is_test:
        raise SceneError(
            f"data.split={rule}: {name} says neither 'train' nor 'eval' or 'test' (or both). "
            "Choose another rule, for instance data.split=every_8th."
        )
    return "train" if is_train else "test"


def by_name(names: Sequence[str]) -> Positions:
    """Frames whose file name holds "train" are training frames, "eval" or "test" are test frames (ThermoScenes)."""
    return by_subset([subset_of_words([PurePosixPath(name).stem], name, "names") for name in names])


def by_folder(names: Sequence[str]) -> Positions:
    """Frames in a folder named train are training frames, in test, eval or val test frames (RGBT-Scenes)."""
    return by_subset([subset_of_words(PurePosixPath(name).parts[:-1], name, "folders") for name in names])


def by_subset(subsets: Sequence[str | None]) -> Positions:
    """Positions by what the data set itself says of each frame: "train", "test", or None for a frame left out."""
    return [i for i, s in enumerate(subsets) if s == "train"], [i for i, s in enumerate(subsets) if s == "test"]


def by_list(names: Sequence[str], path: Path) -> Positions:
    """Positions by a file: test names one per line, or JSON {"train": [...], "test": [...]} (no "train": all others).

    Names may be given with or without folders and extension, with those of the scene or others; a frame that has a name as a
    whole goes before others.

    Raises:
        SceneError: the file holds no such lists, or a name of no frame, or one that may be of several.
    """
    lists, meant_by = _lists_in(path), _meanings(names)

    def positions(listed: Sequence[str]) -> list[int]:
        meant = {name: meant_by(name) for name in listed}
        unknown = [name for name, found in meant.items() if not found]
        if unknown:
            raise SceneError(
                f"data.split_file: {path} lists {unknown[0]!r}, which is no frame of the scene "
                f"({len(unknown)} such names; the scene's names look like {names[0]!r})"
            )
        if several := next((name for name, found in meant.items() if len(found) > 1), None):
            raise SceneError(
                f"data.split_file: {path} lists {several!r}, which may be "
                f"{' or '.join(names[i] for i in meant[several])}; write the name with its folder and extension"
            )
        return sorted({found[0] for found in meant.values()})

    test = positions(lists["test"])
    return (positions(lists["train"]), test) if "train" in lists else _complement(len(names), test)


def _lists_in(path: Path) -> Mapping[str, list[str]]:
    """The names under "test", and "train" where the file tells those. Raises SceneError where it holds no such lists."""
    if path.suffix.lower() != ".json":  # Excel may have put names into quotes, and separators behind them
        lines = (line.strip().rstrip(",;\t").strip('"') for line in read_text(path).splitlines())
        return {"test": [line for line in lines if line]}
    lists = json_object(path)
    if "test" not in lists:
        raise SceneError(f'data.split_file: {path} holds no list "test"; it has {", ".join(lists) or "nothing"}')
    for key in {"train", "test"} & set(lists):
        if not isinstance(lists[key], list) or not all(isinstance(name, str) for name in lists[key]):
            raise SceneError(
                f'data.split_file: "{key}" in {path} is {shortened(lists[key])}, a list of names is needed'
            )
    return lists


def _meanings(names: Sequence[str]) -> Callable[[str], list[int]]:
    """A function that gives the positions of all names that may be meant by another."""
    whole = {name: [i] for i, name in enumerate(names)}
    parts: dict[str, list[int]] = {}
    bare: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        path = PurePosixPath(name)
        without = path.with_suffix("").as_posix()
        for key in {without, path.name, path.stem}:
            parts.setdefault(key, []).append(i)
        for key in {name, without}:
            bare.setdefault(key, []).append(i)

    def meant_by(name: str) -> list[int]:
        known = whole.get(name) or parts.get(name)
        return known or next((bare[end] for end in _ends(name) if end in bare), [])

    return meant_by


def _ends(name: str) -> Iterator[str]:
    """A path and what is left of it without folders before, the longest first, each with and without its extension."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    for first in range(len(parts)):
        end = PurePosixPath(*parts[first:])
        yield from (end.as_posix(), end.with_suffix("").as_posix())


@dataclass(frozen=True)
class SplitRule:
    """A split as it stands in a configuration.

    Args:
        rule: every_8th, quarter_centre, block, names, folders, json (what the data set itself lists), list or all.
        fraction, position: of ``block``.
        file: of ``list``, relative to ``folder`` or the working directory.
        folder: of the scene; None where it has none.

    Raises:
        SceneError: the rule is unknown, ``block`` or ``list`` lacks what it needs, or another rule has a file: before any image
            is read.
    """

    rule: str
    fraction: float = 0.125
    position: float = 0.5
    file: str | Path | None = None
    folder: Path | None = None

    RULES = ("every_8th", "quarter_centre", "block", "names", "folders", "json", "list", ALL)

    def __post_init__(self) -> None:
        check_option("data.split", self.rule, self.RULES, SceneError)
        if self.rule == "block" and not (0 < self.fraction < 1 and 0 <= self.position <= 1):
            raise SceneError(
                "data.split=block needs data.split_fraction in (0, 1) and data.split_position in [0, 1], "
                f"got {self.fraction} and {self.position}"
            )
        if self.rule == "list" and self.file is None:
            raise SceneError("data.split=list needs data.split_file: a file with one test name per line")
        if self.rule != "list" and self.file is not None:
            raise SceneError(
                f"data.split_file={self.file} has no effect with data.split={self.rule}: add data.split=list, or leave it out"
            )

    def __call__(self, names: Sequence[str], order: Sequence[int], subsets: Sequence[str | None]) -> Positions:
        """(train, test) positions, which may share frames. Raises SceneError when the rule leaves one of the two empty."""
        rules = {
            "every_8th": lambda: every_nth(names, 8),
            "quarter_centre": lambda: quarter_centre(order),
            "block": lambda: block(order, self.fraction, self.position),
            "names": lambda: by_name(names),
            "folders": lambda: by_subset(subsets) if any(subsets) else by_folder(names),
            "json": lambda: by_subset(subsets),
            "list": lambda: by_list(names, found_file("data.split_file", self.file, self.folder)),
            ALL: lambda: every_frame(names),
        }
        train, test = rules[self.rule]()
        if not train or not test:
            raise SceneError(
                f"data.split={self.rule} leaves {len(train)} training and {len(test)} test frames of {len(names)}; "
                f"choose another of {', '.join(self.RULES)}"
            )
        return train, test
