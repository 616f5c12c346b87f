"""What a function gives on several numbers of torch's threads."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch


def with_threads(numbers: Iterable[int], function: Callable[[], Any]) -> list[Any]:
    """What ``function`` gives with each of these numbers of threads."""
    before, found = torch.get_num_threads(), []
    try:
        for number in numbers:
            torch.set_num_threads(number)
            found.append(function())
    finally:
        torch.set_num_threads(before)
    return found
