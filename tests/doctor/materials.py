"""Recordings for the doctor to look at."""

from dataclasses import replace
from functools import cache

import torch

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.doctor.base import Finding, Material, material_of
from heatsplat.doctor.examination import CHECKS, examine


@cache
def clean(scene: str = "static", size: str = "tiny") -> Material:
    """A synthetic recording with nothing wrong; made once."""
    return material_of(Synthetic(scene=scene, size=size).scene)


def changed(material: Material, images: torch.Tensor, **others) -> Material:
    """The material with other images."""
    return replace(material, images=images, **others)


def checks(material: Material, only: str | None = None) -> list[str]:
    """Names of the checks that find something; ``only`` one of the examination's checks is asked, or all."""
    findings = examine(material) if only is None else findings_of(material, only)
    return [finding.check for finding in findings]


def findings_of(material: Material, name: str) -> list[Finding]:
    """What the check of this name finds, of those that an examination goes through."""
    (check,) = (one for one in CHECKS if one.name == name)
    return check.find(material)
