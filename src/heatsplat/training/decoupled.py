"""Opacities and sizes that decay beside Adam, not through it: the attribute regularisation of AdamW-GS."""

from __future__ import annotations

import torch

from heatsplat.same_bits import sigmoid


class DecoupledDecay:
    """Makes Gaussians fainter and smaller after the optimiser's step, the more the less the image asks of them.

    A raw value falls by its learning rate times min(rate · slope / (P (√v + eps)), clip): slope is that of the opacity or
    of the semi-axis by its raw value, P the pixels of the image over whose mean the loss is taken, and v Adam's second
    moment, of the loss alone, without bias. Adam's moments do not see it. Only Gaussians decay that have a gradient in this
    step; of frozen tensors none.

    Args:
        opacity: rate of opacities. 0: they do not decay.
        size: rate of semi-axes, per extent of the scene. 0: they do not decay.
        clip: of one step, in learning rates.
        opacity_start, size_start, stop: first steps with decay, and the step from which on there is none.

    Source: A Step to Decouple Optimization in 3DGS (ICLR 2026), decoupled attribute regularisation; its sparse Adam and its
    rescaling of moments are not here.
    """

    def __init__(
        self,
        opacity: float = 1e-3,
        size: float = 1e-5,
        clip: float = 10.0,
        opacity_start: int = 3000,
        size_start: int = 1000,
        stop: int = 15_000,
    ) -> None:
        if min(opacity, size) < 0 or clip <= 0:
            raise ValueError(
                f"optim.decoupled: opacity and size must not be negative and clip is positive, got {opacity}, {size}, {clip}"
            )
        if min(opacity_start, size_start, stop) < 0:
            raise ValueError(
                "optim.decoupled: opacity_start, size_start and stop are steps of 0 or more, "
                f"got {opacity_start}, {size_start} and {stop}"
            )
        self.opacity, self.size, self.clip = opacity, size, clip
        self.opacity_start, self.size_start, self.stop = opacity_start, size_start, stop

    @torch.no_grad()
    def __call__(self, optimizer: torch.optim.Optimizer, step: float, pixels: int, extent: float) -> None:
        """Lets the parameters of the groups "opacity_logits" and "log_scales" decay, in place.

        Args:
            optimizer: an Adam that has just stepped.
            step: training step, that of the plan where the end of the run was moved (``Schedule.planned``).
            pixels: number of pixels of the image.
            extent: length unit of the scene.
        """
        rates = {
            "opacity_logits": self.opacity if self.opacity_start <= step < self.stop else 0.0,
            "log_scales": self.size / extent if self.size_start <= step < self.stop else 0.0,
        }
        for group in optimizer.param_groups:
            rate = rates.get(group["name"], 0.0)
            (parameter, *_) = group["params"]
            moments = optimizer.state.get(parameter)
            if rate == 0.0 or parameter.grad is None or not moments:
                continue
            second = moments["exp_avg_sq"] / (1.0 - group["betas"][1] ** float(moments["step"]))
            slope = parameter.exp()
            if group["name"] == "opacity_logits":
                opacity = sigmoid(parameter)
                slope = opacity * (1.0 - opacity)
            fall = (rate / pixels * slope / (second.sqrt() + group["eps"])).clamp(max=self.clip)
            parameter -= group["lr"] * torch.where(parameter.grad != 0, fall, 0.0)
