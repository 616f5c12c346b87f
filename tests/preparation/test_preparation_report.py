from dataclasses import replace
from datetime import timedelta

import cv2
import numpy as np
import pytest
from recordings import read_frames, write_flir, write_images

from heatsplat.preparation import report
from heatsplat.preparation.conditions import GivenConditions, InputUncertainty
from heatsplat.preparation.frames import Reading
from heatsplat.preparation.meaning import Meaning
from heatsplat.preparation.writer import Writer


def prepared(frames, target):
    writer = Writer(target, InputUncertainty(), keep_counts=False)
    return [writer.write(frame)[0] for frame in frames]


def test_conditions_stand_with_what_they_change_and_what_they_leave_unsure(tmp_path):
    frames = read_frames(write_flir(tmp_path / "files"))
    records = prepared(frames, tmp_path / "scene")
    section = report.radiometry(frames, records, InputUncertainty())
    text = "\n".join(section.lines)
    assert "| emissivity | 0.95 | file |" in text and "| distance | 20 m | file |" in text
    assert "**all, expanded (k = 2, 95 %)**" in text
    middle = records[2]["uncertainty_c"]["combined"]
    assert section.values["combined_c"][1] == pytest.approx(middle, rel=1e-2)


def test_without_conditions_temperatures_are_said_to_be_apparent(tmp_path):
    frames = read_frames(
        write_images(tmp_path / "files", {"a.tiff": np.linspace(10, 30, 64, dtype=np.float32).reshape(8, 8)})
    )
    text = "\n".join(report.radiometry(frames, prepared(frames, tmp_path / "scene"), InputUncertainty()).lines)
    assert "Apparent temperatures" in text and "| distance |" not in text and "| emissivity | 0.02 |" in text


def test_doubtful_statements_of_files_are_asked_about(tmp_path):
    frames = read_frames(write_flir(tmp_path / "files"))
    records = prepared(frames, tmp_path / "scene")
    window = [GivenConditions(window_transmission=0.8).settled(f) for f in frames]
    of_file = [type(f)(**{**vars(f), "sources": {**f.sources, "window_transmission": "file"}}) for f in window]
    asked = "If there was none, set conditions.window_transmission=1"
    (finding,) = report.radiometry(of_file, records, InputUncertainty()).findings
    assert asked in finding and f"4 frames, such as {of_file[0].name}, say that a window of 0.8" in finding
    assert not report.radiometry(window, records, InputUncertainty()).findings


def test_a_correction_that_is_larger_than_conditions_bring_is_a_finding(tmp_path):
    frames = read_frames(write_flir(tmp_path / "files"))
    for given, count in ((GivenConditions(emissivity=0.9, reflected_c=160.0), 1), (GivenConditions(emissivity=0.8), 0)):
        settled = [given.settled(frame) for frame in frames]
        records = prepared(settled, tmp_path / f"scene{count}")
        findings = report.radiometry(settled, records, InputUncertainty()).findings
        assert len(findings) == count and all("The conditions turn an apparent" in finding for finding in findings)


def test_pictures_show_steps_that_all_pixels_share(tmp_path):
    image = np.tile(np.linspace(10, 20, 40, dtype=np.float32), (32, 1))
    frames = read_frames(write_images(tmp_path / "files", {f"{i}.tiff": image + 3.0 * (i > 4) for i in range(9)}))
    records = prepared(frames, tmp_path / "scene")
    section = report.pictures(tmp_path / "scene", frames, records)
    assert section.values["largest_step"] == pytest.approx(3.0, abs=1e-3)
    for name in ("frames", "histograms", "over_time"):
        picture = cv2.imread(str(tmp_path / "scene" / "report" / f"{name}.png"))
        assert picture.shape[0] > 300 and picture.std() > 10
        assert f"report/{name}.png" in "\n".join(section.lines)


