"""What lies in a folder is replaced only where a preparation wrote it."""

import shutil

import numpy as np
import pytest
from recordings import write_images

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.colmap import write_model
from heatsplat.preparation.prepare import prepare
from heatsplat.preparation.report import Section
from heatsplat.preparation.target import CORRECTED, RECORD, Target

pytestmark = pytest.mark.usefixtures("dots_for_pictures")
PLAIN = {"conditions": {}, "uncertainty": {}, "counts": {}}
IMAGES = {f"{i}.tiff": np.full((8, 8), 20.0 + i, np.float32) for i in range(3)}


def search(frames, target):
    """Stands in for a search for cameras."""
    pinhole = ("PINHOLE", (8.0, 8.0, 4.0, 4.0), 8, 8)
    points = np.zeros((3, 3))
    write_model(target / "sparse" / "0", {f"{f.name}.tiff": np.eye(4) for f in frames}, [pinhole], points, points)
    return Section("Poses", ["found"])


def contents(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def is_refused(source, target, said, **options):
    before = contents(target)
    with pytest.raises(SceneError, match=said):
        prepare(str(source), target, **PLAIN, **options)
    assert contents(target) == before


def test_files_that_are_read_are_never_written_over(tmp_path):
    scene = tmp_path / "scene"
    write_images(scene / "images", IMAGES)
    is_refused(scene / "images", scene, r"images/0.tiff would be replaced: target=.*a target outside of it")
    (tmp_path / "links").mkdir()
    for name in IMAGES:
        (tmp_path / "links" / name).symlink_to(scene / "images" / name)
    is_refused(tmp_path / "links", scene, "would be replaced: target=")
    write_images(scene / "raw", IMAGES)
    shutil.rmtree(scene / "images")
    prepare(str(scene / "raw"), scene, **PLAIN)  # beside what is written is no harm
    assert contents(scene / "raw").keys() == IMAGES.keys()


@pytest.mark.parametrize("own", ["images/0.tiff", "frames.csv", "temperature_bounds.json", "world.json", "masks/a.png"])
def test_a_folder_with_something_else_in_it_is_no_target(tmp_path, own):
    source, scene = write_images(tmp_path / "files", IMAGES), tmp_path / "scene"
    (scene / own).parent.mkdir(parents=True)
    (scene / own).write_text("mine")
    is_refused(source, scene, f"{own} is of something else .* give an empty folder as target, or move it elsewhere")
    assert contents(scene) == {own: b"mine"}  # nor was anything of ours begun beside it


def test_cameras_that_no_preparation_wrote_stay(tmp_path):
    source, scene = write_images(tmp_path / "files", IMAGES), tmp_path / "scene"
    prepare(str(source), scene, **PLAIN)
    (scene / "sparse" / "0").mkdir(parents=True)
    (scene / "sparse" / "0" / "images.bin").write_text("mine")
    prepare(str(source), scene, **PLAIN)  # which writes no cameras
    is_refused(source, scene, "sparse/0 holds cameras that no preparation wrote", poses=search)
    shutil.rmtree(scene / "sparse")
    for _ in range(2):
        prepare(str(source), scene, **PLAIN, poses=search)
    (scene / "sparse" / "0" / "notes.txt").write_text("mine")
    is_refused(source, scene, "or that were changed since.*move them elsewhere", poses=search)
    assert (scene / "sparse" / "0" / "notes.txt").read_text() == "mine"


def test_cameras_that_are_not_found_anew_are_still_ours(tmp_path):
    source, scene = write_images(tmp_path / "files", IMAGES), tmp_path / "scene"
    prepare(str(source), scene, **PLAIN, poses=search)

    def fails(frames, target):
        raise SceneError("no cameras")

    for _ in range(2):
        with pytest.raises(SceneError, match="no cameras"):
            prepare(str(source), scene, **PLAIN, poses=fails)
    prepare(str(source), scene, **PLAIN, poses=search)


def test_a_corrected_scene_is_no_target_of_a_preparation_nor_the_other_way_round(tmp_path):
    source, scene, other = write_images(tmp_path / "files", IMAGES), tmp_path / "scene", tmp_path / "other"
    prepare(str(source), scene, **PLAIN)
    with pytest.raises(SceneError, match="is of something else than a scene corrected pixel by pixel"):
        Target(scene, CORRECTED).claim()
    Target(other, CORRECTED).claim()
    write_images(other / "images", IMAGES)
    Target(other, CORRECTED).claim()
    is_refused(source, other, "is of something else than a scene prepared")
    (other / RECORD).unlink()
    with pytest.raises(SceneError, match="is of something else"):
        Target(other, CORRECTED).claim()
