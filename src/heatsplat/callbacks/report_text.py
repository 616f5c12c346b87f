"""report.md: what a run found, in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any
from urllib.parse import quote

from heatsplat.callbacks.attributes import LEARNED_FILE
from heatsplat.callbacks.courses import COURSES_PICTURE
from heatsplat.callbacks.metrics import TEST_FILE
from heatsplat.callbacks.probes import PROBES_PICTURE
from heatsplat.callbacks.report_words import (
    COST_WORDS,
    DATA_WORDS,
    EFFECT_WORDS,
    RISE_WORDS,
    RUN_WORDS,
    SETTING_WORDS,
    Words,
)
from heatsplat.callbacks.surfaces import SURFACES_FILE, SURFACES_PICTURE
from heatsplat.callbacks.turntable import TURNTABLE_FILE
from heatsplat.contracts import rounded
from heatsplat.io.citations import citations
from heatsplat.io.page import plain
from heatsplat.io.quantities import CLOCKS, Clock, moment, words_and_unit
from heatsplat.io.results import CURVE_FILE, RunResults
from heatsplat.io.tables import NONE, markdown_table, read_csv
from heatsplat.metrics.definitions import Definition, described, unit_of
from heatsplat.viewer.page import FILE as VIEWER_FILE

DEFINITIONS_TITLE = "Definitions of the scores"

DATA_VALUES = {
    "uint8": "8-bit integers",
    "uint16": "16-bit integers",
    "float32": "floating point",
    "L": "one, grey",
    "RGB": "three, colours",
    "every_8th": "every 8th image",
    "all": "every 8th image; all are trained on",
}
TWICE = {
    "train_views": "views",
    "test_views": "views",
    "duration_s": "seconds",
    "twice_gain_db": "twice",
    "twice_steps": "twice",
}  # told by the other name, where that is there
IN_BOTH = "split_in_both"  # in the data, where test images were trained on
PARTS = {"train": "to train", "val": "to validate", "test": "to test"}


def markdown(results: RunResults, folder: Path, pictures: Sequence[Path], curves: Path | None) -> str:
    """The whole report: scores beside cost, the course, pictures by relative path, what was found and learned, data, versions.

    What other callbacks did not leave in the folder is left out.
    """
    content = results.as_json()
    run = content["run"]
    entries = citations(run.get("method"))
    lines = [
        f"# {run.get('method') or run.get('thermal_model')} on {plain(str(run.get('scene')))}",
        *_scores_section(content),
        *_views_section(pictures, folder),
        *_picture_section("Around the scene", folder, TURNTABLE_FILE, "the scene, turning"),
        *_curves_section(curves, folder),
        *_picture_section("Temperature over time", folder, PROBES_PICTURE, "probes"),
        *_picture_section("What all surfaces or images share over time", folder, COURSES_PICTURE, "learned courses"),
        *_surfaces_section(folder),
        *learned_section(folder),
        *("", "## The run", "", *_told_lines(run, RUN_WORDS)),
        *_effects_section(content["effects"]),
        *("", "## Data: findings and assumptions", "", *data_lines(content["data"])),
        *("", f"## {DEFINITIONS_TITLE}", "", *_definition_lines(content["definitions"])),
        *("", "## Versions", "", *_bullets(content["versions"])),
        *(("", "## How to cite", "", *(f"- {entry}" for entry in entries)) if entries else ()),
    ]
    return "\n".join([*lines, ""])


def _scores_section(content: Mapping[str, Any]) -> list[str]:
    """Scores beside cost, and why some are not there."""
    told = (
        [(_labelled(words, name), value) for name, words, value in cells(content, part)] for part in ("test", "cost")
    )
    pairs = zip_longest(*told, fillvalue=("", ""))
    table = markdown_table(("score", "value", "", "cost", "value"), [(*score, "", *cost) for score, cost in pairs])
    lines = ["", "## Scores and cost", "", *table, "", f"What each score is stands below, under {DEFINITIONS_TITLE}."]
    missing: dict[str, list[str]] = {}
    for name in (f"{part}.{score}" for part in ("test", "cost") for score in content[part]):
        if name in content["reasons"]:
            missing.setdefault(content["reasons"][name], []).append(f"`{name}`")
    if missing:
        lines += ["", "Not available:", "", *(f"- {', '.join(names)}: {reason}" for reason, names in missing.items())]
    if content["data"].get(IN_BOTH):
        lines += ["", f"**{content['data'][IN_BOTH]}.**"]
    return lines


def _views_section(pictures: Sequence[Path], folder: Path) -> list[str]:
    """The scene in a browser, and test views."""
    lines = []
    if (folder / VIEWER_FILE).exists():
        lines += ["", f"Interactive 3D view with temperatures: [{VIEWER_FILE}]({VIEWER_FILE})."]
    if pictures:
        lines += ["", "## Test views", ""]
        for path in pictures:
            lines += [_picture(path, folder), ""]
        if (folder / TEST_FILE).exists():
            lines.append(f"Scores of each test image: [{TEST_FILE}]({TEST_FILE}).")
    return lines


def _curves_section(curves: Path | None, folder: Path) -> list[str]:
    """Scores over seconds of training."""
    if curves is None:
        return []
    picture = f"![scores]({curves.relative_to(folder).as_posix()})"
    return ["", "## Quality over training time", "", picture, "", f"Values: [{CURVE_FILE}]({CURVE_FILE})."]


def _picture(path: Path, folder: Path, alternative: str | None = None) -> str:
    """A picture in Markdown, whatever its file is called: images may be named as a camera or a person liked."""
    words = plain(path.stem) if alternative is None else alternative
    return f"![{words}]({quote(path.relative_to(folder).as_posix())})"


def _picture_section(title: str, folder: Path, name: str, alternative: str) -> list[str]:
    return ["", f"## {title}", "", f"![{alternative}]({name})"] if (folder / name).exists() else []


def _surfaces_section(folder: Path) -> list[str]:
    """Hottest and coldest surfaces (``callbacks.surfaces``)."""
    if not (folder / SURFACES_FILE).exists():
        return []
    found = read_csv(folder / SURFACES_FILE)
    rows = [
        (
            f"{row['kind'][0].upper()}{row['number']:.0f}",
            f"{row['mean_c']:.1f} °C",
            f"{row['most_c']:.1f} °C",
            f"{row['area']:g} {row['unit']}",
            ", ".join(f"{row[axis]:.2f}" for axis in "xyz"),
            *([f"{row['latitude_deg']:.6f}, {row['longitude_deg']:.6f}"] if "latitude_deg" in row else []),
        )
        for row in found
    ]
    time_s = found[0]["time_s"]
    when = "" if time_s is None else f", {moment(time_s)} after the first training frame"
    note = (
        f"Connected surfaces seen by training views, as rendered by the model{when}: H the hottest, C the coldest. "
        "Centres are in the coordinates of the data set. What has no texture and is seen at a flat angle, such as bare ground, "
        f"may lie less deep than it is shown. Table: [{SURFACES_FILE}]({SURFACES_FILE})."
    )
    titles = ("", "mean", "hottest, coldest 2 %", "area", "centre x, y, z", "latitude, longitude")[: len(rows[0])]
    table = markdown_table(titles, rows, "lrrrrr"[: len(titles)])
    picture = [f"![numbered surfaces]({SURFACES_PICTURE})", ""] if (folder / SURFACES_PICTURE).exists() else []
    return ["", "## Hottest and coldest surfaces", "", *picture, *table, "", note]


def learned_section(folder: Path) -> list[str]:
    """What the Gaussians have beside their temperature (``callbacks.attributes``)."""
    found = read_csv(folder / LEARNED_FILE) if (folder / LEARNED_FILE).exists() else []
    if not found:
        return []
    known = any(row["deviation"] for row in found)
    remarked = any(row.get("remark") for row in found)
    true = any(row.get("truth") is not None for row in found)
    rows = []
    for row in found:
        truth = row.get("truth")
        told = [row["name"], _number(row["median"]), *[NONE if truth is None else _number(truth)] * true]
        told.append(f"{_number(row['low'])} to {_number(row['high'])}")
        told += [f"± {_number(row['deviation'])}" if row["deviation"] else NONE] * known
        rows.append((*told, row["unit"] or "", *[row.get("remark") or ""] * remarked))
    note = (
        "The interval contains 90 % of what training views show of the Gaussians. It tells how the scene varies, not the "
        "uncertainty of a "
        + ("value, which is the median standard deviation of one Gaussian. " if known else
           "value, which `evaluate.py callbacks=uncertainty` estimates. ")
        + ("The truth is the median of what the scene has there. " if true else "")
        + f"Table: [{LEARNED_FILE}]({LEARNED_FILE})."
    )  # fmt: skip
    pictures = sorted((folder / "renders" / "attributes" / "test").glob("*.png"))[:1]
    maps = [_picture(path, folder, "maps of learned quantities") for path in pictures]
    heads = ("", "median", *["truth"] * true, "90 % interval", *["standard deviation"] * known, "unit")
    table = markdown_table((*heads, *["remark"] * remarked), rows, "lrr" + "r" * (true + known) + "l" + "l" * remarked)
    return ["", "## Learned quantities", "", *table, "", note, "", *maps]


EFFECTS_NOTE = (
    "An effect is simulated if its statistic exceeds the threshold: then the fit of all effects selects it. Where the "
    "reason says that it cannot be told, held-out observations do not bear that out, or something else would explain them "
    "as well. There is no number if the effect was set by hand or the data are not sufficient. dB: gain on held-out "
    "observations. An effect that is off is absent: no parameter, no operation. Parameters: of the Gaussians at the end. ms "
    "per step: difference of whole training steps on the initial Gaussians with all effects and without this one (and those "
    "that depend on it), alternating, fastest of each; a few hundredths are noise."
)


def _effects_section(effects: Mapping[str, Any]) -> list[str]:
    """A table where a scene chose the effects, a list where the method did."""
    if not any("reason" in effect for effect in effects.values()):
        simulated = {
            name: {key: value for key, value in effect.items() if key != "on"} for name, effect in effects.items()
        }
        return ["", "## Simulated effects", "", *(_settings_lines(simulated) or ["None."])]
    settings = {name: effect["settings"] for name, effect in effects.items() if effect.get("settings")}
    return ["", "## Effects", "", *effects_table(effects), "", EFFECTS_NOTE, "", *_settings_lines(settings)]


def effects_table(effects: Mapping[str, Any]) -> list[str]:
    """Lines of a Markdown table of ``describe_effects``: what is simulated, why, and what it costs.

    First comes what is simulated, then what cannot be told, then what the scene does not show. Effects that were left out for one
    reason and without a number stand below the table, in a line for each reason.
    """
    unasked: dict[str, list[str]] = {}
    for name, effect in effects.items():
        if not effect["on"] and effect["told"] and effect["statistic"] is None:
            unasked.setdefault(effect["reason"], []).append(name)
    together = {reason: names for reason, names in unasked.items() if len(names) > 1}
    asked = {name: effect for name, effect in effects.items() if name not in chain(*together.values())}
    rows = [_effects_row(name, asked[name]) for name in sorted(asked, key=lambda name: _place(asked[name]))]
    head = ("effect", "simulated", "statistic", "threshold", "dB", "dB per ms", "reason", "parameters", "ms per step")
    table = markdown_table(head, rows, align="llrrrrlrr") if rows else []
    below = [f"- {', '.join(map(_effect, names))}: no; {reason}" for reason, names in together.items()]
    return [*table, *([""] if rows and below else []), *below]


def _place(effect: Mapping[str, Any]) -> tuple[bool, bool]:
    """In the table of effects: effects of the same place keep their order."""
    return not effect["on"], effect["told"] != effect["on"]


def _effects_row(name: str, effect: Mapping[str, Any]) -> tuple[str, ...]:
    statistic, threshold, parameters, milliseconds = (
        NONE if effect[key] is None else f"{effect[key]:,}" if key == "parameters" else rounded(effect[key], 3)
        for key in ("statistic", "threshold", "parameters", "ms_per_step")
    )
    sure = "**yes**" if effect["on"] else "no"
    on = sure if effect["told"] else "yes, but cannot be told" if effect["on"] else "cannot be told"
    gain, cost = effect["gain_db"], effect["ms_per_step"]
    gains = (NONE if gain is None else f"{gain:.1f}", f"{gain / cost:.2g}" if gain and cost and cost > 0 else NONE)
    return _effect(name), on, statistic, threshold, *gains, effect["reason"], parameters, milliseconds


def cells(content: Mapping[str, Any], section: str) -> list[tuple[str, str, str]]:
    """Names of "test" or "cost", these in words, and values with their units, for a table; a dash for what could not be had."""
    cells = []
    for name, value in content[section].items():
        quantity = described(name)
        told = unit_of(content.get("definitions", {}).get(name)) or words_and_unit(name)[1]
        unit = quantity.unit if quantity is not None else told
        words, unit = COST_WORDS.get(name, (_score(name), unit))
        cells.append((name, words, NONE if value is None else f"{_number(value)} {unit}".rstrip()))
    return cells


def _score(name: str) -> str:
    """A score's title, or the words of its name where it is a callback's own."""
    score = described(name)
    return score.title if isinstance(score, Definition) else words_and_unit(name)[0]


def _definition_lines(definitions: Mapping[str, Any]) -> list[str]:
    """A list for Markdown of what metrics.json says of scores, each by its title and its name."""
    return _told_lines(definitions, {name: (_score(name), words_and_unit(name)[1]) for name in definitions})


def _number(value: float) -> str:
    """Four significant digits, and whole numbers as they are."""
    if float(value).is_integer() or abs(value) >= 1e4:
        return f"{value:,.0f}"
    return f"{value:.4g}"


def data_lines(data: Mapping[str, Any]) -> list[str]:
    """A list for Markdown of what metrics.json tells of the data, in words and with units."""
    shown = (_in_words(name, value, DATA_WORDS) for name, value in data.items() if TWICE.get(name) not in data)
    return [f"- {words}: {told}" for words, told in shown]


def _told_lines(values: Mapping[str, Any], known: Words) -> list[str]:
    """A list for Markdown of names and values in words, each with its name in metrics.json where that is another."""
    told = ((name, *_in_words(name, value, known)) for name, value in values.items())
    return [f"- {_labelled(words, name)}: {value}" for name, words, value in told]


def _settings_lines(effects: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A list for Markdown of effects and their settings, in words."""
    told = ((name, _in_words(name, settings, SETTING_WORDS)[1]) for name, settings in effects.items())
    return [f"- {_effect(name)}: {settings}" for name, settings in told]


