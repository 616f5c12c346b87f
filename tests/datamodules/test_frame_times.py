"""Where the times of images come from, and which of several places counts."""

from pathlib import Path

import pytest

from heatsplat.contracts import SceneError
from heatsplat.datamodules.frame_times import FrameTimes

NAMES = ("a_010.png", "a_020.png")
DJI = ("DJI_20240806173449_0008_T.JPG", "DJI_20240806173500_0009_T.JPG")


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "frames.csv").write_text("file,time_s\na_010.png,1\na_020.png,2\n")
    (tmp_path / "clock.csv").write_text("name;when\na_010;2024-08-06T12:00:00Z\na_020;2024-08-06T12:01:00Z\n")
    return tmp_path


def test_a_table_counts_before_a_pattern_before_the_poses_file_before_what_lies_beside_it(folder):
    pattern = {"time_regex": r"_(\d+)"}
    table = {"time_csv": "clock.csv", "time_csv_name": "name", "time_csv_time": "when"}
    written = {"a_010.png": 100.0, "a_020.png": 200.0}
    asked = [
        (FrameTimes(**table, **pattern), written),
        (FrameTimes(**pattern), written),
        (FrameTimes(), written),
        (FrameTimes(), None),
    ]
    found = [times.of(folder, NAMES, own, "poses.json") for times, own in asked]
    assert [times["a_020.png"] - times["a_010.png"] for times, _ in found] == [60.0, 10.0, 100.0, 1.0]
    assert [note.split(",")[0] for _, note in found] == ["clock.csv", "file names", "poses.json", "frames.csv"]
    assert [times.are_told for times, _ in asked] == [True, True, False, False]


def test_without_anything_dji_names_tell_and_other_names_do_not(tmp_path):
    times, note = FrameTimes().of(tmp_path, DJI)
    assert times[DJI[1]] - times[DJI[0]] == 11.0 and note.startswith("DJI file names")
    assert FrameTimes().of(tmp_path, (*DJI, "other.png")) == (None, "none (set data.time_regex or data.time_csv)")


def test_frames_csv_without_all_images_has_no_times_and_says_which(folder, caplog):
    times, note = FrameTimes().of(folder, (*NAMES, "a_030.png"))
    assert times is None and note == "none (frames.csv has those of 2 of 3 images, and none of a_030.png)"
    assert "frames.csv has those of 2 of 3 images" in caplog.text


def test_a_table_that_lacks_an_image_is_refused(folder):
    told = FrameTimes(time_csv="clock.csv", time_csv_name="name", time_csv_time="when")
    with pytest.raises(
        SceneError, match=r"clock.csv has no row for a_030.png \(1 of 3 images\); column name must hold"
    ):
        told.of(folder, (*NAMES, "a_030.png"))
    with pytest.raises(
        SceneError, match=f"data.time_csv=other.csv: there is no file {folder}/other.csv and no {Path.cwd()}/other.csv"
    ):
        FrameTimes(time_csv="other.csv").of(folder, NAMES)


@pytest.mark.parametrize(
    ("form", "late", "early"), [("HHMMSSmmm", "235900000", "000100000"), ("%H-%M", "23-59", "00-01")]
)
def test_names_with_the_time_of_day_go_on_past_midnight(tmp_path, form, late, early):
    told = FrameTimes(time_regex=r"_([\d-]+)", time_format=form)
    names = [f"a_{early}.png", f"b_{late}.png"]
    times, note = told.of(tmp_path, names)
    assert times[names[0]] - times[names[1]] == 120.0 and note.endswith("; 24 h were added to those after midnight")
    times, note = told.of(tmp_path, [name.replace("23", "01") for name in names])
    assert abs(max(times.values()) - min(times.values()) - 7080.0) < 1e-6 and "midnight" not in note


def test_a_table_takes_the_form_of_its_times(folder):
    """As spreadsheets write them: a German date, and times of day around midnight."""
    (folder / "sheet.csv").write_text(
        "file;day;clock\r\na_010.png;06.08.2024 23:59:30;23:59:30\r\na_020.png;07.08.2024 00:01:00;00:01:00\r\n"
    )
    for column, form in (("day", "%d.%m.%Y %H:%M:%S"), ("clock", "%H:%M:%S")):
        given = {"time_csv": "sheet.csv", "time_csv_time": column}
        times, note = FrameTimes(**given, time_format=form).of(folder, NAMES)
        assert times["a_020.png"] - times["a_010.png"] == 90.0
        assert note == f"sheet.csv, column {column}" + "; 24 h were added to those after midnight" * (column == "clock")
        with pytest.raises(SceneError, match="line 2: .* is neither seconds nor .* data.time_format=%H:%M:%S"):
            FrameTimes(**given).of(folder, NAMES)
        with pytest.raises(SceneError, match="line 2: .* is no time of the form HHMMSSmmm"):
            FrameTimes(**given, time_format="HHMMSSmmm").of(folder, NAMES)


def test_names_with_a_date_are_not_moved(tmp_path):
    told = FrameTimes(time_regex=r"_(\d+)", time_format="%Y%m%d%H%M")
    times, note = told.of(tmp_path, names := ["a_202408060001.png", "b_202408062359.png"])
    assert times[names[1]] - times[names[0]] == 23 * 3600 + 58 * 60 and "midnight" not in note
