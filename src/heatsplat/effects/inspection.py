"""An inspection of a scene: what its training views show, and what all effects together make of it, each worked out once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from heatsplat.contracts import SceneData
from heatsplat.effects import heat_source, weather_record
from heatsplat.effects.base import Effect
from heatsplat.effects.beside_balances import beside_balances, beyond_balances
from heatsplat.effects.image_motion import Delays, delays
from heatsplat.effects.joint.certainty import Certainty
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.fit import Fit, fit_of
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.selection import selected
from heatsplat.effects.observations import Observations, observe
from heatsplat.effects.surface import normals
from heatsplat.effects.swept_points import with_swept_points
from heatsplat.effects.weathered import Weathered


class Inspection:
    """A scene, for the evidence of effects.

    Args:
        scene: seen through its training views only; of the others count the sizes. ``given`` is it, as training has it.
        effects: those that the joint fit may take in.
    """

    def __init__(self, scene: SceneData, effects: Sequence[Effect] = ()) -> None:
        self.given, self.effects = scene, effects

    @cached_property
    def scene(self) -> SceneData:
        """The scene, in which random points give way to those that its images show (``swept_points``)."""
        return with_swept_points(self.given)

    @property
    def blind(self) -> bool:
        """Whether the scene's points were random and its images show no others."""
        return "points_random" in self.given.notes and len(self.scene.points) == 0

    @cached_property
    def obs(self) -> Observations:
        """What the training views show."""
        return observe(self.scene)

    @cached_property
    def joint(self) -> tuple[Fit, Model] | None:
        """The joint fit and the model that it selects, beside full balances of heat where points follow these; None where there
        are no tracks."""
        by_record, weathered = self._by_record, self._weathered_by_record
        if weathered is None:
            return by_record
        return beside_balances(by_record[0], weathered.likeliest, self.scene.thermal_range.span_k) or by_record

    @cached_property
    def _by_record(self) -> tuple[Fit, Model] | None:
        """The joint fit, to which a weather record says roughly how surfaces change, and the model that it selects."""
        obs = self.obs
        if obs.tracks is None:
            return None
        terms = {effect.name: effect for effect in self.effects if effect.term is not None}
        drivers = weather_record.drivers(self.scene.weather, obs.times_s)
        tracks = obs.tracks if self.delays is None else self.delays.undone(obs)
        fit = fit_of(Data(terms, tracks, obs.times_s, obs.ambient, obs.noise, normals(obs), drivers))
        return selected(fit) if fit.observations > 0 else None

    @cached_property
    def certainty(self) -> Certainty | None:
        """What can be told from the joint fit; None where there is none."""
        if self.joint is None:
            return None
        if self.joint is self._by_record and self._weathered_by_record is not None:
            return self._certainty_by_record
        return Certainty(*self.joint, {} if self.beside_source is None else self.beside_source.told)

    @cached_property
    def heat_source(self) -> heat_source.Source | None:
        """What drives the scene; None where its points depart from no relaxation."""
        count = None if self.joint is None else self.joint[1].kind(heat_source.NAME)
        return None if count is None else heat_source.source(self, count)

    @cached_property
    def beside_source(self) -> heat_source.Known | None:
        """What images show beside the one source that all points answer; None where there is no such source, where a weather
        record says more, and where the camera stands still."""
        source = self.heat_source
        alone = source is not None and source.common and not weather_record.drives(self.scene.weather)
        alone = alone and self.joint[0].data.moves
        return heat_source.beside(self, source.course) if alone else None

    @cached_property
    def for_patterns(self) -> Certainty | None:
        """What can be told of places in the image: beside the one source that all points answer, where there is one and images
        are clearly uneven beside it; else from the joint fit. None where there is none."""
        known = self.beside_source
        return known.certainty if known is not None and known.uneven else self.certainty

    @cached_property
    def weathered(self) -> Weathered | None:
        """The tracks, without what the camera adds, under the weather record; None without either, or air temperature."""
        if self.joint is self._by_record:
            return self._weathered_by_record
        return self._weathered(*self.joint, self.certainty)

    @cached_property
    def _weathered_by_record(self) -> Weathered | None:
        """The same, by what a record says roughly."""
        weather = self.scene.weather
        known = weather is not None and weather.air_c is not None and self.scene.thermal_range is not None
        if not known or self.obs.times_s is None or self._by_record is None:
            return None
        return self._weathered(*self._by_record, self._certainty_by_record)

    @cached_property
    def _certainty_by_record(self) -> Certainty:
        return Certainty(*self._by_record)

    def _weathered(self, fit: Fit, model: Model, certainty: Certainty) -> Weathered:
        """The tracks without what the camera adds by a joint fit, under the weather record."""
        weather, bounds = self.scene.weather, self.scene.thermal_range
        certain = {name: added for name, added in fit.contributions(model).items() if name not in certainty.doubts}
        added = sum(certain.values())
        if "fixed_pattern" in certain:
            added = added - added[fit.weights > 0].mean()  # nobody knows the level of a pattern
        if certain and fit.data.balances is not None:
            added = beyond_balances(fit, model, added)
        values = fit.data.tracks.values - added
        return Weathered(
            weather,
            self.obs.times_s,
            bounds.to_celsius(values),
            bounds.span_k * fit.errors,
            fit.weights,
            fit.data.normals,
            fit.data.tracks,
            self.scene.points.double(),
        )

    @cached_property
    def delays(self) -> Delays | None:
        """By how long images are late as they move; None where nothing tells."""
        return delays(self.obs)
