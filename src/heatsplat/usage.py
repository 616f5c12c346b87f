"""What a command says of itself: its settings, as its files of configuration explain them, and what there is to choose."""

from __future__ import annotations

import itertools
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path

from heatsplat.composition import CONF
from heatsplat.io.command_lines import config_dirs

# Groups of which the settings are explained for these options, "*" for all.
EXPLAINED = {
    "prepare": {"poses": "thermal", "correct": "scene"},
    "simplify": {"merge": "flat"},
    "export": {"what": "*"},
}
# Groups whose options are told in a sentence each; of a command's other groups their names.
TOLD = {"train": ("method", "data", "preset"), "study": ("study",)}
ELSEWHERE = {group for groups in TOLD.values() for group in groups}
WIDTH = 130


def usage(command: str, doc: str, arguments: Sequence[str] = ()) -> str:
    """The text of --help.

    Args:
        command: such as "train", the name of its file in the folder of configurations.
        doc: of its job, whose first line comes first.
        arguments: of the command line, of which --config-dir is a further folder of configurations, and study=NAME the study
            whose settings are asked for.
    """
    places = [Path(CONF), *config_dirs(arguments)[0]]
    text = (places[0] / f"{command}.yaml").read_text(encoding="utf-8")
    own, *_ = re.split(r"^(?:hydra:|\w+: +# internal)", text, maxsplit=1, flags=re.MULTILINE)
    lines = [doc.partition("\n")[0], "", *_explained(own)]
    asked = {group: option for group, _, option in (text.partition("=") for text in arguments) if group == command}
    for group, pattern in (EXPLAINED.get(command, {}) | asked).items():  # of a study that is named, its own
        for option, file in _options(places, group, pattern).items():
            inner = _explained(file.read_text(encoding="utf-8"))
            lines += ["", f"{group}:  # with {group}={option}", *(f"  {line}" for line in inner)]
    for group in TOLD.get(command, ()):
        options = _options(places, group)
        wide = max(map(len, options))
        told = (f"  {option:{wide}}  {_sentence(file)}".rstrip() for option, file in options.items())
        hint = f"  # {group}=NAME --help explains the settings of one" if group == command else ""
        lines += ["", f"{group}:{hint}", *told]
    groups = re.findall(r"^  - (\w+):", own, re.MULTILINE) if command in TOLD else []
    choices = {group: _options(places, group) for group in groups if group not in ELSEWHERE}
    if any(choices.values()):
        lines += ["", "Choices of the other groups:"]
    for group, options in choices.items():
        if options:
            lines += textwrap.wrap(f"  {group}: {', '.join(options)}", WIDTH, subsequent_indent="    ")
    lines += [
        "",
        "With --cfg job, a command lists all its settings with the values that they would have, and runs nothing.",
    ]
    return re.sub("\n{3,}", "\n\n", "\n".join(lines))


def _options(places: Sequence[Path], group: str, pattern: str = "*") -> dict[str, Path]:
    """Files of the options of a group, by name."""
    files = (file for place in places for file in (place / group).glob(f"{pattern}.yaml"))
    return dict(sorted({file.stem: file for file in files}.items()))


def _explained(text: str) -> list[str]:
    """The lines of a file of configuration that say something to a user: choices of groups stand as they are set."""
    internal = ("defaults:", "_target_", "by:", "- _self_", "- override", "- optional", "- /", "# @package")
    every = text.strip().splitlines()
    told = [not line.strip().startswith(internal) and (": ${" not in line or "#" in line) for line in every]
    for i, line in enumerate(every):  # what holds internal lines alone is internal, too
        end = next((j for j in range(i + 1, len(every)) if _depth(every[j]) <= _depth(line)), len(every))
        if end > i + 1 and re.match(r"\s*\w+:\s*(#.*)?$", line) and not any(told[i + 1 : end]):
            told[i] = False
    return [re.sub(r"^  - (?=\w+: )", "", line) for line in itertools.compress(every, told)]


def _depth(line: str) -> int:
    """How far a line is indented."""
    return len(line) - len(line.lstrip())


def _sentence(file: Path) -> str:
    """The first sentence of the comments at the head of a file of configuration, without its command."""
    lines = file.read_text(encoding="utf-8").splitlines()
    said = (line.removeprefix("# ") for line in itertools.takewhile(lambda line: line.startswith("#"), lines))
    text = " ".join(line for line in said if not line.startswith(("@package", "python src/")))
    return re.split(r"(?<=[\w)}])\. (?=[A-Z])|:? python src/", text)[0].rstrip(" .:")
