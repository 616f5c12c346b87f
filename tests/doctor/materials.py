"""Recordings for the doctor to look at."""

from dataclasses import replace
from functools import cache

import torch

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.doctor.base import Material, material_of
from heatsplat.doctor.examination import examine


@cache
def clean(scene: str = "static", size: str = "tiny") -> Material:
    """A synthetic recording with nothing wrong; made once."""
    return material_of(Synthetic(scene=scene, size=size).scene)


def changed(material: Material, images: torch.Tensor, **others) -> Material:
    """The material with other images."""
    return replace(material, images=images, **others)


def checks(material: Material) -> list[str]:
    """Names of the checks that find something."""
    return [finding.check for finding in examine(material)]
