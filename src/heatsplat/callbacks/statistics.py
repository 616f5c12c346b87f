"""How the splats and the loss terms are doing."""

from __future__ import annotations

from typing import Any

import pytorch_lightning as pl
import torch

from heatsplat.callbacks.board import add_scalars, board
from heatsplat.contracts import check_count

HISTOGRAM_ROWS = 20_000  # a histogram of more Gaussians looks the same and takes longer


class SplatStatistics(pl.Callback):
    """Hands loss terms and learning rates by group to the loggers; of the density the number of Gaussians, and those that each
    refinement added and removed. Less often, histograms to TensorBoard.

    Args:
        every: steps between entries.
        histogram_every: steps between histograms of sizes and opacities; 0 for none.
    """

    def __init__(self, every: int = 50, histogram_every: int = 1000) -> None:
        check_count("callbacks.statistics.every", every)
        check_count("callbacks.statistics.histogram_every", histogram_every, 0)
        self.every, self.histogram_every = every, histogram_every

    def on_train_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: dict[str, Any], *_: Any
    ) -> None:
        step = trainer.global_step
        if not module.loggers:
            return
        scalars: dict[str, float] = {}
        if module.density_change is not None:
            scalars["density/added"] = module.density_change.added
            scalars["density/removed"] = module.density_change.removed
        noted = step % self.every == 0 or step == 1
        if noted:
            scalars |= _losses_and_rates(trainer, outputs)
            scalars["density/count"] = len(module.splats)
        add_scalars(module, scalars, step)
        writer = board(module)
        wanted = noted and self.histogram_every and step % self.histogram_every == 0
        if writer is not None and wanted and len(module.splats):
            self._histograms(module, writer, step)

    @torch.no_grad()
    def _histograms(self, module: pl.LightningModule, writer: Any, step: int) -> None:
        """Histograms of sizes (logarithm to base ten of the semi-axes, world units) and opacities of a sample."""
        stride = max(1, len(module.splats) // HISTOGRAM_ROWS)
        writer.add_histogram("splats/log10_scale", module.splats.scales[::stride].log10(), step)
        for m, opacities in enumerate(module.splats.opacities):
            writer.add_histogram(f"splats/opacity_{m}", opacities[::stride], step)


def _losses_and_rates(trainer: pl.Trainer, outputs: dict[str, Any]) -> dict[str, float]:
    """Loss terms and learning rates by tag."""
    terms = {"total": outputs["loss"], **outputs.get("terms", {})}
    # One transfer for all terms: on a GPU each would wait for the queue.
    values = torch.stack([term.detach().reshape(()).float() for term in terms.values()]).tolist()
    found = {f"loss/{name}": value for name, value in zip(terms, values, strict=True)}
    for number, group in enumerate(trainer.optimizers[0].param_groups):
        found[f"learning_rate/{group.get('name', number)}"] = group["lr"]
        if group.get("weight_decay"):  # penalties are applied inside the optimiser and so are in no loss term
            squares = sum(parameter.detach().square().sum() for parameter in group["params"])
            found[f"loss/penalty/{group['name']}"] = 0.5 * group["weight_decay"] * squares.item()
        if group.get("group_penalty"):
            norms = sum(parameter.detach().flatten(0, -2).norm(dim=0).sum() for parameter in group["params"])
            found[f"loss/penalty/{group['name']}"] = group["group_penalty"] * norms.item()
    return found
