"""Whether the verdicts on effects are right where truth is known: scenes of known effects, and the page docs/effects.md."""

from __future__ import annotations

import json
import logging
import multiprocessing
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch

from heatsplat.contracts import SceneData, SceneError
from heatsplat.effects.base import Verdict
from heatsplat.effects.catalogue import CATALOGUE, decide
from heatsplat.io.results import write_atomically
from heatsplat.io.tables import markdown_table
from heatsplat.training.machine import cores

log = logging.getLogger("heatsplat")

HEAD = """# Effects: what a scene may call for, and how that is told

This page is generated: `python src/study.py study=evidence`.

An effect is simulated where its evidence exceeds its threshold and images can tell it. Evidence is a statistic on the training
images that stays below the threshold under the null hypothesis. Effects that look alike one by one are told apart by one joint
fit of all of them to tracks of scene points (`effects/joint/selection.py`): each has to lower a Bayesian information criterion
in the presence of the others. Where metadata is missing an effect is off, and the reason says so.

What was taken in has to show it where it was not fitted (`effects/joint/certainty.py`): on observations that were left out, a
quarter at a time, it has to gain 0.3 dB, and 3.5 standard errors over the images; images whose departures are shuffled must not
gain as much; and what an image has in common must be common to all of its points. Where frames are too few to follow the scene,
or the weather says only roughly how it changes, it has to do so beside any change of the scene: one or two courses over time of
which each point has its own measure. What gains less than 0.1 dB is absent, and so is a change where no such course gains more.
An effect that was left out is in doubt only where it explains what was left out as well as one that is in doubt itself.

What a hot thing warms as it passes shares no course with other points: each changes at a moment of its own. Where the scene
cools otherwise, such points are counted (`effects/joint/moments.py`), and a source of all harmonics stands for what warms them.
On `moving_source` they are 4 to 5 times as many as by chance, elsewhere at most 1.5 times.

Sun, sky and wind are judged by balances of heat fitted with and without them (`effects/weathered.py`), massive walls by balances
of bodies of one rate, with a core, and without an end. Shadows are cast by the sparse points: they add no number to a balance,
gain 0.13 dB (3.2 standard errors) on `outdoor_true` (demo) and lose 0.85 dB on `outdoor`, where there are none. Hidden sky, light
from the ground and mirrored sky are asked in the same way, but what balances miss is taken for them: they gain up to 0.47 dB
where there is none, and 0.08 dB and less on `outdoor_true`, where all three are. So they are simulated where they gain 0.5 dB,
or where they are switched on. Sky that is hidden takes a constant share of what a point absorbs and
emits, which its own numbers take as well; that of sparse points is too rough beside it.

What fails, what would take its place, and what the record has too few frames for **cannot be told**, and its reason says what
would be needed. It is then simulated only where the joint fit took it in, as the best explanation of the images that there is.
A run's table has the decibels beside the milliseconds that they cost; `effects.least_db_per_ms` asks for a least ratio of the
two.

`method=auto` with `effects=auto` asks the scene, `effects=all` simulates whatever its metadata allow (bodies without an end,
which stand in the place of others, where the scene says so), `effects=none` nothing. `effects.<name>=on|off|auto` overrules any
of them. What is set by hand (`effects.parts.attenuation.moments=8`) wins over what the evidence would start from. The papers'
systems are selections too, `effects=etgs|ravigs|ti3dgs|thermogs|supirgs`: the effects that they simulate, whatever the scene.
That of ETGS is `method=etgs` to the last bit, that of SupIR-GS has its camera; where a paper has a network, the catalogue has a
closed form. `effects=etgs effects.harmonic_source=off` is ETGS without its source.

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
DRAWN = "drawn_"  # how the names of scenes begin that are drawn at random
CONDITIONS: dict[str, Callable[[SceneData], bool]] = {
    "in a room": lambda scene: scene.weather is None,
    "under the sky": lambda scene: scene.weather is not None,
    "under the sky at night": lambda scene: (
        scene.weather is not None and float(scene.weather.irradiance_w_m2.max()) < 1
    ),
    "10 training frames or fewer": lambda scene: len(scene.train) <= 10,
    "11 to 20": lambda scene: 10 < len(scene.train) <= 20,
    "more": lambda scene: len(scene.train) > 20,
    "8 bits": lambda scene: scene.notes["bits"] == 8,
    "noise of 0.15 K or more": lambda scene: scene.notes["noise_k"] >= 0.15,
    "poses off by half a pixel or more": lambda scene: scene.notes["pose_error_px"] >= 0.5,
    "with gain control": lambda scene: "agc" in scene.notes["effects"],
}
MISSED, TAKEN, UNTOLD = (attrgetter(name) for name in ("missed", "taken", "untold"))
COLUMNS = ("effect", "stage", "what it is", "source", "needs", "null hypothesis", "threshold", "adds")


@dataclass(frozen=True)
class Outcome:
    """The verdicts on one scene.

    Args:
        scene, size, seed: which one.
        present: names of the effects that it shows in truth.
        verdicts: by name.
        seconds: what deciding took.
        conditions: in which it was recorded.
    """

    scene: str
    size: str
    seed: int
    present: frozenset[str]
    verdicts: Mapping[str, Verdict]
    seconds: float
    conditions: tuple[str, ...] = ()

    @property
    def found(self) -> frozenset[str]:
        """Names of the effects that are on."""
        return frozenset(name for name, verdict in self.verdicts.items() if verdict.on)

    @property
    def untold(self) -> frozenset[str]:
        """Names of the effects that cannot be told."""
        return frozenset(name for name, verdict in self.verdicts.items() if not verdict.told)

    @property
    def missed(self) -> frozenset[str]:
        """Names of the effects that are there and were told not to be."""
        return self.present - self.found - self.untold

    @property
    def taken(self) -> frozenset[str]:
        """Names of the effects that were told to be there and are not."""
        return self.found - self.present - self.untold

    @property
    def wrong(self) -> int:
        """How many verdicts are wrong."""
        return len(self.missed) + len(self.taken)


def run(
    output_dir: Path | str,
    data: Callable[..., Any],
    scenes: Sequence[str],
    sizes: Sequence[str] = ("tiny",),
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    unseen: Sequence[int] = (),
    drawn: Mapping[str, Sequence[int]] | None = None,
    document: str | None = None,
    jobs: int | None = 1,
) -> str:
    """The page, also written to effects.md in ``output_dir`` and to ``document``.

    Verdicts that are in ``output_dir`` already are taken from there.

    Args:
        output_dir: folder of the results.
        data: makes the data module of a scene from ``scene``, ``size`` and ``scene_seed``; its notes name the "effects".
        scenes, sizes: verdicts are asked for every pair of them.
        seeds: of the recordings of each.
        unseen: of further ones, which no threshold was set on; they are counted apart.
        drawn: first number and count of scenes that are drawn at random, by what they are called; they are of the first size.
        document: file that is written besides; None for none.
        jobs: recordings that are worked on side by side, with one thread each; None: one for each core.
    """
    numbers = {name: range(first, first + count) for name, (first, count) in (drawn or {}).items()}
    cases = [(scene, size, seed) for size in sizes for scene in scenes for seed in (*seeds, *unseen)]
    cases += [(f"{DRAWN}{number}", sizes[0], number) for these in numbers.values() for number in these]
    folder = Path(output_dir) / "verdicts"
    folder.mkdir(parents=True, exist_ok=True)
    known = {case: folder / f"{'_'.join(map(str, case))}.json" for case in cases}
    waiting = [case for case in cases if not known[case].exists()]
    for done, outcome in enumerate(_outcomes(data, waiting, cores() if jobs is None else jobs), start=1):
        write_atomically(known[outcome.scene, outcome.size, outcome.seed], json.dumps(_plain(outcome), indent=1))
        log.info("%d of %d: %s %s %d", done, len(waiting), outcome.scene, outcome.size, outcome.seed)
        for name in sorted(outcome.missed | outcome.taken):
            log.info("    %s is %s", name, "missed" if name in outcome.present else "not there")
            log.info("    %s", outcome.verdicts[name].reason)
    outcomes = [_read(path) for path in known.values()]
    text = written(outcomes, frozenset(unseen), numbers)
    for path in (Path(output_dir) / "effects.md", *([Path(document)] if document else [])):
        path.write_text(text, encoding="utf-8")
    log.info("%s", text)
    return text


def _outcomes(data: Callable[..., Any], cases: Sequence[tuple[str, str, int]], jobs: int) -> Iterator[Outcome]:
    """The outcomes of cases (scene, size, seed), in their order."""
    if not cases:
        return
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
    seconds = time.perf_counter() - start
    conditions = tuple(name for name, holds in CONDITIONS.items() if holds(recorded))
    return Outcome(scene, size, seed, frozenset(recorded.notes["effects"]), verdicts, seconds, conditions)


def _plain(outcome: Outcome) -> dict[str, Any]:
    return {**asdict(outcome), "present": sorted(outcome.present)}


def _read(path: Path) -> Outcome:
    said = json.loads(path.read_text(encoding="utf-8"))
    verdicts = {name: Verdict(**verdict) for name, verdict in said["verdicts"].items()}
    sets = {"present": frozenset(said["present"]), "conditions": tuple(said["conditions"])}
    return Outcome(**{**said, "verdicts": verdicts, **sets})


def written(
    outcomes: Sequence[Outcome],
    unseen: frozenset[int] = frozenset(),
    drawn: Mapping[str, Collection[int]] | None = None,
) -> str:
    """The page; recordings of the seeds in ``unseen``, and scenes ``drawn`` at random, have tables of their own."""
    of_numbers = {
        name: [one for one in outcomes if one.scene.startswith(DRAWN) and one.seed in numbers]
        for name, numbers in (drawn or {}).items()
    }
    outcomes = [one for one in outcomes if not one.scene.startswith(DRAWN)]
    rows = [
        (
            effect.name, effect.stage, effect.summary, effect.source, ", ".join(sorted(effect.needs)) or "images",
            effect.null, f"{effect.threshold:g}", effect.adds,
        )
        for effect in CATALOGUE
    ]  # fmt: skip
    lines = [HEAD, "## The catalogue\n", *markdown_table(COLUMNS, rows)]
    for size in dict.fromkeys(outcome.size for outcome in outcomes):
        for which, wanted in ((size, False), (f"{size}, on recordings that no threshold was set on", True)):
            these = [outcome for outcome in outcomes if outcome.size == size and (outcome.seed in unseen) == wanted]
            lines += _confusion(which, these) if these else []
    for name, these in of_numbers.items():
        lines += _of_drawn(name, these) if these else []
    return "\n".join(lines) + "\n"


def _confusion(which: str, outcomes: Sequence[Outcome]) -> list[str]:
    """How verdicts and truth agree: one table by effect, one by scene."""
    by_scene = []
    for scene in dict.fromkeys(outcome.scene for outcome in outcomes):
        these = [outcome for outcome in outcomes if outcome.scene == scene]
        lists = ([name for one in these for name in sorted(names(one))] for names in (MISSED, TAKEN, UNTOLD))
        shows = ", ".join(sorted(these[0].present)) or "nothing"
        good = sum(outcome.wrong == 0 for outcome in these)
        by_scene.append((scene, shows, f"{good} of {len(these)}", *map(_counted, lists)))
    head = ("scene", "shows", "nothing wrong", "missed", "taken in", "cannot be told")
    return [*_by_effect(f"Verdicts against truth, {which}", outcomes), *markdown_table(head, by_scene)]


def _of_drawn(name: str, outcomes: Sequence[Outcome]) -> list[str]:
    """How verdicts and truth agree on scenes drawn at random: one table by effect, one by how they were recorded."""
    numbers = sorted(outcome.seed for outcome in outcomes)
    title = f"Verdicts against truth, scenes drawn at random, {name} ({DRAWN}{numbers[0]} to {DRAWN}{numbers[-1]})"
    rows = []
    for condition in CONDITIONS:
        these = [outcome for outcome in outcomes if condition in outcome.conditions]
        if these:
            rows.append((condition, len(these), *_shares(these)))
    head = ("recorded", "scenes", "right %", "cannot be told %", "wrong %")
    return [*_by_effect(title, outcomes), *markdown_table(head, rows)]


def _shares(outcomes: Sequence[Outcome]) -> tuple[str, str, str]:
    """Of the verdicts, how many hundredths are right, cannot be told, and are wrong."""
    cases = len(outcomes) * len(CATALOGUE)
    untold, wrong = (sum(count) for count in zip(*((len(one.untold), one.wrong) for one in outcomes), strict=True))
    return tuple(f"{100 * count / cases:.1f}" for count in (cases - untold - wrong, untold, wrong))


def _by_effect(title: str, outcomes: Sequence[Outcome]) -> list[str]:
    """How verdicts and truth agree in words, and a table by effect."""
    right, untold, wrong = _shares(outcomes)
    clean = sum(outcome.wrong == 0 for outcome in outcomes)
    seconds = sorted(outcome.seconds for outcome in outcomes)[len(outcomes) // 2]
    sought = [
        verdict for one in outcomes for verdict in one.verdicts.values() if "lacks" not in verdict.reason or verdict.on
    ]
    rows = []
    for effect in CATALOGUE:
        groups = []
        for there in (True, False):
            these = [outcome for outcome in outcomes if (effect.name in outcome.present) == there]
            on = sum(effect.name in outcome.found - outcome.untold for outcome in these)
            unsure = sum(effect.name in outcome.untold for outcome in these)
            groups.append((on, len(these) - on - unsure, unsure))
        rows.append((effect.name, *groups[0], groups[1][1], groups[1][0], groups[1][2]))
    head = (
        "effect", "present: found", "present: missed", "present: cannot be told", "absent: left out", "absent: taken in",
        "absent: cannot be told",
    )  # fmt: skip
    return [
        f"\n## {title}\n",
        f"Of {len(outcomes) * len(CATALOGUE)} verdicts {right} % are right, {untold} % say that it cannot be told, {wrong} % are "
        f"wrong ({len(sought)} verdicts are on effects whose metadata are there). {clean} of {len(outcomes)} scenes have not a "
        f"single wrong one. Deciding on a scene took {seconds:.1f} s (median, one thread).\n",
        *markdown_table(head, rows),
        "",
    ]


def _counted(names: Sequence[str]) -> str:
    return ", ".join(f"{name} ({names.count(name)})" for name in sorted(set(names)))
