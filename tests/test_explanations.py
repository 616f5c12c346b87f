"""What a user is told of an error: a sentence in place of a traceback, where it is theirs to mend."""

import errno
import os
from pathlib import Path

import pytest
import yaml
from hydra.errors import ConfigCompositionException, InstantiationException, OverrideParseException

from heatsplat import composition
from heatsplat.errors import SceneError
from heatsplat.explanations import _quoted, expected, explain, sentence
from heatsplat.runs.lock import OccupiedError

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        ("study.overrides=[data.size=tiny, threads=1]", "\"study.overrides=['data.size=tiny','threads=1']\""),
        ("study.overrides=[data.size=tiny,", "\"study.overrides=['data.size=tiny',...]\""),
        ("study.scenes=[küche,flur]", "\"study.scenes=['küche',flur]\""),
    ],
)
def test_a_list_is_told_its_quotes(wrong, meant):
    assert _quoted(wrong).endswith(f" {meant}")
    with pytest.raises(OverrideParseException):
        composition.compose([wrong], "study")
    assert _quoted("a=[x,[y=1]]") == _quoted("a=['b=c',d=e]") == ""


@pytest.mark.parametrize("steps", ["many", "null"])
def test_steps_that_are_no_number_are_told_without_who_asked_for_them(steps):
    with pytest.raises(ValueError, match="max_steps") as refused:
        composition.compose([f"max_steps={steps}"])
    told = f"max_steps must be a whole number, 1 or more, got {'None' if steps == 'null' else steps}"
    assert explain(refused.value, "train", []) == sentence(refused.value) == told


@pytest.mark.parametrize("typed", ["lr_source", "lr_sorce"])
def test_a_key_with_dots_in_its_name_is_told_as_it_can_be_typed(typed):
    wrong = ["study=tune", f"study.cases.etgs.knobs.thermal.{typed}=[0.1,1]"]
    with pytest.raises(ConfigCompositionException) as refused:
        composition.compose(wrong, "study")
    told, _, argument = explain(refused.value, "study", wrong).rpartition("\n")[2].partition(": ")
    assert told == "thermal.lr_source is one name, dots and all"
    assert argument == '"study.cases.etgs.knobs={thermal.lr_source:[0.1,1]}"'
    knobs = composition.compose(["study=tune", argument.strip('"')], "study")["study"]["cases"]["etgs"]["knobs"]
    assert knobs["thermal.lr_source"] == [0.1, 1] and len(knobs) == 3


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EFBIG, errno.EROFS, errno.EACCES])
def test_a_disk_that_takes_no_file_needs_no_traceback(code):
    error = OSError(code, os.strerror(code), "/read/only/run.log")
    assert expected(error) is error and sentence(error).startswith("/read/only/run.log: ")
    assert expected(OSError(errno.EIO, "broken")) is None


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (SceneError("data.root is not set"), "data.root is not set"),
        (OccupiedError("it holds a run"), "it holds a run"),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "a.csv"), "a.csv: No such file or directory"),
        (FileNotFoundError("no table"), "no table"),
        (ImportError("gsplat is not installed"), "gsplat is not installed"),
        (FloatingPointError(), "FloatingPointError"),
    ],
)
def test_errors_are_told_without_the_names_of_their_classes(error, told):
    assert sentence(error) == told == explain(error, "train", [])


@pytest.mark.parametrize("path", sorted(ROOT.glob("conf/*.yaml")), ids=lambda path: path.stem)
def test_no_number_or_text_of_a_command_has_the_name_of_a_group(path):
    """Hydra would take ``cameras=2`` for an option of conf/cameras."""
    groups = {folder.name for folder in (ROOT / "conf").iterdir() if folder.is_dir()}
    settings = yaml.safe_load(path.read_text())
    assert [key for key, value in settings.items() if key in groups and not isinstance(value, dict)] == []


@pytest.mark.parametrize(
    ("told", "printed"),
    [
        ("every must be 1 or more", "density: every must be 1 or more"),
        ("density.every must be 1 or more", "density.every must be 1 or more"),
        ("leave out budget, or density.every", "leave out budget, or density.every"),
    ],
)
def test_a_setting_that_a_class_of_the_user_refuses_needs_no_traceback(told, printed):
    error = InstantiationException("Error in call to target 'mine.Unseen'\nfull_key: density")
    error.__cause__ = ValueError(told)  # raised by code that is none of ours
    assert expected(error) is error and sentence(error) == printed
    assert explain(error, "train", ["density=unseen"]) == printed
    error.__cause__ = RuntimeError("anything else")
    assert expected(error) is None


def test_a_page_with_few_training_cameras_can_be_asked_for():
    assert composition.compose(["ckpt=a.ckpt", "training_cameras=2"], "view")["training_cameras"] == 2
