"""Values that kernels are compiled for: they are numbers there, and what other values would do is not there at all."""

from dataclasses import dataclass

import numpy as np
import pytest
from numba.core.errors import TypingError

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.compile_time import compile_time, constant


@compile_time
@dataclass(frozen=True)
class Which:
    doubled: bool
    offset: int

    @property
    def twice(self) -> int:
        return 2 * self.offset


doubled, offset, twice = constant("doubled"), constant("offset"), constant("twice")


@inline
def added(which, x):
    if offset(which):
        return x + offset(which)
    return x + np.zeros(2).no_such_attribute


def changed(which, numbers):
    for k in range(numbers.shape[0]):
        if doubled(which) and offset(which):
            numbers[k] = 2.0 * added(which, numbers[k])
        elif offset(which):
            numbers[k] = added(which, numbers[k]) + twice(which)
        else:
            numbers[k].no_such_attribute()


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))


@pytest.mark.parametrize(("which", "expected"), [(Which(True, 3), [6.0, 8.0]), (Which(False, 3), [9.0, 10.0])])
def test_a_kernel_does_what_its_value_says(which, expected):
    numbers = np.arange(2.0)
    kernel(changed)(which, numbers)
    np.testing.assert_array_equal(numbers, expected)


def test_what_only_other_values_do_is_not_even_typed():
    """The last branch, and that of the function that it calls, make no sense: no other value is compiled."""
    compiled = kernel(changed)
    compiled(Which(False, 1), np.arange(2.0))
    with pytest.raises(TypingError, match="no_such_attribute"):
        compiled(Which(False, 0), np.arange(2.0))
    assert len(compiled.compiled.overloads) == 1


def test_values_that_are_equal_share_what_was_compiled():
    compiled = kernel(changed)
    for _ in range(2):
        compiled(Which(True, 1), np.arange(2.0))
    compiled(Which(True, 2), np.arange(2.0))
    assert len(compiled.compiled.overloads) == 2
