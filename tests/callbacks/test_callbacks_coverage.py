"""The scores that callbacks=uncertainty adds."""

from types import SimpleNamespace

import pytest

from heatsplat.callbacks import coverage
from heatsplat.io.results import RunResults


@pytest.mark.parametrize("bounds", [None, (0.0, 10.0)])
def test_coverage_and_width_are_scores_with_a_definition(monkeypatch, bounds):
    told = SimpleNamespace(coverage=lambda: 0.7, usual=0.2)
    monkeypatch.setattr(coverage, "Uncertainty", lambda module: told)
    results = RunResults()
    module = SimpleNamespace(results=results, modality="thermal", scene=SimpleNamespace(range_of=lambda _: bounds))
    coverage.Coverage().on_test_epoch_end(None, module)
    assert results.test == {"coverage_68": 0.7, "deviation_c": None if bounds is None else 0.2}
    assert set(results.definitions) == {"coverage_68", "deviation_c"}
    assert ("test.deviation_c" in results.reasons) == (bounds is None)
