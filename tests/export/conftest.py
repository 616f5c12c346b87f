"""One scene for the files of all formats."""

from dataclasses import replace

import pytest
import torch
from exported import at, started


@pytest.fixture(scope="package")
def cooling(tmp_path_factory):
    """Gaussians of a cooling scene at 600 s; one attribute, of which one value is not known."""
    module = started(tmp_path_factory.mktemp("cooling"), "method=etgs", "thermal.frequencies=2")
    moment = at(module, 600.0)
    known = torch.linspace(100.0, 900.0, len(moment.values))
    known[3] = torch.nan
    return replace(moment, seen=replace(moment.seen, attributes=moment.seen.attributes | {"time constant": known}))
