"""Whether the verdicts on effects are right where truth is known: scenes of known effects, and the page docs/effects.md."""

from __future__ import annotations

import logging
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from heatsplat.contracts import SceneError
from heatsplat.effects.base import Verdict
from heatsplat.effects.catalogue import CATALOGUE, decide
from heatsplat.io.tables import markdown_table
from heatsplat.training.machine import cores

log = logging.getLogger("heatsplat")

HEAD = """# Effects: what a scene may call for, and how that is told

This page is generated: `python src/study.py study=evidence`.

An effect is simulated where its evidence exceeds its threshold. Evidence is a statistic on the training images that stays
below the threshold under the null hypothesis. Effects that look alike one by one are told apart by one joint fit of all of
them to tracks of scene points (`effects/joint/selection.py`): each has to lower a Bayesian information criterion in the
presence of the others. Where metadata is missing an effect is off, and the reason says so. Effects whose threshold is "asked
for" have no evidence yet: they are simulated where they are switched on.

`method=auto` with `effects=auto` asks the scene, `effects=all` simulates whatever its metadata allow, `effects=none` nothing.
`effects.<name>=on|off|auto` overrules any of them. What is set by hand (`effects.parts.attenuation.moments=8`) wins over what
the evidence would start from. The papers' systems are selections too, `effects=etgs|ravigs|ti3dgs|thermogs|supirgs`: the
effects that they simulate, whatever the scene. That of ETGS is `method=etgs` to the last bit, that of SupIR-GS has its camera;
where a paper has a network, the catalogue has a closed form. `effects=etgs effects.harmonic_source=off` is ETGS without its
source.

## Add an effect

1. Write `effects/physical/<name>.py` with one `EFFECT = Effect(...)`. The catalogue finds it there and puts it in the order in
   which heat meets effects: by `stage`, then by `place`.
2. Give it its entry in `conf/effects/shared`: a line in `choices.yaml`, and the settings of its part in `parts.yaml`, unless
   another effect has that part already.

Nothing else changes. The file says:

- what it is: `summary`, `source`, `adds`, and `needs`, the metadata without which it is off;
- its `evidence`, a function of an `Inspection` of the scene (`inspected.obs`: images and tracks; `inspected.joint`: the joint fit
  and what it selected), its `null` hypothesis and its `threshold`, with a comment where the number comes from;
- its `term` in the joint fit, if tracks can show it: `Own` numbers of each point, `Shared` numbers of all points, or a `Path`
  that lets a share of the heat arrive (`effects/joint/terms.py`), with the rules that it has to meet beside its threshold;
- its `part`: the slot of the configuration, the settings, and what is set when it is off while another effect needs the part;
- what it `stands_on`, and which effects it `displaces`.

`effects/physical/tone.py` is a short one to start from, `tests/effects/test_new_effect.py` adds one. The part itself is a class
in `thermal/` or `sensors/`. `tests/effects/test_off_is_absent.py` asks for a case of each effect: off, nothing of it is left.
"""
COLUMNS = ("effect", "stage", "what it is", "source", "needs", "null hypothesis", "threshold", "adds")


@dataclass(frozen=True)
class Outcome:
    """The verdicts on one scene.

    Args:
        scene, size, seed: which one.
        present: names of the effects that it shows in truth.
        verdicts: by name.
        seconds: what deciding took.
    """

    scene: str
    size: str
    seed: int
    present: frozenset[str]
    verdicts: Mapping[str, Verdict]
    seconds: float

    @property
    def found(self) -> frozenset[str]:
        """Names of the effects that are on."""
        return frozenset(name for name, verdict in self.verdicts.items() if verdict.on)

    @property
    def wrong(self) -> int:
        """How many verdicts are wrong."""
        return len(self.found ^ self.present)


def run(
    output_dir: Path | str,
    data: Callable[..., Any],
    scenes: Sequence[str],
    sizes: Sequence[str] = ("tiny",),
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    unseen: Sequence[int] = (),
    document: str | None = None,
    jobs: int | None = 1,
) -> str:
    """The page, also written to effects.md in ``output_dir`` and to ``document``.

    Args:
        output_dir: folder of the results.
        data: makes the data module of a scene from ``scene``, ``size`` and ``scene_seed``; its notes name the "effects".
        scenes, sizes: verdicts are asked for every pair of them.
        seeds: of the recordings of each.
        unseen: of further ones, which no threshold was set on; they are counted apart.
        document: file that is written besides; None for none.
        jobs: recordings that are worked on side by side, with one thread each; None: one for each core.
    """
    cases = [(scene, size, seed) for size in sizes for scene in scenes for seed in (*seeds, *unseen)]
    outcomes = []
    for outcome in _outcomes(data, cases, cores() if jobs is None else jobs):
        outcomes.append(outcome)
        log.info("%d of %d: %s %s %d", len(outcomes), len(cases), outcome.scene, outcome.size, outcome.seed)
        for name in sorted(outcome.found ^ outcome.present):
            log.info("    %s is %s", name, "missed" if name in outcome.present else "not there")
            log.info("    %s", outcome.verdicts[name].reason)
    text = written(outcomes, frozenset(unseen))
    Path(output_dir).mkdir(parents=True, exist_ok=True)
    for path in (Path(output_dir) / "effects.md", *([Path(document)] if document else [])):
        path.write_text(text, encoding="utf-8")
    log.info("%s", text)
    return text


