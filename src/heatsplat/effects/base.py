"""Physical effects: what each is, what speaks for it in a scene, and the verdict on it.

The catalogue (``heatsplat.effects.catalogue``) has one entry per effect. ``decide`` there looks at a scene and returns a
verdict on each; ``heatsplat.effects.assembly`` turns verdicts into a recipe that simulates exactly what is on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

STAGES = ("state", "emission", "path", "visibility", "sensor")
WISHES = ("on", "off", "auto")


@dataclass(frozen=True)
class Evidence:
    """What the data say about an effect.

    Args:
        statistic: a number that stays below the effect's threshold under the null hypothesis; 0 where what was found is too
            small or belongs to another effect, as the reason says; None where the data cannot say anything (metadata that
            is missing, no time, one modality).
        reason: the sentence behind it, with the figures in their units.
        settings: what the effect should start from or be limited to, such as {"frequencies": 8}.
    """

    statistic: float | None
    reason: str
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue.

    Args:
        name: in config, metrics.json and docs.
        stage: where on the way from heat to pixel it acts, one of STAGES.
        summary: what it is, in a sentence.
        source: paper and equation.
        needs: metadata without which it cannot be simulated (SceneData.metadata's vocabulary); it is off without them.
        null: the null hypothesis that its evidence tests.
        threshold: it is on where the statistic exceeds this.
        adds: what it adds to a recipe: parameters and operations, in a sentence.
        evidence: function (Observations) -> Evidence, cheap, on training data alone.
    """

    name: str
    stage: str
    summary: str
    source: str
    needs: frozenset[str]
    null: str
    threshold: float
    adds: str
    evidence: Callable[[Any], Evidence]


@dataclass(frozen=True)
class Verdict:
    """Whether an effect is simulated, and why; this is what metrics.json holds under effects.<name>.

    Args:
        name: of the effect.
        on: whether it is simulated.
        statistic, threshold: of its evidence; None where it was forced or nothing could be measured.
        reason: in a sentence.
        settings: what it starts from, handed to the recipe.
    """

    name: str
    on: bool
    statistic: float | None
    threshold: float | None
    reason: str
    settings: dict[str, Any] = field(default_factory=dict)