def _effect(name: str) -> str:
    return _labelled(EFFECT_WORDS.get(name, name.replace("_", " ")), name)


def _labelled(words: str, name: str) -> str:
    """Words with the name that they stand for, by which it can be found or set."""
    return words if words == name else f"{words} (`{name}`)"


def _in_words(name: str, value: Any, known: Words) -> tuple[str, str]:
    """A name and its value for people, with its unit where it is a number; one level of nesting in line.

    Args:
        name: in metrics.json.
        value: as it stands there.
        known: what names are in words.
    """
    words, unit = known.get(name) or words_and_unit(name)
    if name in RISE_WORDS and isinstance(value, float) and value < 0:
        words, value = RISE_WORDS[name], -value
    if name == "views" and isinstance(value, Mapping):
        return words, ", ".join(f"{_words(count)} {PARTS.get(part, part)}" for part, count in value.items())
    if isinstance(value, Mapping):
        told = (item for item in value.items() if TWICE.get(item[0]) not in value and item[1] not in ("", []))
        return words, ", ".join(" ".join(_in_words(*item, known)) for item in told) or "on"
    return words, _with_unit(name, value, unit)


def _with_unit(name: str, value: Any, unit: str) -> str:
    """A value, or a list of them, for people; ``name`` tells moments and lengths of time."""
    values = value if isinstance(value, list | tuple) else [value]
    numbers = all(isinstance(one, int | float) and not isinstance(one, bool) for one in values)
    if numbers and name in CLOCKS:
        return Clock(value, CLOCKS[name]).at(0.0, "seconds")
    if numbers and name == "seconds":
        return moment(value)
    if numbers and unit == "%":
        return f"{100 * value:.3g} %"
    told = (" to " if unit and numbers and len(values) == 2 else ", ").join(map(_words, values))
    told = DATA_VALUES.get(told, told)
    sized = unit == "pixels" and value is not None  # sizes are text, such as 40x32
    return f"{told} {unit}".rstrip() if numbers or sized else told


def _bullets(values: Mapping[str, Any]) -> list[str]:
    """A list of names and values for Markdown, one level of nesting in line."""
    lines = []
    for name, value in values.items():
        nested = isinstance(value, Mapping)
        words = ", ".join(f"{key} {_words(item)}" for key, item in value.items()) or "on" if nested else _words(value)
        lines.append(f"- {name}: {words}")
    return lines


def _words(value: Any) -> str:
    """A value for people, in Markdown: lists with commas, floats with six digits, a dash for nothing."""
    if isinstance(value, (list, tuple)):
        return ", ".join(_words(item) for item in value)
    if isinstance(value, float):
        return f"{value:.6g}"
    return NONE if value is None else plain(str(value))
