"""Which runs fill a published table: methods x settings x scenes that are on disk, and what is missing for the others."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneError
from heatsplat.io.command_lines import key_of
from heatsplat.metrics.lpips import LpipsUnavailable, find_backbone
from heatsplat.studies.options import listed
from heatsplat.studies.published.figures import METRICS, TITLES, Figure, doubts, figures
from heatsplat.studies.published.sources import Source, source

NOT_HERE = "heatsplat does not have it"
NOT_ASKED = "not asked for"
OF_ALL = {"data.root", "data.downscale", "data.seed"}  # keys of data=scenes; the others are those of its scenes


@dataclass(frozen=True)
class Run:
    """One training run of a table.

    Args:
        method, setting: of the table's row.
        scene: key of the scene in the table.
        folder: name of the scene's folder on disk; of a run on several scenes those of all, with "+" between.
        overrides: of the configuration.
        after: the run on other scenes that must be finished before this one starts from it; None for most.
    """

    method: str
    setting: str
    scene: str
    folder: str
    overrides: tuple[str, ...]
    after: Run | None = None

    @property
    def row(self) -> str:
        """Name of the row, which is also part of the run's folder."""
        return row_name(self.method, self.setting)

    def job(self, given: Sequence[str]) -> list[str]:
        """All overrides of the run, those of the command line first."""
        return [*given, *self.overrides, f"row='{self.row}'"]


@dataclass(frozen=True)
class OnOthers(Run):
    """The run on all scenes of a data set but one, joined (``data=scenes``), that a run on the one comes after."""

    @property
    def row(self) -> str:
        return f"{row_name(self.method, self.setting)}_others"

    def job(self, given: Sequence[str]) -> list[str]:
        """As of any run; what the command line says of the data set goes to its scenes (``data.each``)."""
        keys = [key_of(text) for text in given]
        own = [key.startswith("data.") and not key.startswith("data.each.") and key not in OF_ALL for key in keys]
        moved = [text.replace("data.", "data.each.", 1) if to else text for text, to in zip(given, own, strict=True)]
        return super().job(moved)


@dataclass(frozen=True)
class Reproduction:
    """A table and the runs that fill it.

    Args:
        paper, table: which; keys as in ``figures``.
        source: its data set, None for tables of facts.
        root: folder of the data set as it was given, or None.
        figures: what is printed.
        rows: (method, setting) in order; those that were asked for beyond the paper come last.
        runs: what is to be trained, scene by scene within a row.
        absent: (method, setting) -> why it has the paper's figures only.
        missing: scenes that are wanted and not on disk.
        waiting: what is not run although its scene is there, a sentence each.
        metrics: printed metric -> score in metrics.json, where the paper's definition is another than usual.
        unnamed: the group of scenes that stands for "the paper does not say which"; empty for none.
        notes: what else a reader must know.
        folders: key of a scene -> name of its folder, where it is called otherwise.
    """

    paper: str
    table: str
    source: Source | None
    root: Path | None
    figures: tuple[Figure, ...]
    rows: tuple[tuple[str, str], ...]
    runs: tuple[Run, ...]
    absent: Mapping[tuple[str, str], str]
    missing: tuple[str, ...]
    waiting: tuple[str, ...] = ()
    metrics: Mapping[str, str] = field(default_factory=dict)
    unnamed: str = ""
    notes: tuple[str, ...] = ()
    folders: Mapping[str, str] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Such as "ETGS, Tab. 1"."""
        return f"{TITLES[self.paper]}, " + ("running text" if self.table == "text" else f"Tab. {self.table}")

    @property
    def printed_metrics(self) -> list[str]:
        """Metrics of which the table prints figures, in its order."""
        return list(dict.fromkeys(figure.metric for figure in self.figures))

    def ours(self, metric: str) -> str | None:
        """Score or cost in metrics.json that a printed metric is compared with."""
        return self.metrics.get(metric, METRICS[metric].ours)

    def members(self, scene: str) -> tuple[str, ...]:
        """The scenes of which a printed figure is."""
        return self.source.members(scene or self.unnamed) if self.source else ()

    def scene_of(self, folder: str) -> str | None:
        """Key of the scene whose folder has this name, among all of the data set; None for none."""
        return self.source.scene_of(folder, self.folders) if self.source else None

    def summary(self, lpips_net: str | None = "alex", lpips_weights: str | None = None) -> str:
        """What runs, what has the paper's figures only and why, what is missing and where it is got: one message.

        Args:
            lpips_net, lpips_weights: settings of the metrics callback, to say beforehand whether there will be LPIPS.
        """
        rows = [row_name(*row) for row in self.rows if row not in self.absent]
        rows = list(dict.fromkeys(run.row for run in self.runs)) or rows
        if self.source is None or not (self.runs or self.missing):
            lines = [f"{self.title}: nothing of this table is trained, the paper's figures stand alone"]
        else:
            scenes = len({run.scene for run in self.runs})
            lines = [
                f"{self.title}: {len(self.runs)} runs ({len(rows)} rows x {scenes} of {scenes + len(self.missing)} scenes)",
                f"  Rows: {', '.join(rows)}",
            ]
        if self.runs:
            lines.append(f"  Scenes: {', '.join(dict.fromkeys(run.folder for run in self.runs))}")
        firsts = dict.fromkeys((run.after.row, run.after.folder) for run in self.runs if run.after)
        if firsts:
            lines.append(
                f"  Before them, {len(firsts)} runs: {', '.join(f'{row} on {where}' for row, where in firsts)}"
            )
        lines += [f"  {text}" for text in self.left_out()]
        if (self.runs or self.missing) and {"lpips", "rgb_lpips"} & set(self.printed_metrics):
            try:
                find_backbone(str(lpips_net), lpips_weights)
            except LpipsUnavailable as error:
                lines.append(f"  LPIPS will be n/a. {error}")
        if self.missing and self.source:
            lines += ["", self._how_to_get(self.source)]
        return "\n".join(lines)

    def left_out(self) -> list[str]:
        """Methods and scenes with the paper's figures only, a line per reason."""
        reasons: dict[str, list[str]] = {}
        for row, reason in self.absent.items():
            reasons.setdefault(reason, []).append(row_name(*row))
        lines = [f"The paper's figures only: {', '.join(rows)} ({reason})" for reason, rows in reasons.items()]
        return [*lines, *self.waiting]

    def _how_to_get(self, source: Source) -> str:
        root = self.root or Path("/data") / source.key
        if self.root is None:
            why = "data.root is not set"
        elif not self.root.is_dir():
            why = f"there is no folder {self.root}"
        else:
            why = f"not in {self.root}, by name and content (one of {', '.join(source.any)} in its folder)"
        lines = [
            f"Missing: {len(self.missing)} scenes of {source.name}; {why}:",
            f"  {', '.join(self.missing)}",
            f"Get it:  {source.url}",
            f"Put it:  {root}/<scene>/, each with",
            *(f"    {line}" for line in source.layout),
            f"and give data.root={root}; folders of other names: 'table.folders={{{self.missing[0]}: NAME}}'",
        ]
        return "\n".join([*lines, *([source.unsure] if source.unsure else [])])


