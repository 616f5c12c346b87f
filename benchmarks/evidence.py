"""Whether the verdicts on effects are right where truth is known: scenes of known effects, and the page docs/effects.md."""

from __future__ import annotations

import itertools
import json
import logging
import math
import multiprocessing
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.strengths import strengths
from heatsplat.contracts import SceneData, SceneError, check_count
from heatsplat.effects.assembly import drop_impossible, reconcile
from heatsplat.effects.base import Verdict
from heatsplat.effects.catalogue import CATALOGUE, decide
from heatsplat.io.files import write_atomically
from heatsplat.io.pictures import figure_picture, write_png
from heatsplat.io.tables import markdown_table
from heatsplat.studies.child_runs import refuse_others
from heatsplat.studies.options import listed, non_empty
from heatsplat.training.machine import cores, prepare_machine

log = logging.getLogger("heatsplat")

SCENES = (
    "static", "cooling", "heated", "glass", "noisy_sensor", "haze", "drifting", "drifting_cooling", "uneven", "dark_corners",
    "uneven_heated", "blurred", "blurred_cooling", "bent_tone", "mirrors", "dull", "sheets", "outdoor", "swung", "moving_camera",
)  # fmt: skip
TITLE = "# Effects: which physical effects a scene shows, and how `method=auto` decides"
HEAD = """
`method=auto` looks at the training images before it trains, decides which physical effects they show, and simulates those
alone. A run's report gives the reason for each verdict, its gain in dB and its cost in ms. On the built-in scenes nearly all
verdicts are right; of scenes drawn at random about nine in ten, one or two in a hundred are wrong, and the rest "cannot be
told" (tables below).

```sh
python src/train.py method=auto data.scene=heated                       # decides, and explains why
python src/train.py method=auto data.scene=heated effects.agc=off       # without one effect, whatever the images show
```

## Selections

| setting | simulates |
|---|---|
| `effects=auto` (of `method=auto`) | the effects that the scene shows |
| `effects=all` | everything that the metadata allow (walls of infinite depth, which replace others, only if shown by the scene) |
| `effects=none` | nothing |
| `effects=etgs`, `ravigs`, `ti3dgs`, `thermogs`, `supirgs` | the effects of that paper, whatever the scene |
| `effects.<name>=on`, `off`, `auto` | overrides a single effect |
| `effects.least_db_per_ms` | sets the least gain in dB per ms of a step |
| `effects.source=common`, `harmonics` | chooses how a heat source is modelled |

Values set by hand (`effects.parts.attenuation.moments=8`) take precedence over initial values from the evidence. `effects=etgs`
is `method=etgs` to the last bit, and `effects=supirgs` has the camera of SupIR-GS. Where a paper uses a network, the catalogue
uses a closed form. `effects=etgs effects.harmonic_source=off` is ETGS without its source.

## How it decides

An effect is simulated if its *evidence* exceeds its *threshold* and the decision is sufficiently certain. Evidence is a
statistic of the training images that stays below the threshold under the effect's null hypothesis. An effect whose metadata are
missing is off.

**Joint fit.** Some effects look alike when tested alone. One fit of all effects to tracks of scene points separates them
(`effects/joint/selection.py`): an effect is selected only if it lowers a Bayesian information criterion in the presence of the
others.

**Undecided effects.** An effect **cannot be told** if it fails the tests below, if another effect would take its place, or if
the record has too few frames; its reason says what would be needed. It is then simulated only if the joint fit selected it as
the best available explanation of the images; gains of single images (AGC) not even then under recorded weather. On four such
scenes without AGC, the error on another day is 0.28 to 0.74 of what it is with them (0.71 to 2.46 instead of 1.1 to 3.5 °C).
Sun, sky and wind of a record are simulated where balances gain by them, however little (half a standard error): on 200 random
scenes that was right for 15 of 18 (**on?** in a run's table).

**Cross-validation.** A selected effect must also explain held-out observations (`effects/joint/certainty.py`, four folds):

- It gains at least 0.3 dB, and 3.5 standard errors over the images. Images with shuffled residuals do not gain as much.
- A change of a whole image is shared by all its points: what one half of the points says of each image explains at least half
  as much of the other half as all points together do. Effects of the whole record, such as a fixed pattern, keep what all
  points say of them.
- If there are too few frames to follow the scene, or the weather describes its changes only roughly, the effect must gain this
  much in addition to a generic change of the scene: one or two time courses, scaled separately for each point.
- An effect that gains less than 0.1 dB is absent; so is a change over time if no such course gains more. A bent curve is
  absent, too, if it gains nothing beside offsets that may be there: without them nothing shows it. Heat in doubt, which takes
  offsets along, gives way to an offset and a gain of each image there.
- A pattern of the camera that gains little for its parameters is certain from 1 dB on, if it also gains that without effects in
  doubt: blur passes for a pattern and a falloff of emissivity at once. What images change by stays, because something has to.
- A rejected effect is in doubt only if it explains the held-out observations as well as an effect that is itself in doubt, or
  if it is worth its parameters and explains held-out observations, but too few of them.
- Heat takes the place of offsets and gains of single images if these go over time as heat does, closer than 99 of 100 random
  walks (`effects/joint/like_heat.py`). Numbers for each image cost less than numbers for each point, so the criterion alone
  preferred a drifting camera to a scene that cools alike.
- In records with too few frames to follow the scene, changes of single images have to outdo a generic change however well they
  explain the images, and heat stays undecided while they are.

### Heat

**Heat sources.** A lamp, a heating or a burner is switched on and off once for all that it warms. Where something drives the
points, one course of power is fitted to all of them (`physics/common_course.py`); each answers it in three exponentials.
`method=auto` learns that course and six numbers for each Gaussian if, fitted to three of four images, it predicts the others
better than K harmonics of each point do; else K harmonics for each Gaussian (ETGS). The fewer the images, the less the course
bends between them. Course and extinction of the air start at what the joint fit found: training alone confuses the latter,
which the fit knows to a thousandth of its largest, with warmer surfaces. `renders/courses.png` shows what was learned.

**A camera before a heat source.** Points move through the image while time goes by, so the joint fit may take a camera's
pattern for heat. Where all points answer one source, fixed pattern and vignetting are therefore judged beside what surfaces can
answer to its course (`effects/heat_source.py`), if together they gain 2 dB on held-out observations (5 dB on `uneven_heated`).

The source itself is certain if surfaces that answer its course are clearly better predicted than surfaces that relax before a
camera with its own offset and gain in each image, and than surfaces behind air that takes its own share from each; if that
camera predicts better, it cannot be told. The gain is 1.4 to 4.6 dB on `heated` (tiny, 16 to 31 images), and -0.1 to -3.1 dB on
six random scenes without a lamp whose points seemed to answer one. That the scene changes is certain even then, if before that
camera and behind such air surfaces that relax are clearly better predicted than constant levels.

**Heat that flows.** Where nothing drives the points, contrasts between neighbours fade as fast as the levels that they share,
unless heat flows between them. Levels fade to the temperature of the surroundings, which may be given wrong: off by a tenth of
the range, a flow seemed certain on nine of 11 random scenes without one, or certainly absent where there was one. Differences
between levels need no such temperature, but a flow fades them, too. The verdict is certain only if both agree
(`effects/physical/conduction.py`); on 36 random scenes and nine recordings of presets they do wherever it was right. Beside a
common course, a flow is absent if contrasts answer it at most 1.17 times as fast as levels (0.5 to 1.1 times on 15 recordings
with a lamp and no flow); if faster, it cannot be told, because bodies of two rates do so, too.

**Heat goes on between images.** A camera may jump from image to image; surfaces do not. Heat that would take the place of an
effect in doubt is absent if one or two courses over time do not predict images that are left out whole, on the line between
their neighbours in time (`effects/joint/foreseen.py`), although they would predict a decay and a swing as large as the error
expected of an observation. On 14 random scenes that change (14 frames or more) courses gain 1.7 to 7.1 dB; on four still ones
at most 0.1 dB. A gain that walks slowly is predicted as heat is (2 to 7 dB on three), and leaves heat in doubt.

**Moving heat sources.** Points warmed by a passing hot object each change at their own time and share no course. If the scene
otherwise cools, such points are counted (`effects/joint/moments.py`), those that change one way against those that change the
other, as misplaced points change both ways; a source with all harmonics then models what warms them. On `moving_source` there
are 5.3 times (320x256) and 6.6 to 9.8 times (tiny, six recordings) as many as by chance change that way, elsewhere at most 1.9
times (`metals`).

### Emissivity and angle

Surfaces emit less towards their sides: smooth dielectrics only at grazing angles (Schlick's law, the fifth power of 1 - cos θ),
rough ones earlier (the first power). The joint fit has one falloff for all points
(`effects/physical/directional_emissivity.py`) and chooses the power. Harmonics of each point, which also make up for inexact
normals, give way where, at the usual point, the falloff explains four fifths of what they explain; likewise where mirrors do,
which explain 0.97 to 0.99 of it on four recordings with mirrors (`mirrors`, two random rooms). Normals are those of planes
through 17 scene points of which those on other surfaces count little (`effects/surface.py`): on the planes of three random
rooms they are off by 0.6° in the median, and nine of ten by less than 2 to 10°.

Blur takes contrast of slanted points and passes for a falloff, but its effects from afar and beside edges remain. A falloff is
therefore certain only if, of the half of the points that it changes most, it explains at the usual one a third of what
harmonics explain. It does 0.42 to 1.23 on 25 of 26 recordings with a falloff (tiny, random but for `dull`; 0.23 on one, where
it is below the noise), 0.5 and 0.8 on two with smooth surfaces, and 0.01 to 0.29 on the twelve without where one was taken in.

### Weather

Sun, sky and wind are judged by heat balances fitted with and without them: linear ones (`effects/weathered.py`), and full ones
of bodies with a core, whose T⁴ and gusts are as they are (`effects/full_balance.py`). What tells more counts: expectations hold
linear ones where frames are few, and full ones follow points of many frames three to ten times as closely (wind gains 2.3 dB and
9.7 standard errors on `outdoor` where linear balances gain 0.3 dB and 2.8). Massive walls are judged by balances of bodies with
one rate, with a core, and of infinite depth.

- Sun, sky and wind count from a gain of two standard errors on: a part that is absent loses on held-out observations. Of 91
  that 200 random scenes have, linear balances alone found 70 and missed 10; with full ones 82 are found and one missed, and two
  are found that are not there (one before). On 100 scenes that nobody had looked at, 21 of 24 are found, one is missed, and
  none is wrongly found.
- In few frames a part that is there may gain nothing. Sun and sky are absent only if bodies also take a share below the least
  that counts: 0.02 at most on nine random scenes without, 0.11 on one of nine frames whose sunlight gains nothing. What gains
  two standard errors is not absent, however small it is.
- What a camera does is judged beside full balances (`effects/beside_balances.py`): the joint fit is repeated with the balance of
  each point, and the six ways at most in which likely changes of its numbers move it, in the place of answers to weather in
  general. Points follow these to 0.3 to 1.3 expected errors on 47 of 48 random scenes with frames enough. What all balances may
  miss together is no drift: beside what balances can make of it themselves, offsets are 0.2 K at most in five recordings without
  a drifting sensor, and 0.45 K and more in six with one; they count from 0.3 K on. Where
  balances could say nearly all of what the camera adds (all but 0.04 of the squares), they keep what they can say: a pattern had
  grown to 80 and 18 K on two of 81 random scenes, and the warmth of all points left with it. Of verdicts on the 45 outdoor
  scenes among 200 random ones 91.1 % are right, where 81.8 % were beside answers in general, and 0.9 % are wrong (1.4 % before).
- Where frames are too few for that, or points do not follow balances, the camera is judged beside answers in general. Errors of
  a record pass for vignetting there, and hide it: on five of 18 random scenes with it, none was found. What changes with
  the distance from the middle by a tenth of the noise, and is no clear falloff, is therefore in doubt, as is more than a tenth
  in the corners. That a falloff of a tenth, added to the images, would show does not rule it out: two of seven so judged had
  one.
- Shadows are cast by the sparse points and add no parameter to a balance. They gain 0.13 dB (3.2 standard errors) on
  `outdoor_true` (demo) and lose 0.85 dB on `outdoor`, which has none.
- Hidden sky, light from the ground and reflected sky are tested in the same way, but they also absorb other errors of a
  balance: they gain up to 0.47 dB where they are absent, and at most 0.08 dB on `outdoor_true`, which has all three. They are
  therefore simulated only if they gain 0.5 dB or are switched on. Hidden sky scales what a point absorbs and emits by a
  constant, which the point's own parameters can represent as well; its estimate from sparse points is too coarse to add
  anything.
- Rain of the record wets surfaces, and its clouds warm the sky, unless full balances predict observations better by 1.5
  standard errors without. On `outdoor_true` under its four weathers (demo, and 13 images of size tiny) rain gains -0.2 to 1.3
  dB (-0.7 to 3.9 standard errors) and clouds 0.04 to 0.22 dB (0.4 to 2.6); both are always taken. On `outdoor`, where nothing
  gets wet and the sky is clear in long waves, rain loses 0.1 to 3.8 dB (1.9 standard errors and more) under eleven of twelve
  records with showers, and clouds 0.2 to 0.6 dB (1.4 to 4.3; demo); 13 images do not tell clouds there.
- Dry surfaces transpire where full balances gain 0.05 dB and one standard error by it. On `outdoor_true`, whose meadow does,
  that is so in five of eight recordings (up to 0.98 dB); on `outdoor` in none of six, nor in 24 scenes drawn at random (0.04 dB
  and 0.9 at most). Linear balances do not tell it: what evaporates from grass at noon looks like light that it does not take.
- Surfaces have a core where bodies with one gain 0.2 dB and three standard errors (1.9 dB and 7.0 on `outdoor_true`, 1.4 dB and
  3.7 on `outdoor`; demo).

## Add an effect

1. Write `effects/physical/<name>.py` with one `EFFECT = Effect(...)`. The catalogue finds it and orders effects from the
   scene to the sensor: by `stage`, then by `place`.
2. Add it to `conf/effects/shared`: a line in `choices.yaml`, and the settings of its part in `parts.yaml` unless another
   effect already has that part.

Nothing else changes. The file states:

- `summary`, `source`, `adds`, and `needs`: the metadata it requires;
- `evidence`, a function of an `Inspection` of the scene (`inspected.obs`: images and tracks; `inspected.joint`: the joint fit
  and its selection), the `null` hypothesis, and the `threshold` with a comment on its origin;
- `term` in the joint fit, if tracks can show the effect: `Own` parameters of each point, `Shared` parameters of all points,
  or a `Path` that transmits a fraction of the heat (`effects/joint/terms.py`), with the rules it must meet besides the
  threshold;
- `part`: the configuration slot, the settings, and what is set if the effect is off while another effect needs the part;
- `stands_on` (the effects it requires) and `displaces` (those it replaces).

`effects/physical/tone.py` is a short example; `tests/effects/test_new_effect.py` adds one. The part itself is a class in
`thermal/` or `sensors/`. `tests/effects/test_off_is_absent.py` needs a case for each effect, to check that nothing of it
remains when it is off.
"""
PICTURE = "verdicts_by_strength.png"
STRENGTH_NOTE = f"""Do the wrong and the undecided verdicts matter? Each effect was taken out of the truth of its scene
(`benchmarks/without.py`) and the scene was filmed again without noise. *Strength* is the root mean square of the difference
of training images, along the tracks of scene points and beside a level for each point, in standard deviations of the noise of a
pixel. Only effects that are there have one. An error of poses, and what other effects could explain instead, are not in it:

![verdicts by strength](pictures/{PICTURE})"""
STRENGTH_AGAIN = "By strength, as above:"
DRAWN = "drawn_"  # how the names of scenes begin that are drawn at random
CONDITIONS: dict[str, Callable[[SceneData], bool]] = {
    "indoor": lambda scene: scene.weather is None,
    "outdoor": lambda scene: scene.weather is not None,
    "outdoor, at night": lambda scene: scene.weather is not None and float(scene.weather.irradiance_w_m2.max()) < 1,
    "10 training frames or fewer": lambda scene: len(scene.train) <= 10,
    "11 to 20 training frames": lambda scene: 10 < len(scene.train) <= 20,
    "more than 20": lambda scene: len(scene.train) > 20,
    "8 bits": lambda scene: scene.notes["bits"] == 8,
    "noise of 0.15 K or more": lambda scene: scene.notes["noise_k"] >= 0.15,
    "poses off by half a pixel or more": lambda scene: scene.notes["pose_error_px"] >= 0.5,
    "with gain control": lambda scene: "agc" in scene.notes["effects"],
}
# Strengths of effects, in standard deviations of the noise of a pixel, between which verdicts are counted together.
STRENGTHS = (0.0, 1.0, 3.0, 10.0, 30.0, math.inf)
LEAST_RIGHT, MOST_WRONG = 95.0, 1.0  # hundredths of the verdicts on scenes that are drawn at random
MISSED, TAKEN, UNTOLD = (attrgetter(name) for name in ("missed", "taken", "untold"))
COLUMNS = ("effect", "stage", "what it is", "source", "needs", "null hypothesis", "threshold", "adds")