def test_greys_have_no_radiometry(tmp_path):
    frames = read_frames(write_images(tmp_path / "files", {"a.png": np.arange(64, dtype=np.uint8).reshape(8, 8)}))
    records = prepared(frames, tmp_path / "scene")
    assert report.radiometry(frames, records, InputUncertainty()) is None
    assert "greys" not in "\n".join(report.recording(frames, records, []).lines)
    assert report.pictures(tmp_path / "scene", frames, records).lines[:3:2] == [
        "![1 frame, one scale for all](report/frames.png)",
        "![histogram of every frame](report/histograms.png)",
    ]
    assert not (tmp_path / "scene" / "report" / "over_time.png").exists()  # of one frame


def test_frames_of_one_temperature_have_a_histogram(tmp_path):
    same = {f"{i}.tiff": np.full((8, 8), 20.0, np.float32) for i in range(2)}
    frames = read_frames(write_images(tmp_path / "files", same), Reading(Meaning()))
    section = report.pictures(tmp_path / "scene", frames, prepared(frames, tmp_path / "scene"))
    assert section.values["median_span"] == 0


def test_names_are_shown_as_they_are(tmp_path):
    image = np.linspace(10, 30, 64, dtype=np.float32).reshape(8, 8)
    frames = read_frames(write_images(tmp_path / "files", {f"p$^$_{i}.tiff": image + i for i in range(2)}))
    section = report.pictures(tmp_path / "*a* $^$", frames, prepared(frames, tmp_path / "*a* $^$"))
    report.write_report(tmp_path / "*a* $^$", [section])
    assert "<title>*a* $^$, prepared" in (tmp_path / "*a* $^$" / "report.html").read_text(encoding="utf-8")


def test_the_page_has_its_sections_in_order(tmp_path):
    page = report.write_report(tmp_path / "scene", [report.Section("One", ["a"]), report.Section("Two", ["b"])])
    assert page.read_text().index("## One") < page.read_text().index("## Two")


def test_doubts_and_recordings_without_a_temperature_are_findings(tmp_path):
    frames = read_frames(write_images(tmp_path / "files", {"a.tiff": np.full((8, 8), np.nan, np.float32)}))
    found = report.recording(frames, prepared(frames, tmp_path / "scene"), [], ["doubt"]).findings
    assert found[0] == "doubt" and "No pixel has a temperature" in found[1]


@pytest.mark.parametrize(
    ("step_s", "label", "found"), [(2.0, "seconds", 0), (50.0, "minutes", 0), (86400.0 * 30, "days", 1)]
)
def test_time_runs_in_a_unit_that_suits_it_and_surveys_days_apart_are_a_finding(
    tmp_path, monkeypatch, step_s, label, found
):
    frames = read_frames(write_flir(tmp_path / "files"))
    frames = [replace(f, time=frames[0].time + timedelta(seconds=i * step_s)) for i, f in enumerate(frames)]
    records = prepared(frames, tmp_path / "scene")
    pages = []
    monkeypatch.setattr(report, "save_picture", lambda figure, path: pages.append(figure))
    report.pictures(tmp_path / "scene", frames, records)
    assert pages[-1].axes[0].get_xlabel() == f"{label} since the first frame"
    findings = report.recording(frames, records, []).findings
    assert len(findings) == found and all("30 days lie between" in finding for finding in findings)


def test_findings_of_all_sections_stand_first_and_once(tmp_path):
    sections = [report.Section("One", ["a"]), report.Section("Two", ["b"], findings=["wrong"])]
    text = report.write_report(tmp_path / "scene", [*sections, sections[1]]).read_text()
    assert text.index("## Findings") < text.index("wrong") < text.index("## One") and text.count("wrong") == 1
    assert "Findings" not in report.write_report(tmp_path / "scene", sections[:1]).read_text()


def test_conditions_that_change_nothing_make_no_surface_temperatures(tmp_path):
    image = np.linspace(10, 30, 64, dtype=np.float32).reshape(8, 8)
    frames = read_frames(write_images(tmp_path / "files", {"a.tiff": image}))
    for given, apparent in (
        (GivenConditions(emissivity=1.0, distance_m=0.0), True),
        (GivenConditions(distance_m=10.0), False),
    ):
        settled = [given.settled(frame) for frame in frames]
        text = "\n".join(report.radiometry(settled, prepared(settled, tmp_path / "scene"), InputUncertainty()).lines)
        assert ("Apparent temperatures" in text) == apparent and ("Temperatures of surfaces" in text) != apparent
