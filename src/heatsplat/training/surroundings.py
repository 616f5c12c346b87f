"""What Gaussians are told of the scene around them, for models that ask: which way they face, what hides sun and sky."""

from __future__ import annotations

import torch

from heatsplat.contracts import SceneData
from heatsplat.renderers.settings import Renderer
from heatsplat.splats import Splats
from heatsplat.thermal.base import NORMALS, SKY_SEEN, SUN_SEEN
from heatsplat.training.exposure import Exposure
from heatsplat.training.normals import Normals, Show


class Surroundings:
    """Fills those tensors of the splats that are looked up in the scene and not trained, as far as a model declares them.

    Between two looks they stand still, and new Gaussians inherit them.

    Args:
        normals: where NORMALS come from; None: as before training, throughout.
        exposure: where SUN_SEEN and SKY_SEEN come from; None: what was seen before training, throughout.
    """

    def __init__(self, normals: Normals | None = None, exposure: Exposure | None = None) -> None:
        self.normals, self.exposure = normals or Normals(), exposure or Exposure()

    @torch.no_grad()
    def prepare(self, scene: SceneData, renderer: Renderer, splats: Splats, show: Show) -> None:
        """Looks at the scene's points, then at the splats as ``show`` renders them (``SceneModel.composited``)."""
        if NORMALS in splats:
            splats[NORMALS].copy_(self.normals.prepare(scene, renderer, splats.means.detach()))
            self._face(splats, show)
        if exposed := [name for name in (SUN_SEEN, SKY_SEEN) if name in splats]:
            self.exposure.prepare(scene, renderer, self.normals.discs, exposed)
            self._expose(splats)

    @torch.no_grad()
    def after_step(self, step: int, splats: Splats, show: Show) -> None:
        """Looks again where that is due before the step that follows ``step``."""
        if NORMALS in splats and step + 1 in self.normals.refresh:
            self._face(splats, show)
        if step + 1 in self.exposure.refresh:
            self._expose(splats)

    def _face(self, splats: Splats, show: Show) -> None:
        splats[NORMALS].copy_(self.normals.look(show, splats[NORMALS].detach()))

    def _expose(self, splats: Splats) -> None:
        for name, shares in self.exposure.look(splats.means.detach()).items():
            splats[name].copy_(shares)