@dataclass(frozen=True)
class Outcome:
    """The verdicts on one scene.

    Args:
        scene, size, seed: which one.
        present: names of the effects that it shows in truth.
        verdicts: by name.
        seconds: of processor time that deciding took.
        conditions: in which it was recorded.
        strengths: of the effects that it shows, by name (``benchmarks.strengths``); of scenes that are drawn at random only.
    """

    scene: str
    size: str
    seed: int
    present: frozenset[str]
    verdicts: Mapping[str, Verdict]
    seconds: float
    conditions: tuple[str, ...] = ()
    strengths: Mapping[str, float] = field(default_factory=dict)

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
    scenes: Sequence[str] | None = None,
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
        data: makes the data module of a scene from ``scene``, ``size`` and ``scene_seed``; its notes name the "effects". What a
            partial function has further is kept with the verdicts.
        scenes, sizes: verdicts are asked for every pair of them; None for SCENES.
        seeds: of the recordings of each.
        unseen: of further ones, which no threshold was set on; they are counted apart.
        drawn: first number and count of scenes that are drawn at random, by what they are called; they are of the first size.
        document: file that is written besides, and in "pictures" beside it how verdicts go with the strength of effects, where
            all scenes were asked for, and recordings of each kind: seeds, unseen and drawn. None for none.
        jobs: recordings that are worked on side by side, with one thread each; None: one for each core.

    Raises:
        SceneError: there is no size, or nothing to decide on, or a verdict is of other settings of the data.
    """
    any_drawn = any(count for _, count in (drawn or {}).values())
    whole = scenes is None and bool(listed(seeds) and listed(unseen)) and any_drawn
    scenes = SCENES if scenes is None else scenes
    if jobs is not None:
        check_count("study.jobs", jobs)
    sizes, scenes, seeds, unseen = non_empty("study.sizes", sizes), listed(scenes), listed(seeds), listed(unseen)
    numbers = {name: range(first, first + count) for name, (first, count) in (drawn or {}).items()}
    cases = [(scene, size, seed) for size in sizes for scene in scenes for seed in (*seeds, *unseen)]
    cases += [(f"{DRAWN}{number}", sizes[0], number) for these in numbers.values() for number in these]
    if not cases:
        raise SceneError("study.scenes, study.seeds and study.drawn name no recording: give scenes and seeds")
    folder = Path(output_dir) / "verdicts"
    folder.mkdir(parents=True, exist_ok=True)
    known = {case: folder / f"{'_'.join(map(str, case))}.json" for case in cases}
    settings = [f"data.{key}={value}" for key, value in getattr(data, "keywords", {}).items()]
    waiting = [case for case in cases if not known[case].exists()]
    for path in (known[case] for case in cases if case not in waiting):
        refuse_others(path, json.loads(path.read_text(encoding="utf-8")).get("settings", ()), settings)
    for done, outcome in enumerate(_outcomes(data, waiting, cores() if jobs is None else jobs), start=1):
        path = known[outcome.scene, outcome.size, outcome.seed]
        write_atomically(path, json.dumps(_plain(outcome, settings), indent=1))
        log.info("%d of %d: %s %s %d", done, len(waiting), outcome.scene, outcome.size, outcome.seed)
        for name in sorted(outcome.missed | outcome.taken):
            log.info("    %s is %s", name, "missed" if name in outcome.present else "not there")
            log.info("    %s", outcome.verdicts[name].reason)
    outcomes = [_read(path) for path in known.values()]
    text = written(outcomes, frozenset(unseen), numbers)
    figure = picture([one for one in outcomes if one.strengths])
    for path in (Path(output_dir) / "effects.md", *([Path(document)] if document and whole else [])):
        path.write_text(text, encoding="utf-8")
        if figure is not None:
            (path.parent / "pictures").mkdir(exist_ok=True)
            write_png(path.parent / "pictures" / PICTURE, figure_picture(figure))
    log.info("%s", text)
    return text


def _outcomes(data: Callable[..., Any], cases: Sequence[tuple[str, str, int]], jobs: int) -> Iterator[Outcome]:
    """The outcomes of cases (scene, size, seed), in their order."""
    if not cases:
        return
    if jobs == 1:
        prepare_machine(1)  # small tensors
        yield from (outcome_of(data, *case) for case in cases)
        return
    context = multiprocessing.get_context("spawn")  # a fork would share OpenMP's threads
    with ProcessPoolExecutor(jobs, context, initializer=prepare_machine, initargs=(1,)) as pool:
        yield from pool.map(partial(outcome_of, data), *zip(*cases, strict=True))


def outcome_of(data: Callable[..., Any], scene: str, size: str, seed: int) -> Outcome:
    """The verdicts on one recording of a scene, as a run simulates them.

    Raises:
        SceneError: nobody knows what effects the scene shows.
    """
    module = data(scene=scene, size=size, scene_seed=seed)
    recorded = module.scene
    if "effects" not in recorded.notes:
        raise SceneError(
            f"scene '{recorded.name}' does not say in its notes which effects it shows; judge synthetic ones"
        )
    start = time.process_time()
    verdicts = reconcile(drop_impossible(decide(recorded), recorded))
    seconds = time.process_time() - start
    conditions = tuple(name for name, holds in CONDITIONS.items() if holds(recorded))
    strong = strengths(module) if scene.startswith(DRAWN) else {}
    return Outcome(scene, size, seed, frozenset(recorded.notes["effects"]), verdicts, seconds, conditions, strong)


def _plain(outcome: Outcome, settings: Sequence[str]) -> dict[str, Any]:
    return {**asdict(outcome), "present": sorted(outcome.present), "settings": settings}


def _read(path: Path) -> Outcome:
    said = json.loads(path.read_text(encoding="utf-8"))
    said.pop("settings", None)
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
    made_by = f"This page is generated:\n`{_command(outcomes, unseen, drawn or {})}`."
    rows = [
        (
            effect.name, effect.stage, effect.summary, effect.source, ", ".join(sorted(effect.needs)) or "images",
            effect.null, f"{effect.threshold:g}", effect.adds,
        )
        for effect in CATALOGUE
    ]  # fmt: skip
    lines = [TITLE, "", made_by, HEAD, "## The catalogue\n", *markdown_table(COLUMNS, rows)]
    for size in dict.fromkeys(outcome.size for outcome in outcomes):
        for which, wanted in ((size, False), (f"{size}, on recordings not used to set thresholds", True)):
            these = [outcome for outcome in outcomes if outcome.size == size and (outcome.seed in unseen) == wanted]
            lines += _confusion(which, these) if these else []
    for name, these in of_numbers.items():
        note = STRENGTH_AGAIN if STRENGTH_NOTE in lines else STRENGTH_NOTE
        lines += _of_drawn(name, these, note) if these else []
    return "\n".join(lines) + "\n"


def _command(outcomes: Sequence[Outcome], unseen: Collection[int], drawn: Mapping[str, Collection[int]]) -> str:
    """What makes the page: scenes where they are not all, sizes, seeds and numbers of scenes that are drawn at random."""
    scenes, sizes, seeds = (
        [*dict.fromkeys(getattr(one, name) for one in outcomes)] for name in ("scene", "size", "seed")
    )
    sets = ",".join(f"{name}:[{min(numbers, default=0)},{len(numbers)}]" for name, numbers in drawn.items())
    lists = {
        **({} if scenes == [*SCENES] else {"scenes": scenes}), "sizes": sizes,
        "seeds": [seed for seed in seeds if seed not in unseen], "unseen": sorted(unseen),
    }  # fmt: skip
    words = [f"study.{key}=[{','.join(map(str, values))}]" for key, values in lists.items()]
    return " ".join(
        ["python src/study.py study=evidence", *words, f'"study.drawn={{{sets}}}"' if sets else "study.drawn=null"]
    )


def _confusion(which: str, outcomes: Sequence[Outcome]) -> list[str]:
    """How verdicts and truth agree: one table by effect, one by scene."""
    by_scene = []
    for scene in dict.fromkeys(outcome.scene for outcome in outcomes):
        these = [outcome for outcome in outcomes if outcome.scene == scene]
        lists = ([name for one in these for name in sorted(names(one))] for names in (MISSED, TAKEN, UNTOLD))
        shows = ", ".join(sorted(these[0].present)) or "nothing"
        good = sum(outcome.wrong == 0 for outcome in these)
        by_scene.append((scene, shows, f"{good} of {len(these)}", *map(_counted, lists)))
    head = ("scene", "shows", "no wrong verdict", "missed", "wrongly found", "cannot be told")
    return [*_by_effect(f"Verdicts compared with the truth, {which}", outcomes), *markdown_table(head, by_scene)]


def _of_drawn(name: str, outcomes: Sequence[Outcome], note: str) -> list[str]:
    """How verdicts and truth agree on scenes drawn at random: one table by effect, one by how they were recorded, and below the
    ``note`` one by strength.
    """
    numbers = sorted(outcome.seed for outcome in outcomes)
    title = f"Verdicts compared with the truth, scenes drawn at random, {name} ({DRAWN}{numbers[0]} to {DRAWN}{numbers[-1]})"
    rows = []
    for condition in CONDITIONS:
        these = [outcome for outcome in outcomes if condition in outcome.conditions]
        if these:
            rows.append((condition, len(these), *_shares(these)))
    head = ("recording", "scenes", "right %", "cannot be told %", "wrong %")
    right, _, wrong = map(float, _shares(outcomes))
    reached = "is reached" if right >= LEAST_RIGHT and wrong <= MOST_WRONG else "is not reached"
    goal = f"The goal of {LEAST_RIGHT:g} % right and at most {MOST_WRONG:g} % wrong {reached}. "
    goal += "Verdicts on effects whose metadata are missing count as right.\n"
    return [*_by_effect(title, outcomes, goal), *markdown_table(head, rows), *_by_strength(outcomes, note)]


def groups_by_strength(outcomes: Sequence[Outcome]) -> list[tuple[float, float, int, int, int, int]]:
    """Of the effects that are there: between which strengths they are, and how many of them are found, told absent, undecided but
    simulated, and undecided and left out."""
    pairs = [(one, name, strength) for one in outcomes for name, strength in one.strengths.items()]
    groups = []
    for low, high in itertools.pairwise(STRENGTHS):
        these = [(one, name) for one, name, strength in pairs if low <= strength < high]
        found = sum(name in one.found - one.untold for one, name in these)
        missed = sum(name in one.missed for one, name in these)
        kept = sum(name in one.found & one.untold for one, name in these)
        if these:
            groups.append((low, high, found, missed, kept, len(these) - found - missed - kept))
    return groups


def _by_strength(outcomes: Sequence[Outcome], note: str) -> list[str]:
    """How verdicts on effects that are there go with their strength."""
    rows = []
    for low, high, *counts in groups_by_strength(outcomes):
        shares = (f"{100 * count / sum(counts):.0f}" for count in counts)
        rows.append((_between(low, high), sum(counts), *shares))
    head = ("strength", "effects", "found %", "missed %", "undecided, simulated %", "undecided, left out %")
    return ["", note, "", *markdown_table(head, rows)] if rows else []


def _between(low: float, high: float) -> str:
    return f"{low:g} to {high:g}" if math.isfinite(high) else f"{low:g} and more"


def picture(outcomes: Sequence[Outcome]) -> Figure | None:
    """How verdicts on effects that are there go with their strength; None where no strength is known."""
    groups = groups_by_strength(outcomes)
    if not groups:
        return None
    figure = Figure(figsize=(7.2, 3.2), layout="constrained")
    axis, below = figure.subplots(), [0.0] * len(groups)
    kinds = {"found": "C2", "missed": "C3", "undecided, simulated": "0.6", "undecided, left out": "0.85"}
    for column, (name, color) in enumerate(kinds.items(), start=2):
        shares = [100.0 * group[column] / sum(group[2:]) for group in groups]
        axis.bar(range(len(groups)), shares, bottom=below, color=color, label=name)
        below = [low + share for low, share in zip(below, shares, strict=True)]
    labels = [f"{_between(low, high)}\n({sum(counts)} effects)" for low, high, *counts in groups]
    axis.set_xticks(range(len(groups)), labels, fontsize=8)
    axis.set_xlabel("strength, in standard deviations of the noise of a pixel")
    axis.set_ylabel("% of the effects that are there")
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _shares(outcomes: Sequence[Outcome]) -> tuple[str, str, str]:
    """Of the verdicts, how many hundredths are right, cannot be told, and are wrong."""
    cases = len(outcomes) * len(CATALOGUE)
    untold, wrong = (sum(count) for count in zip(*((len(one.untold), one.wrong) for one in outcomes), strict=True))
    return tuple(f"{100 * count / cases:.1f}" for count in (cases - untold - wrong, untold, wrong))


def _by_effect(title: str, outcomes: Sequence[Outcome], goal: str = "") -> list[str]:
    """How verdicts and truth agree in words, of which the last are the ``goal``, and a table by effect."""
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
        "effect", "present: found", "present: missed", "present: cannot be told", "absent: left out", "absent: wrongly found",
        "absent: cannot be told",
    )  # fmt: skip
    return [
        f"\n## {title}\n",
        f"Of {len(outcomes) * len(CATALOGUE)} verdicts {right} % are right, {untold} % cannot be told, {wrong} % are "
        f"wrong ({len(sought)} verdicts concern effects whose metadata are present). {clean} of {len(outcomes)} scenes have no "
        f"wrong verdict. A scene's verdicts took {seconds:.1f} s of processor time (median).\n",
        *([goal] if goal else []),
        *markdown_table(head, rows),
        "",
    ]


def _counted(names: Sequence[str]) -> str:
    return ", ".join(f"{name} ({names.count(name)})" for name in sorted(set(names)))
