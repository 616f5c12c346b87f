"""docs/stability.md says what the code does, and ours keeps its promises."""

from pathlib import Path

import pytest
import torch

from benchmarks.stability.study import COLUMNS, FAMILIES, cases, cell, holds, measurements, numbers_of, run, written
from heatsplat.contracts import SceneError

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "stability.md"


@pytest.fixture(scope="module")
def rows():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield measurements()
    torch.set_num_threads(threads)


def test_the_document_is_what_would_be_written_now(rows):
    committed = DOCUMENT.read_text(encoding="utf-8")
    found = written(rows, committed)
    changed = [pair for pair in zip(committed.splitlines(), found.splitlines(), strict=False) if pair[0] != pair[1]]
    assert found == committed, f"run make stability and look at what changed: {changed[:3]}"


@pytest.mark.parametrize("family", FAMILIES)
def test_ours_errs_by_no_more_than_promised(rows, family):
    for name, case, forms in rows:
        for (kind, dtype), error in forms["ours"].items() if name == family else ():
            if error is not None:
                assert error <= case.promise * torch.finfo(getattr(torch, dtype)).eps, (case.name, kind, dtype)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_printed_form_is_worse_in_every_case(rows, family):
    """Otherwise the case is not hard, and its line in the table shows nothing."""
    for name, case, forms in rows:
        if name == family:
            ratios = [forms["printed"][c] / forms["ours"][c] for c in COLUMNS if forms["ours"][c]]
            assert max(ratios) > 10, case.name


def test_a_word_is_a_list_of_one_and_a_family_that_there_is_not_is_named(tmp_path):
    assert run(tmp_path, families="sensing").count("\n## ") == 1
    with pytest.raises(SceneError, match="each of study.families must be one of closed_form, .*got 'nope'"):
        run(tmp_path, families=["nope"])


def test_names_of_cases_are_unique():
    names = [case.name for family in FAMILIES for case in cases(family)]
    assert len(names) == len(set(names))


def test_errors_are_rounded_up_and_hold_within_a_factor_of_ten():
    assert [cell(e) for e in (1.01e-7, 9.99e-3, 6.1, float("inf"), 1e-17, None)] == [
        "2e-07", "1e-02", "7e+00", "∞", "< 1e-15", "",
    ]  # fmt: skip
    assert cell(3e-7, "2e-07") == "2e-07" and cell(3e-6, "2e-07") == "3e-06" and cell(1e-8, "2e-07") == "1e-08"
    assert not holds(1.0, "∞") and not holds(float("inf"), "7e+00") and not holds(1e-3, "") and not holds(None, "∞")
    assert holds(0.0, "< 1e-15") and not holds(2e-14, "< 1e-15")


def test_a_document_can_be_read_back(rows):
    text = written(rows)
    found = numbers_of(text)
    assert len(found) == 2 * len(rows)
    assert written(rows, text) == text
    first = rows[0][1].name
    worse = text.replace(found[first, "ours"][0], "9e+09", 1)
    assert numbers_of(worse)[first, "ours"][0] == "9e+09" and written(rows, worse) == text
