"""Every command that a page or a comment of a configuration shows is one that Hydra takes: quotes, keys and options.

What the commands of the README do is tested by running them (test_readme.py); here nothing runs.
"""

import re
import shlex
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException

from heatsplat.composition import compose_unresolved

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMAND = re.compile(r"python src/(\w+)\.py((?:\\\n|[^\n`])*)")
OVERRIDE = re.compile(r"[+~]{0,2}[\w./@]+=")
# Files that docs/extending.md adds.
MADE_ON_A_PAGE = (
    "method=linear_drift",
    "method=3dgs,linear_drift",
    "sensor=camera_gain",
    "density=unseen",
    "loss=charbonnier",
    "renderer=cropped",
    "callbacks=warmest",
    "callbacks=rmse",
    "ablation=linear_drift_parts",
    "thermal=my_drift",
    "data=my_flight",
)


def commands_of(path: Path) -> list[tuple[str, list[str]]]:
    """(script, overrides) of the commands in a file; ``<run>`` and its like are filled, ``...`` is left out."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".yaml":
        text = "\n".join(line.partition("#")[2] for line in text.splitlines())
    found = []
    for script, rest in COMMAND.findall(text):
        overrides = []
        for word in shlex.split(re.sub(r"<[^<>\n]+>", "given", rest.replace("\\\n", " ")), comments=True):
            if OVERRIDE.match(word):
                overrides.append(word)
            elif not word.startswith("-"):  # the sentence goes on, or a pipe begins
                break
        found.append((script, [word for word in overrides if not word.endswith("...")]))
    return found


CASES = {
    f"{path.relative_to(ROOT)}: {script} {' '.join(words)}": (script, words)
    for path in (*PAGES, *sorted((ROOT / "conf").rglob("*.yaml")))
    for script, words in commands_of(path)
}


def test_commands_are_found_on_pages_and_in_configurations():
    assert len(CASES) > 130
    assert {script for script, _ in CASES.values()} >= {
        "train",
        "evaluate",
        "render",
        "export",
        "view",
        "prepare",
        "study",
    }


def test_what_hydra_would_not_read_is_noticed():
    with pytest.raises(Exception, match="no viable alternative"):
        OverridesParser.create().parse_overrides(["study.cases={heated:[method=etgs]}"])


def test_their_overrides_can_be_read():
    wrong, parser = [], OverridesParser.create()
    for name, (_, words) in CASES.items():
        try:
            read = parser.parse_overrides(words)
        except OverrideParseException as error:
            wrong.append(f"{name}: {error}")
        else:
            wrong += [name] * (len(read) != len(words))
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
@pytest.mark.parametrize(("script", "words"), CASES.values(), ids=CASES)
def test_its_keys_and_options_are_those_of_the_configuration(script, words):
    """Of a sweep, the first job."""
    if any(word in words for word in MADE_ON_A_PAGE):
        pytest.skip("the page that shows it adds the file first; tests/project/test_extending.py runs it")
    if "-m" in words or any(re.search(r"=[^\[{'\"]*,", word) for word in words):
        words = [re.sub(r"(=[^\[{,]*),.*", r"\1", word) for word in words if not word.startswith("hydra.")]
    assert compose_unresolved([word for word in words if not word.startswith("launcher=")], script) is not None
