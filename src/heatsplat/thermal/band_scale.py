"""What black bodies send in the camera's band over the image values at which it shows them, as one cheap curve."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from numpy.polynomial import chebyshev
from torch import Tensor, nn

from heatsplat.contracts import SceneData, SceneError
from heatsplat.physics.planck import Band
from heatsplat.physics.units import celsius, kelvin

DEGREE = 12  # of a polynomial, where that is enough
MORE = (16, 20)  # degrees of polynomials of bent variables, where it is not
ERROR = 1e-7  # that a curve may be off, in image units
BEND = 8.0  # of values: cold ones are spread by it, where roots bend most
SAMPLES = 400  # that a curve is fitted to and checked at
COLDEST_K = 150.0  # no margin reaches below: colder bodies send nothing that a camera sees


class BandScale(nn.Module):
    """Between image values v and roots r = (B(T) / B(T_white))^(1/4) of the radiance B of black bodies in a band.

    Radiance is what adds up where a surface emits and mirrors. Its fourth root is all but a straight line over the
    temperature, so that one polynomial each way holds Planck's law and its inverse. Over wide ranges, and at short wavelengths,
    it bends where it is cold; there they are polynomials of asinh v and r^(1/4), of a higher degree. A curve has as many
    coefficients as its degree needs.

    **Convention:** from the values of the surroundings or black, whichever is lower, to those of the surroundings or white,
    and ``margin`` beyond, but not below ``COLDEST_K``.

    Args:
        shortest_um, longest_um: ends of the band in micrometres.
        margin: in image units.
    """

    def __init__(self, shortest_um: float = 7.5, longest_um: float = 14.0, margin: float = 0.0) -> None:
        super().__init__()
        self.band, self.margin = Band(shortest_um, longest_um), margin
        self.register_buffer("of_values", torch.zeros(DEGREE + 1, dtype=torch.float64))
        self.register_buffer("of_roots", torch.zeros(DEGREE + 1, dtype=torch.float64))
        self.register_buffer("values", torch.tensor([0.0, 1.0], dtype=torch.float64))
        self.register_buffer("roots", torch.tensor([0.0, 1.0], dtype=torch.float64))

    def prepare(self, scene: SceneData) -> None:
        """Fits both curves to a scene's range.

        Raises:
            SceneError: the scene does not say which temperatures its image values are, or no curve follows Planck's law over
                them.
        """
        if scene.thermal_range is None:
            raise SceneError(
                f"scene '{scene.name}' does not say which temperatures its image values are, so that they have no radiance: "
                "give the data set its thermal range, or choose thermal.law=grey"
            )
        ambient = 0.0 if scene.ambient_c is None else scene.thermal_range.to_unit(scene.ambient_c)
        coldest = scene.thermal_range.to_unit(celsius(COLDEST_K))
        low, high = min(0.0, ambient), max(1.0, ambient) + self.margin
        self.values.copy_(torch.tensor([min(low, max(low - self.margin, coldest)), high]))

        def root(values: np.ndarray) -> np.ndarray:
            at = kelvin(scene.thermal_range.to_celsius(torch.from_numpy(values)))
            return (self.band.radiance(at) / white).pow(0.25).numpy()

        white = self.band.radiance(kelvin(torch.tensor(scene.thermal_range.max_c, dtype=torch.float64)))
        low, high = self.values.tolist()
        values = low + (high - low) * 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, SAMPLES)))
        roots = root(values)
        self.roots.copy_(torch.from_numpy(roots[[0, -1]]))
        of_values = _fitted(values, roots, self._bent_values, ERROR * np.gradient(roots, values))
        of_roots = _fitted(roots, values, _bent_roots, ERROR)
        if of_values is None or of_roots is None:
            least, most = scene.thermal_range.to_celsius(self.values).tolist()
            raise SceneError(
                f"no polynomial of degree {MORE[-1]} follows Planck's law in the band of {self.band.shortest_um:g} to "
                f"{self.band.longest_um:g} µm from {least:.0f} to {most:.0f} °C, the range of scene '{scene.name}' with a "
                f"margin of {self.margin:g} of it: give the data set a warmer or narrower range, or the camera's own band"
            )
        self.of_values, self.of_roots = of_values.to(self.of_values), of_roots.to(self.of_roots)

    def within(self, values: Tensor) -> Tensor:
        """Image values moved into the range of the curves; what was moved still learns, so that it comes back."""
        return values + (values.detach().clamp(*self.values.tolist()) - values.detach())

    def root_of(self, values: Tensor) -> Tensor:
        """r of image values, of any shape."""
        return _polynomial(self.of_values, values, self.values, self._bent_values)

    def radiance_of(self, values: Tensor) -> Tensor:
        """r⁴, the radiance in the band of black bodies that look like ``values`` over that of white, of any shape."""
        return self.root_of(values).square().square()

    def value_of(self, roots: Tensor) -> Tensor:
        """The image values of roots, of any shape."""
        return _polynomial(self.of_roots, roots, self.roots, _bent_roots)

    def _bent_values(self, values: Tensor) -> Tensor:
        low, high = self.values.tolist()
        return torch.asinh((values - low) * (BEND / (high - low)))

    def _load_from_state_dict(self, state_dict: Mapping[str, Tensor], prefix: str, *rest) -> None:
        """Takes curves of the degree that they have in the checkpoint; what torch does follows."""
        for name in ("of_values", "of_roots"):
            shape = getattr(state_dict.get(prefix + name), "shape", None)
            if shape in [(degree + 1,) for degree in (DEGREE, *MORE)]:
                setattr(self, name, self.values.new_zeros(shape))
        super()._load_from_state_dict(state_dict, prefix, *rest)


def _bent_roots(roots: Tensor) -> Tensor:
    return roots.sqrt().sqrt()


def _fitted(
    at: np.ndarray, to: np.ndarray, bent: Callable[[Tensor], Tensor], error: np.ndarray | float
) -> Tensor | None:
    """Coefficients of the polynomial of the least degree that errs by no more than this; None where none does."""
    if not (np.diff([at, to]) > 0).all():  # radiances underflow
        return None
    for degree in (DEGREE, *MORE):
        x = at if degree == DEGREE else bent(torch.from_numpy(at)).numpy()
        fit = chebyshev.Chebyshev.fit(x, to, degree)
        if (np.abs(fit(x) - to) <= error).all():
            return torch.from_numpy(chebyshev.cheb2poly(fit.coef))
    return None


def _polynomial(coefficients: Tensor, at: Tensor, domain: Tensor, bent: Callable[[Tensor], Tensor]) -> Tensor:
    if len(coefficients) > DEGREE + 1:
        at, domain = bent(at), bent(domain)
    low, high = domain.tolist()
    x = (at - low) * (2.0 / (high - low)) - 1.0
    *rest, last = coefficients.tolist()
    result = torch.full_like(x, last)
    for coefficient in reversed(rest):
        result = result * x + coefficient
    return result
