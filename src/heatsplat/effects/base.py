"""Physical effects: what each is, what speaks for it in a scene, what simulates it, and the verdict on it.

Each effect is one file in ``heatsplat.effects.physical``; ``heatsplat.effects.catalogue`` lists them. ``decide`` there
looks at a scene and returns a verdict on each; ``heatsplat.effects.assembly`` turns verdicts into a configuration that
simulates exactly what is on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from heatsplat.contracts import SceneData

if TYPE_CHECKING:
    from heatsplat.effects.inspection import Inspection
    from heatsplat.effects.joint.terms import Term

STAGES = ("state", "emission", "path", "visibility", "sensor")  # in the order in which heat meets them
CHOICES = ("on", "off", "auto")
# Where a part stands in a configuration -> where its settings stand in the group "effects" of a configuration.
SLOTS = {
    "state": ("states",),  # the last one that is called for
    "around_state": ("states",),  # takes the state as its own "state"
    "path": ("parts",),  # after the state, one after the other
    "companion": (),
    "camera": ("sensor", "parts"),  # one after the other
    "grid": ("grid",),  # around every term of the loss
}


@dataclass(frozen=True)
class Evidence:
    """What the data say about an effect.

    Args:
        statistic: a number that stays below the effect's threshold under the null hypothesis; 0 where what was found is too
            small or belongs to another effect, as the reason says; None where the data cannot say anything (metadata that
            is missing, no time, one modality).
        reason: the sentence behind it, with the figures in their units.
        settings: what the effect should start from or be limited to, such as {"frequencies": 8}.
        told: False where the data do not say whether the effect is there; the reason says what would be needed.
        gain_db: what the effect gains on observations that it was not fitted to, in decibels of their squared error.
        likely: whether it is simulated although that cannot be told, because it is there more often than not.
    """

    statistic: float | None
    reason: str
    settings: dict[str, Any] = field(default_factory=dict)
    told: bool = True
    gain_db: float | None = None
    likely: bool = False


@dataclass(frozen=True)
class Part:
    """What simulates an effect.

    Args:
        slot: where it stands in a configuration, one of SLOTS.
        name: of its settings in conf/effects/shared/parts.yaml. Effects may share a part.
        off: settings that leave this effect out where another one calls for the part.
        choice: key of the group "effects", and of the evidence's settings, that says which of ``kinds`` simulates it; empty
            where there is one.
        kinds: value of that key -> name.
    """

    slot: str
    name: str
    off: Mapping[str, Any] = field(default_factory=dict)
    choice: str = ""
    kinds: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Effect:
    """A physical effect.

    Args:
        name: in config, metrics.json and docs.
        stage: where on the way from heat to pixel it acts, one of STAGES.
        place: its order within the stage: heat meets the lower ones first.
        summary: what it is, in a sentence.
        source: paper and equation.
        needs: metadata without which it cannot be simulated (SceneData.metadata's vocabulary); it is off without them.
        null: the null hypothesis that its evidence tests.
        threshold: it is on where the statistic exceeds this. In each file stands what the statistic is on synthetic recordings
            (18 scenes: five recordings of size tiny of each, and six scenes of size demo) without the effect and with it.
        adds: what it adds to a run: parameters and operations, in a sentence.
        evidence: what the training data of a scene say about it.
        part: what simulates it.
        term: what it is in the joint fit, None where it has no part in that.
        stands_on: name of the effect that it cannot do without.
        displaces: effects that cannot be had beside it, with the reason.
        missing: what a scene lacks, beyond metadata, to simulate it; None where it lacks nothing.
    """

    name: str
    stage: str
    place: int
    summary: str
    source: str
    needs: frozenset[str] = frozenset()
    null: str
    threshold: float
    adds: str
    evidence: Callable[[Inspection], Evidence]
    part: Part
    term: Term | None = None
    stands_on: str | None = None
    displaces: Mapping[str, str] = field(default_factory=dict)
    missing: Callable[[SceneData], str | None] = lambda scene: None


@dataclass(frozen=True)
class Verdict:
    """Whether an effect is simulated, and why; this is what metrics.json holds under effects.<name>.

    Args:
        name: of the effect.
        on: whether it is simulated.
        statistic, threshold: of its evidence; None where it was forced or nothing could be measured.
        reason: in a sentence.
        settings: what it starts from, handed to the configuration.
        told: False where the data do not say whether it is there; it is then simulated only as the best explanation of the
            images that there is, or where it is likely (``Evidence``).
        gain_db: on observations that it was not fitted to (``Evidence``).
    """

    name: str
    on: bool
    statistic: float | None
    threshold: float | None
    reason: str
    settings: dict[str, Any] = field(default_factory=dict)
    told: bool = True
    gain_db: float | None = None
