"""Some hundred damaged checkpoints, splats and results; ``make fuzz`` tries thousands."""

import files
import pytest


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    root = tmp_path_factory.mktemp("whole")
    files.write_templates(root)
    return root


@pytest.mark.parametrize("kind", files.KINDS)
def test_damaged_files_load_sanely_or_are_refused_by_name(whole, kind, tmp_path):
    outcomes = files.fuzzed(kind, whole, tmp_path / "copy", range(25 if kind == "content_of_checkpoint" else 100))
    assert [outcome for outcome in outcomes if outcome.failed] == []
    if kind != "folder_of_run":
        assert {outcome.kind for outcome in outcomes} == {"loads", "refused"}
