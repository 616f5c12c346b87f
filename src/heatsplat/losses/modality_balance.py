"""Weights by how the Gaussians are shared out among modalities that have Gaussians of their own (ThermalGaussian)."""

from __future__ import annotations

from torch import Tensor

from heatsplat.losses.compose import LossInputs, LossTerm, Weighted, scaled


class ByOthersShare(Weighted):
    """A term times a weight times the share of Gaussians that belong to the other modalities (MSMG).

    The modality with more Gaussians weighs less; with it shrink the screen gradients by which ``density=adaptive`` adds
    Gaussians. Where those do not count, Adam undoes the weight. A Gaussian belongs to the modality in which it is most opaque.

    Args:
        term: what is weighted.
        opacity: column of the opacities that the modality has, counted as the model's images are: 0 is its own.
        weight: factor; at zero the term is neither prepared nor evaluated.
    """

    def __init__(self, term: LossTerm, opacity: int, weight: float = 1.0) -> None:
        super().__init__(term, weight)
        self.opacity = opacity

    def __call__(self, inputs: LossInputs) -> dict[str, Tensor]:
        logits = inputs.splats["opacity_logits"].detach()
        if not self.opacity < logits.shape[1] > 1:
            raise ValueError(
                f"a loss term is weighted by the Gaussians that have opacity {self.opacity}, but Gaussians have "
                f"{logits.shape[1]}; give the thermal model opacities of its own for each image "
                "(thermal.shared_opacity=false) and init=separate"
            )
        if self.weight == 0.0:
            return {}
        others = (logits.argmax(dim=1) != self.opacity).float().mean()
        return scaled(self.term, inputs, self.weight * others)
