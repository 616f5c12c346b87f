"""RaViGS's density control: a Gaussian stays only while every modality sees it."""

from __future__ import annotations

from torch import Tensor

from heatsplat.density.adaptive import Adaptive


class CoSupport(Adaptive):
    """Adaptive density control with co-support pruning (RaViGS, Eq. 11).

    It works as ever: gradients of all modalities reach the screen positions, and with them its statistic. But Gaussians are
    pruned whose opacity is below the threshold ``prune_opacity`` (τ) in some modality, not only those that no modality sees,
    so that the modalities cannot part into two clouds. A pane that is wholly clear in one band cannot be kept in this way
    (as the paper says); ``Adaptive`` keeps it.
    """

    def _visible(self, opacities: Tensor) -> Tensor:
        return (opacities > self.prune_opacity).all(dim=0)
