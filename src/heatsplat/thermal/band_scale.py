"""What black bodies send in the camera's band over the image values at which it shows them, as one cheap curve."""

from __future__ import annotations

import numpy as np
import torch
from numpy.polynomial import chebyshev
from torch import Tensor, nn

from heatsplat.contracts import SceneData, SceneError
from heatsplat.physics.planck import Band
from heatsplat.physics.units import celsius, kelvin

DEGREE = 12  # of the two polynomials; over ranges of up to 600 K neither errs by more than 2e-8
COLDEST_K = 150.0  # no margin reaches below: colder bodies send nothing that a camera sees


class BandScale(nn.Module):
    """Between image values v and roots r = (B(T) / B(T_white))^(1/4) of the radiance B of black bodies in a band.

    Radiance is what adds up where a surface emits and mirrors. Its fourth root is all but a straight line over the
    temperature, so that one polynomial each way holds Planck's law and its inverse.

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
            SceneError: the scene does not say which temperatures its image values are.
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
        dense = np.linspace(low, high, 400)
        self.roots.copy_(torch.from_numpy(root(np.array([low, high]))))
        of_values = chebyshev.Chebyshev.interpolate(root, DEGREE, [low, high])
        of_roots = chebyshev.Chebyshev.fit(root(dense), dense, DEGREE, self.roots.tolist())
        for buffer, fitted in ((self.of_values, of_values), (self.of_roots, of_roots)):
            buffer.copy_(torch.from_numpy(chebyshev.cheb2poly(fitted.coef)))

    def within(self, values: Tensor) -> Tensor:
        """Image values moved into the range of the curves; what was moved still learns, so that it comes back."""
        return values + (values.detach().clamp(*self.values.tolist()) - values.detach())

    def root_of(self, values: Tensor) -> Tensor:
        """r of image values, of any shape."""
        return _polynomial(self.of_values, values, self.values)

    def value_of(self, roots: Tensor) -> Tensor:
        """The image values of roots, of any shape."""
        return _polynomial(self.of_roots, roots, self.roots)


def _polynomial(coefficients: Tensor, at: Tensor, domain: Tensor) -> Tensor:
    low, high = domain.tolist()
    x = (at - low) * (2.0 / (high - low)) - 1.0
    *rest, last = coefficients.tolist()
    result = torch.full_like(x, last)
    for coefficient in reversed(rest):
        result = result * x + coefficient
    return result