def reproduction_of(
    config: Mapping[str, Any],
    root: str | None,
    methods: Collection[str],
    ablation: Mapping[str, Mapping[str, Any]] | None = None,
    given: Collection[str] = (),
) -> Reproduction:
    """A published table and the runs that fill it.

    Args:
        config: the section ``table`` of an experiment (conf/experiment/shared/table.yaml has its keys).
        root: folder of the data set.
        methods: those that heatsplat has.
        ablation: rows of the ablation that ``config`` names: name -> {"set": overrides, "printed": setting}.
        given: keys that the command line sets; they win over the table's settings.

    Raises:
        SceneError: a method, scene or setting that is asked for does not exist, or the command line names one in another way.
    """
    for key, instead in (("method", "methods"), ("data.scene", "scenes")):
        if key in given:
            raise SceneError(f"{key}=...: a table has several; choose among them with table.{instead}=[...]")
    paper, table = str(config["paper"]), str(config["number"])
    printed = figures(paper, table)
    rows, chosen = _rows(config, printed, methods)
    reasons = {row: _why_absent(config, row, methods, chosen) for row in rows}
    absent = {row: reason for row, reason in reasons.items() if reason is not None}
    recipes = {row: _recipe(config, row, ablation or {}, given) for row in rows if row not in absent}
    data = source(config["source"]) if config["source"] else None
    wanted = _wanted(config, data, printed) if data and recipes else []
    folder = Path(root).expanduser() if root else None
    found = data.find(folder, config["folders"]) if data else {}
    runs, waiting = _runs(config, recipes, data, found, wanted)
    return Reproduction(
        paper=paper,
        table=table,
        source=data,
        root=folder,
        figures=tuple(printed),
        rows=tuple(rows),
        runs=tuple(runs),
        absent=absent,
        missing=tuple(scene for scene in wanted if scene not in found),
        waiting=tuple(waiting),
        metrics=dict(config["metrics"]),
        unnamed=config["unnamed"],
        notes=(*config["notes"], *doubts(paper, table)),
        folders=config["folders"] or {},
    )


