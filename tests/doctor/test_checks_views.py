"""Points that few views see are found."""

from dataclasses import replace

import torch
from materials import checks, clean


def test_points_that_few_views_see_are_found():
    far = torch.cat([clean().points, clean().points + torch.tensor([50.0, 0.0, 0.0])])
    assert "views" in checks(replace(clean(), points=far))
