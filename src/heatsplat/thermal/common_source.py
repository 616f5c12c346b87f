"""One heat source for a whole scene: its course over time is shared, and every Gaussian answers it in a few modes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import Course, SceneData
from heatsplat.physics.common_course import MOMENTS, RATES, response_table
from heatsplat.physics.curves import resampled_values
from heatsplat.physics.first_look import first_numbers
from heatsplat.physics.responses import MOMENTS_KEPT
from heatsplat.same_bits import everywhere, weighted
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Query, Rate, Seeds
from heatsplat.thermal.relaxing import Relaxing

LEAST = (
    1e-3  # root mean square of a mode's course over the training images, of the largest: what is less is not told there
)


class CommonSource(Relaxing):
    """T(t) = T_ambient + Σ_j h_j e^{-r_j t} + g_j r_j ∫ e^{-r_j (t-τ)} s(τ) dτ: relaxation, and one source s(t) (ours).

    ETGS gives every Gaussian K harmonics of its own, which know nothing of each other. What is switched on and off once
    for all leaves each Gaussian a few numbers, and one course for the scene that all images tell, in gaps of the record
    and between images, too. s is linear between moments; a sum of rates r_j follows walls with a depth
    (``physics.common_course``). A view takes one product of 2 R numbers for each Gaussian.

    Learned are not h and g, which are strongly correlated, but numbers of modes whose courses over the training images are
    uncorrelated and have a root mean square of 1.

    **Convention:** time in spans of the record, temperatures in image units (``Relaxing``). After the record the source is
    off; before it there is none, and one time constant of the quickest rate is extrapolated at most.

    Tensors: "modes" [N, 2 R].

    Args:
        rates: r_j per span, positive.
        moments: K of s over the record.
        course: s before training, resampled to the moments; None is a source that is always on.
        smooth: weight of the penalty on the mean squared second derivative of s.
        lr_modes, lr_course: learning rates.
        ambient, clip, lr_ambient, lr_end: as in ``Relaxing``; lr_end holds for all.

    Raises:
        ValueError: an option is out of its range.
    """

    beyond_record = "the heat source is off, and every Gaussian relaxes to the ambient temperature"

    def __init__(
        self,
        rates: Sequence[float] = RATES,
        moments: int = MOMENTS,
        course: Sequence[float] | None = None,
        smooth: float = 1e-10,
        lr_modes: float = 1e-4,
        lr_course: float = 5e-4,
        ambient: str | float = "measured",
        clip: str = "straight_through",
        lr_ambient: float = 1e-3,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__(ambient, clip, lr_ambient, lr_end)
        if min(rates, default=0.0) <= 0 or moments < 3 or smooth < 0:
            raise ValueError(
                f"rates must be positive, moments at least 3 and smooth not negative, got {list(rates)}, {moments} and {smooth}"
            )
        self.moments, self.smooth, self.lr_modes, self.lr_course = moments, smooth, lr_modes, lr_course
        self.course = nn.Parameter(resampled_values([1.0] if course is None else course, moments))
        self.register_buffer("rates", torch.tensor(rates, dtype=torch.float64))
        self.register_buffer("mixing", torch.zeros(2 * len(rates), 2 * len(rates)))  # h and g of each mode, in rows
        self._table = response_table(self.rates, moments)
        self._answers: dict[float, tuple[Tensor, Tensor]] = {}

    @torch.no_grad()
    def prepare(self, scene: SceneData) -> None:
        super().prepare(scene)
        courses = torch.stack([self._courses(time_s) for time_s in scene.train.times_s]).double()
        squares, along = torch.linalg.eigh(courses.mT @ courses / len(courses))
        sizes = squares.clamp_min(0.0).sqrt()
        self.mixing.copy_((along / sizes.clamp_min(LEAST * sizes[-1])).mT.flip(0))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> CommonSource:
        self._answers.clear()  # they are of another type, or on another device
        return super()._apply(fn, recurse)

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        initial = seeds.values.mean(1)
        self.guess_ambient(initial)
        above = initial - self.ambient.detach()
        with torch.no_grad():
            if seeds.looks is None or seeds.looks_s is None:
                basis = self._modes_at(self.clock.first_s)[None]
                looks = above[:, None]
            else:
                basis = torch.stack([self._modes_at(time_s) for time_s in seeds.looks_s.tolist()])
                looks = seeds.looks.mean(2) - self.ambient.detach()
            modes = first_numbers(looks, basis, above)
        return {"modes": PerGaussian(modes, self.lr_modes, lr_end=self.lr_end)}

    def rate_of(self, name: str) -> Rate:
        return Rate(self.lr_course, self.lr_end) if name == "course" else super().rate_of(name)

    def _state(self, splats: Splats, time_s: float | None, ids: Tensor | None) -> Tensor:
        # Of all Gaussians, and then those in view: to pick rows and to spread their gradients takes twice as long.
        above = Query(ids).rows(weighted(splats["modes"], self._modes_at(time_s)))
        return everywhere(self.ambient, above) + above

    def _modes_at(self, time_s: float | None) -> Tensor:
        """Courses of the modes at a time, [2 R]."""
        return self.mixing @ self._courses(time_s)

    def _courses(self, time_s: float | None) -> Tensor:
        """e^{-r_j t}, and the answers of bodies of these rates to the source, at a time, [2 R]."""
        spans, within = self.clock.spans(time_s), self.clock.within(time_s)
        if spans not in self._answers:
            if len(self._answers) >= MOMENTS_KEPT:
                self._answers.clear()
            with torch.inference_mode(False), torch.no_grad():  # kept for those who differentiate, too
                rates = self.rates.cpu()
                faded = torch.exp(-rates * (spans - within))[:, None] if spans > within else 1.0
                began = max(spans, -1.0 / float(rates.max()))
                answers = torch.exp(-rates * began), faded * self._table.exact(within)
                self._answers[spans] = tuple(tensor.to(self.course) for tensor in answers)
        decays, answers = self._answers[spans]
        return torch.cat([decays, answers @ self.course])

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        if self.smooth == 0:
            return {}
        bends = self.course.diff(n=2) * (self.moments - 1) ** 2
        return {"course_smooth": self.smooth * bends.square().mean()}

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        """By how much the source at its strongest would warm what it shines on for ever, in °C, with a range of temperatures."""
        if self.range.bounds is None:
            return {}
        gains = self.mixing[:, len(self.rates) :].sum(1) * self.course.abs().max()
        return {"source_rise_c": self.range.bounds.span_k * (query.rows(splats["modes"]) @ gains)}

    def effects(self) -> dict[str, dict[str, Any]]:
        return {
            "relaxation": {"rates_per_span": self.rates.tolist(), "ambient": self.ambient_is},
            "harmonic_source": {"source": "common", "moments": self.moments},
        }

    def courses(self) -> list[Course]:
        power = self.course.detach() / self.course.detach().abs().max().clamp_min(1e-12)
        times = self.clock.first_s + self.clock.span_s * torch.linspace(0, 1, self.moments, dtype=torch.float64)
        return [Course("power of the heat source", times.tolist(), power.tolist(), "of its largest")]

    @property
    def cost(self) -> int:
        return self.mixing.shape[0]