def _runs(
    config: Mapping[str, Any],
    recipes: Mapping[tuple[str, str], Sequence[str]],
    data: Source | None,
    found: Mapping[str, str],
    wanted: Sequence[str],
) -> tuple[list[Run], list[str]]:
    """A run of every recipe on every wanted scene that is found, and a line on each that would come after a run on all other
    scenes, of which some are not."""
    runs: list[Run] = []
    waiting: list[str] = []
    for (method, setting), recipe in recipes.items():
        others = config["others"].get(f"{method} {setting}")
        for scene in (scene for scene in wanted if scene in found):
            run = Run(method, setting, scene, found[scene], (*recipe, f"data.scene='{found[scene]}'"))
            if others is None:
                runs.append(run)
            elif lost := [key for key in data.scenes if key != scene and key not in found]:
                waiting.append(
                    f"Not run: {row_name(method, setting)} on {scene}, which comes after a run on all the other scenes; "
                    f"{', '.join(lost)} is not on disk"
                )
            else:
                folders = [found[key] for key in data.scenes if key != scene]
                runs.append(replace(run, after=_on_others(run, folders, (*recipe, *others))))
    return runs, waiting


def _on_others(run: Run, folders: Sequence[str], overrides: tuple[str, ...]) -> OnOthers:
    """The run on all other scenes, of these folders, after which a run comes."""
    scenes = ",".join(f"'{name}'" for name in folders)
    joined = (*overrides, f"data.scenes=[{scenes}]")
    return OnOthers(run.method, run.setting, run.scene, "+".join(folders), joined)


def _rows(
    config: Mapping[str, Any], printed: Sequence[Figure], methods: Collection[str]
) -> tuple[list[tuple[str, str]], set[tuple[str, str]]]:
    """(method, setting) of every row, those asked for beyond the paper last; and which of them are asked for."""
    rows = list(dict.fromkeys((figure.method, figure.setting) for figure in printed if figure.method))
    extra = [name for name in listed(config["methods"]) if name not in {method for method, _ in rows}]
    if unknown := [name for name in extra if name not in methods]:
        raise SceneError(
            f"table.methods: {', '.join(unknown)} is neither in the table ({_listed(m for m, _ in rows)}) nor in "
            f"conf/method ({_listed(methods)})"
        )
    settings = list(dict.fromkeys(setting for _, setting in rows))
    rows += [(name, setting) for name in extra for setting in settings if not config["ablation"]]
    chosen = set(_chosen(rows, [method for method, _ in rows], config["methods"], "methods"))
    return rows, chosen & set(_chosen(rows, [setting for _, setting in rows], config["settings"], "settings"))


def _why_absent(
    config: Mapping[str, Any], row: tuple[str, str], methods: Collection[str], chosen: Collection[tuple[str, str]]
) -> str | None:
    """Why a row has the paper's figures only; None where it is trained."""
    method, setting = row
    reasons, name = config["absent"], f"{method} {setting}"
    reason = reasons.get(name, reasons.get(method))
    if reason is None and method not in config["recipes"] and method not in methods:
        reason = NOT_HERE
    if reason is None and name not in config["others"]:
        reason = reasons.get(setting)
    return NOT_ASKED if reason is None and row not in chosen else reason


def _recipe(
    config: Mapping[str, Any],
    row: tuple[str, str],
    ablation: Mapping[str, Mapping[str, Any]],
    given: Collection[str],
) -> list[str]:
    """Overrides of a row, without those that the command line decides."""
    method, setting = row
    recipe = [*config["recipes"].get(method, [f"method={method}"]), *_protocol(config, setting, ablation)]
    return [text for text in recipe if key_of(text) not in given]


def _wanted(config: Mapping[str, Any], data: Source, printed: Sequence[Figure]) -> list[str]:
    """Keys of the scenes whose figures are printed, those that are asked for."""
    named = dict.fromkeys(figure.scene or config["unnamed"] for figure in printed)
    wanted = list(dict.fromkeys(key for scene in named for key in data.members(scene)))
    asked = {key for scene in listed(config["scenes"]) for key in data.members(scene) or (scene,)}
    return _chosen(wanted, wanted, sorted(asked), "scenes")


def row_name(method: str, setting: str) -> str:
    """Name of a row."""
    return f"{method}_{setting}" if setting else method


def _protocol(config: Mapping[str, Any], setting: str, ablation: Mapping[str, Mapping[str, Any]]) -> Sequence[str]:
    """Overrides of a setting: those of the table, or of a row of the ablation that has it."""
    if not setting:
        return ()
    if setting in config["protocols"]:
        return config["protocols"][setting]
    for row in ablation.values():
        if row.get("printed") == setting:
            return row.get("set") or ()
    raise SceneError(
        f"the table's setting {setting} is in none of table.protocols, table.absent and rows of table.ablation"
    )


def _chosen(items: Sequence[Any], keys: Sequence[str], asked: Any, what: str) -> list[Any]:
    """The items whose keys are asked for, all where nothing is.

    Raises:
        SceneError: something is asked for that no item has.
    """
    if not (asked := listed(asked)):
        return list(items)
    if unknown := [str(name) for name in asked if name not in keys]:
        raise SceneError(f"table.{what}: {', '.join(unknown)} is not in the table; there are {_listed(keys)}")
    return [item for item, key in zip(items, keys, strict=True) if key in asked]


def _listed(names: Any) -> str:
    return ", ".join(dict.fromkeys(name or "''" for name in names)) or "none"
