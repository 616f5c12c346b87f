"""A sweep that fills a published table."""

from pathlib import Path

import pytest
from test_reproduction import put, reproduced

from heatsplat.contracts import SceneError
from heatsplat.studies.published.table import Table


def test_runs_on_all_other_scenes_come_first_and_once_each(tmp_path):
    plan = Table(reproduced("thermogs_2", put(tmp_path, "meta.json", "S1", "S2", "S3", "S4")))
    asked = []

    def folder_of(number, job):
        asked.append(job)
        return Path("/sweep") / str(number)

    jobs, first = plan.jobs([["seed=0"], ["seed=1"]], folder_of)
    assert first == len(asked) == 2 * 4 and len(jobs) == first + 2 * 12
    assert jobs[:first] == [list(job) for job in asked]
    after = [text for job in jobs[first:] for text in job if text.startswith("table.after=")]
    assert after == [f"table.after='/sweep/{number}/checkpoints/last.ckpt'" for number in range(8)]


def test_a_table_without_scenes_is_refused_and_a_dry_one_tells_only(tmp_path):
    with pytest.raises(SceneError, match="Missing: 10 scenes"):
        Table(reproduced("etgs_1", tmp_path / "none"))
    dry = Table(reproduced("etgs_1", put(tmp_path, "sparse", "cooling_bench")), dry=True)
    assert dry.idle and "3 runs" in dry.summary() and dry.write(tmp_path / "sweep") == []
    assert Table(reproduced("etgs_5")).idle  # a table of facts
