"""Frames of the layouts that several data sets share."""

import pytest
from layouts import grey, names, write_colmap, write_image

from heatsplat.contracts import SceneError
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.colmap import read_model
from heatsplat.datamodules.posed_frames import model_frames


def loaded(root):
    module = Colmap(root=str(root))
    module.setup()
    return module.scene


def test_images_and_models_that_differ_are_matched_and_noted(tmp_path, caplog):
    files = names(12)
    write_colmap(tmp_path, files)
    (tmp_path / "images" / files[3]).unlink()
    write_image(tmp_path / "images" / "extra.png", grey(0))
    scene = loaded(tmp_path)
    assert len(scene.train) + len(scene.test) == 11
    assert scene.notes["registered"] == 12
    assert scene.notes["images_missing"].startswith("1 of 12 frames without a file in images/, dropped: frame_003")
    warned = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warned == [
        f"{tmp_path / 'images'}: 1 of 12 frames without a file in images/, dropped: frame_003.png; put these images there, or "
        "take the frames out of the list of cameras"
    ]
    assert scene.notes["images_unregistered"].startswith("1 file not in the model, unused: extra.png")


def test_photos_beside_thermal_images_lack_no_camera(tmp_path):
    files = names(9, "DJI_20240806173449_{:04d}_T.png")
    write_colmap(tmp_path, files)
    for other in (*(file.replace("_T.png", "_V.jpg") for file in files), "DJI_20240806173449_0009_T.png"):
        write_image(tmp_path / "images" / other, grey(0))
    notes = loaded(tmp_path).notes
    assert notes["images_beside"].startswith("9 files of another camera beside those of the model, unused: DJI_")
    assert notes["images_unregistered"] == "1 file not in the model, unused: DJI_20240806173449_0009_T.png"


@pytest.mark.parametrize("text", [False, True])
def test_a_larger_model_beside_is_told(tmp_path, caplog, text):
    """COLMAP numbers models that do not connect in the order in which it began them: sparse/0 need not be the largest."""
    write_colmap(tmp_path, names(12), text=text, place="sparse/1")
    write_colmap(tmp_path, names(4), text=text, images=None, place="sparse/0")
    (tmp_path / "sparse" / "2").mkdir()
    (tmp_path / "sparse" / "2" / "images.bin").write_bytes(b"cut")
    scene = loaded(tmp_path)
    assert scene.notes["registered"] == 4 and scene.notes["larger_model"] == "4 images, and 1 beside it has 12"
    told = "sparse/0 has 4 images, and 1 beside it has 12: put that model in its place to train on those"
    assert caplog.records[0].getMessage() == f"{tmp_path}/{told}"
    (tmp_path / "sparse" / "0").rename(tmp_path / "sparse" / "3")
    (tmp_path / "sparse" / "1").rename(tmp_path / "sparse" / "0")
    assert "larger_model" not in loaded(tmp_path).notes


def test_a_model_without_any_of_the_images_shows_both_names(tmp_path):
    write_colmap(tmp_path, names(9), images=None)
    write_image(tmp_path / "images" / "other.png", grey(0))
    with pytest.raises(SceneError, match="none of the 9 images of the sparse model .*'frame_000.png'.*'other.png'"):
        Colmap(root=str(tmp_path)).setup()


def test_a_missing_image_folder_names_the_option(tmp_path):
    write_colmap(tmp_path, names(9))
    with pytest.raises(SceneError, match="data.images=thermal: .*does not exist"):
        Colmap(root=str(tmp_path), images="thermal").setup()
    with pytest.raises(SceneError, match="data.raw=raw16: .*does not exist"):
        Colmap(root=str(tmp_path), raw="raw16").setup()


def test_a_data_set_may_name_its_frames_itself_and_masks_go_by_that_name(tmp_path):
    write_colmap(tmp_path, names(9))
    write_image(tmp_path / "masks" / "second.png", grey(0))
    model = read_model(tmp_path)
    files = dict.fromkeys(model.names) | {name: name for name in model.names[:2]}
    called = dict(zip(model.names, ("first", "second"), strict=False))

    def describe(name):
        return {"name": called[name], "time_s": 7.0}

    module = Colmap(root=str(tmp_path))
    frames = model_frames(module, tmp_path, model, files, tmp_path / "images", describe=describe)
    assert [frame.name for frame in frames] == ["first", "second"] and {frame.time_s for frame in frames} == {7.0}
    assert [frame.read_mask is not None for frame in frames] == [False, True]
    assert (frames[1].viewmat == model.viewmats[1]).all() and frames[1].read().shape == grey(0).shape