def _outcomes(data: Callable[..., Any], cases: Sequence[tuple[str, str, int]], jobs: int) -> Iterator[Outcome]:
    """The outcomes of cases (scene, size, seed), in their order."""
    if jobs == 1:
        torch.set_num_threads(1)  # small tensors
        yield from (outcome_of(data, *case) for case in cases)
        return
    context = multiprocessing.get_context("spawn")  # a fork would share OpenMP's threads
    with ProcessPoolExecutor(jobs, context, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        yield from pool.map(partial(outcome_of, data), *zip(*cases, strict=True))


def outcome_of(data: Callable[..., Any], scene: str, size: str, seed: int) -> Outcome:
    """The verdicts on one recording of a scene.

    Raises:
        SceneError: nobody knows what effects the scene shows.
    """
    recorded = data(scene=scene, size=size, scene_seed=seed).scene
    if "effects" not in recorded.notes:
        raise SceneError(
            f"scene '{recorded.name}' does not say in its notes which effects it shows; judge synthetic ones"
        )
    start = time.perf_counter()
    verdicts = decide(recorded)
    return Outcome(scene, size, seed, frozenset(recorded.notes["effects"]), verdicts, time.perf_counter() - start)


def written(outcomes: Sequence[Outcome], unseen: frozenset[int] = frozenset()) -> str:
    """The page; recordings of the seeds in ``unseen`` have tables of their own."""
    rows = [
        (
            effect.name, effect.stage, effect.summary, effect.source, ", ".join(sorted(effect.needs)) or "images",
            effect.null, f"{effect.threshold:g}" if math.isfinite(effect.threshold) else "asked for", effect.adds,
        )
        for effect in CATALOGUE
    ]  # fmt: skip
    lines = [HEAD, "## The catalogue\n", *markdown_table(COLUMNS, rows)]
    for size in dict.fromkeys(outcome.size for outcome in outcomes):
        for which, wanted in ((size, False), (f"{size}, on recordings that no threshold was set on", True)):
            these = [outcome for outcome in outcomes if outcome.size == size and (outcome.seed in unseen) == wanted]
            lines += _confusion(which, these) if these else []
    return "\n".join(lines) + "\n"


def _confusion(which: str, outcomes: Sequence[Outcome]) -> list[str]:
    """How verdicts and truth agree: one table by effect, one by scene."""
    cases = len(outcomes) * len(CATALOGUE)
    right = cases - sum(outcome.wrong for outcome in outcomes)
    clean = sum(outcome.wrong == 0 for outcome in outcomes)
    seconds = sorted(outcome.seconds for outcome in outcomes)[len(outcomes) // 2]
    lines = [
        f"\n## Verdicts against truth, {which}\n",
        f"{right} of {cases} verdicts are right ({100 * right / cases:.1f} %); {clean} of {len(outcomes)} scenes have not a "
        f"single wrong one. Deciding on a scene took {seconds:.1f} s (median, one thread).\n",
    ]
    by_effect, by_scene = [], []
    for effect in CATALOGUE:
        with_it = [effect.name in outcome.found for outcome in outcomes if effect.name in outcome.present]
        without = [effect.name in outcome.found for outcome in outcomes if effect.name not in outcome.present]
        counts = (sum(with_it), len(with_it) - sum(with_it), len(without) - sum(without), sum(without))
        by_effect.append((effect.name, *counts))
    for scene in dict.fromkeys(outcome.scene for outcome in outcomes):
        these = [outcome for outcome in outcomes if outcome.scene == scene]
        missed = [name for outcome in these for name in sorted(outcome.present - outcome.found)]
        taken = [name for outcome in these for name in sorted(outcome.found - outcome.present)]
        shows = ", ".join(sorted(these[0].present)) or "nothing"
        good = sum(outcome.wrong == 0 for outcome in these)
        by_scene.append((scene, shows, f"{good} of {len(these)}", _counted(missed), _counted(taken)))
    agreement = ("effect", "present: found", "present: missed", "absent: left out", "absent: taken in")
    lines += [*markdown_table(agreement, by_effect), ""]
    return lines + markdown_table(("scene", "shows", "right", "missed", "taken in"), by_scene)


def _counted(names: Sequence[str]) -> str:
    return ", ".join(f"{name} ({names.count(name)})" for name in sorted(set(names)))
