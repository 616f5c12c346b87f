"""What --help says, of folders of configurations that are a command's own and of further ones."""

import re

import pytest

from heatsplat.composition import options_of
from heatsplat.usage import usage

DOC = "Does something. At length.\nAnd more."


@pytest.mark.parametrize("given", [["--config-dir={}"], ["--config-dir", "{}"], ["-cd", "{}", "method=3dgs"]])
def test_methods_and_models_of_a_further_folder_are_among_the_choices(tmp_path, given):
    for group, head in (
        ("method", "# @package _global_\n# Mine (2027): drifts. More of it.\n"),
        ("thermal", "# Drift\n"),
    ):
        (tmp_path / group).mkdir()
        (tmp_path / group / "my_drift.yaml").write_text(f"{head}a: 1\n")
    text = usage("train", DOC, [argument.format(tmp_path) for argument in given])
    assert re.search(r"^  my_drift +Mine \(2027\): drifts$", text, re.MULTILINE)
    assert re.search(r"^  thermal: .*\bmy_drift\b", text, re.MULTILINE | re.DOTALL)
    assert "my_drift" not in usage("train", DOC, ["method=3dgs"])


def test_the_first_line_of_the_job_is_followed_by_settings_and_every_choice_is_there():
    text = usage("train", DOC)
    assert text.startswith("Does something. At length.\n\n# python src/train.py") and "And more" not in text
    for group in ("method", "data", "preset"):
        told = re.search(rf"^{group}:\n((?:  .+\n)+)", text, re.MULTILINE)[1]
        assert re.findall(r"^  (\S+)", told, re.MULTILINE) == options_of(group)
    assert max(map(len, text[text.index("Choices of the other groups") :].splitlines())) <= 130


def test_every_format_of_an_export_is_explained():
    assert re.findall(r"^what:  # with what=(\w+)", usage("export", DOC), re.MULTILINE) == options_of("what")


def test_a_study_that_is_named_has_its_settings_explained():
    text = usage("study", DOC, ["study=time_to_accuracy", "threads=1"])
    (told,) = re.findall(r"^study:  # with study=time_to_accuracy\n((?:  .*\n)+)", text, re.MULTILINE)
    assert (
        "  clock: train_seconds    # train_seconds (on a machine" in told
        and "  threads: ${threads}     # of each" in told
    )
    assert "\n    - callbacks.probes=null\n" in told and "_target_" not in told
    assert "study=NAME --help explains" in text and "# with study=" not in usage("study", DOC)


def test_what_holds_nothing_that_is_told_is_not_told_either():
    text = usage("render", DOC)
    assert "listed:" not in text and "camera_file: null" in text and "  downscale: null" in text
