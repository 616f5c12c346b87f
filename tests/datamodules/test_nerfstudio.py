"""Scenes as other tools write them: other keys, other folders, photos alone."""

import json
import logging
import math
import shutil

import numpy as np
import pytest
import torch
from layouts import FOCAL, HEIGHT, WIDTH, grey, names, opengl, viewmats, write_colmap, write_image, write_json
from plyfile import PlyData, PlyElement

from heatsplat.contracts import SceneError
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.nerfstudio import Transforms, lens_in, read_transforms
from heatsplat.datamodules.formats.palette import named
from heatsplat.datamodules.nerfstudio import Nerfstudio
from heatsplat.datamodules.points import ply_points

LENS = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 20.0, "cy": 16.0, "w": WIDTH, "h": HEIGHT}


def photo(index):
    """A picture in many colours."""
    pixels = np.random.default_rng(index).integers(0, 256, (HEIGHT, WIDTH, 3))
    return pixels.astype(np.uint8)


def write_frames(folder, frames, file="transforms.json", **values):
    """A transforms file: a dictionary of image keys for each frame, poses added."""
    poses = viewmats(len(frames))
    listed = [{**frame, "transform_matrix": opengl(pose)} for frame, pose in zip(frames, poses, strict=True)]
    write_json(folder / file, {**LENS, **values, "frames": listed})


def loaded(root, **options):
    return Nerfstudio(root=str(root), **{"random_points": 50, **options}).scene


@pytest.mark.parametrize(
    ("keys", "assumed"),
    [
        (lambda name: {"rgb": f"color/{name}", "thermal": f"heat/{name}"}, "image paths stand under rgb, thermal"),
        (lambda name: {"file_path": f"./color/{name}", "thermal_file_path": f"./heat/{name}"}, None),
        (
            lambda name: {"image": {"file_path": f"color/{name}"}, "ir": {"file_path": f"heat/{name}"}},
            "image paths stand under image, ir",
        ),
    ],
)
def test_images_are_found_under_other_keys(tmp_path, keys, assumed):
    for i, name in enumerate(names(9)):
        write_image(tmp_path / "color" / name, photo(i))
        write_image(tmp_path / "heat" / name, grey(i))
    write_frames(tmp_path, [keys(name) for name in names(9)])
    scene = loaded(tmp_path)
    assert len(scene.train) == 7 and len(scene.test) == 2
    for view in scene.train:
        i = names(9).index(view.frame.name)
        np.testing.assert_allclose(view.thermal[..., 0] * 255, grey(i), atol=1e-4)
        np.testing.assert_allclose(view.rgb * 255, photo(i), atol=1e-4)
        np.testing.assert_allclose(view.camera.viewmat, viewmats(9)[i], atol=1e-9)
    assert scene.notes.get("keys_assumed") == assumed


def test_what_is_assumed_is_noted_and_logged_once(tmp_path, caplog):
    for i, name in enumerate(names(9)):
        write_image(tmp_path / "a" / name, grey(i))
    write_frames(tmp_path, [{"image": f"a/{name}"} for name in names(9)])
    with caplog.at_level(logging.INFO):
        scene = loaded(tmp_path)
    assert scene.notes["keys_assumed"] == "image paths stand under image"
    assert scene.notes["images_assumed"].startswith("images such as a/frame_000.png are taken as thermal images")
    assert scene.notes["split_assumed"].startswith("every 8th frame is test")
    assert [r.message.count("; ") for r in caplog.records if "keys" in r.message or "stand under" in r.message] == [2]
    assert scene.train[0].rgb is None and scene.train[0].thermal.shape == (HEIGHT, WIDTH, 1)


def test_photos_alone_are_an_rgb_scene(tmp_path):
    for i, name in enumerate(names(9)):
        write_image(tmp_path / "images" / name, photo(i))
    write_frames(tmp_path, [{"file_path": f"images/{name}"} for name in names(9)], k1=0.3)
    scene = loaded(tmp_path, downscale=2, rgb=False)
    view = scene.train[0]
    assert view.thermal is None and view.rgb.shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert not view.mask.all()  # of the distortion
    assert scene.thermal_range is None and "thermal_range" not in scene.metadata
    assert scene.notes["photos"].startswith("visible images only") and "pseudo_colour" not in scene.notes
    json.dumps(scene.notes)
    with pytest.raises(SceneError, match="has no thermal image"):
        view.image("thermal")
    colours = loaded(tmp_path, thermal_channels=3)
    assert colours.train[0].thermal.shape == (HEIGHT, WIDTH, 3) and colours.train[0].rgb is None


def test_colours_of_a_palette_are_thermal_images(tmp_path):
    for i, name in enumerate(names(9)):
        colours = np.rint(named("iron").curve(256)[grey(i)]).astype(np.uint8)
        write_image(tmp_path / "images" / name, colours)
    write_frames(tmp_path, [{"file_path": f"images/{name}"} for name in names(9)])
    assert loaded(tmp_path).train[0].thermal is None  # nothing says that they are
    write_json(tmp_path / "temperature_bounds.json", {"absolute_min_temperature": 1, "absolute_max_temperature": 2})
    for folder in (tmp_path, None):
        if folder is None:
            (tmp_path / "temperature_bounds.json").unlink()
        scene = loaded(tmp_path, palette="iron")
        np.testing.assert_allclose(255 * scene.train[0].thermal[..., 0], grey(1), atol=1.01)
        assert (scene.thermal_range is None) == (folder is None)


def test_colours_with_bounds_are_no_photos(tmp_path):
    for i, name in enumerate(names(9)):
        write_image(tmp_path / "images" / name, photo(i))
    write_frames(tmp_path, [{"file_path": f"images/{name}"} for name in names(9)])
    write_json(tmp_path / "temperature_bounds.json", {"absolute_min_temperature": 1, "absolute_max_temperature": 2})
    with pytest.raises(SceneError, match="is pseudo-colour .* no temperatures although the scene has bounds"):
        loaded(tmp_path)


@pytest.mark.parametrize("test", ["test", "val"])
def test_instant_ngp_and_blender_files(tmp_path, test):
    for subset in ("train", test):
        for i in range(5):
            write_image(
                tmp_path / subset / f"r_{i}.png", np.dstack([photo(i), np.full((HEIGHT, WIDTH), 255, np.uint8)])
            )
        frames = [{"file_path": f"./{subset}/r_{i}"} for i in range(5)]
        write_frames(tmp_path, frames, f"transforms_{subset}.json")
        values = json.loads((tmp_path / f"transforms_{subset}.json").read_text())
        values = {"camera_angle_x": 0.7, "frames": values["frames"]}
        write_json(tmp_path / f"transforms_{subset}.json", values)
    scene = loaded(tmp_path)
    assert [f.name for f in scene.train.frames] == [f"train/r_{i}.png" for i in range(5)]
    assert [f.name for f in scene.test.frames] == [f"{test}/r_{i}.png" for i in range(5)]
    assert scene.train[0].camera.K[0, 0] == pytest.approx(0.5 * WIDTH / np.tan(0.35))
    assert scene.train[0].thermal is None and scene.train[0].rgb is not None


def test_fields_of_view_tell_both_focal_lengths(tmp_path):
    for i in range(9):
        write_image(tmp_path / f"{i}.png", photo(i))
    frames = [{"file_path": f"{i}.png"} for i in range(9)]
    for given, (fx, fy) in (
        ({"camera_angle_x": 0.7, "camera_angle_y": 0.5}, (0.5 * WIDTH / np.tan(0.35), 0.5 * HEIGHT / np.tan(0.25))),
        ({"fl_x": 50.0, "camera_angle_y": 0.5}, (50.0, 0.5 * HEIGHT / np.tan(0.25))),
        ({"camera_angle_x": 0.7, "fl_y": 60.0, "camera_angle_y": 0.5}, (0.5 * WIDTH / np.tan(0.35), 60.0)),
        ({"camera_angle_x": 0.7}, (0.5 * WIDTH / np.tan(0.35),) * 2),
    ):
        write_frames(tmp_path, frames)
        values = json.loads((tmp_path / "transforms.json").read_text())
        write_json(tmp_path / "transforms.json", {**given, "frames": values["frames"]})
        K = loaded(tmp_path).train[0].camera.K
        assert [float(K[0, 0]), float(K[1, 1])] == pytest.approx([fx, fy]), given


@pytest.mark.parametrize(
    ("of_file", "of_frame", "found"),
    [
        ({"fl_x": 30, "fl_y": 32}, {}, (30, 32)),
        ({"fl_x": 30}, {"camera_angle_x": 2 * math.atan(0.4)}, (WIDTH / 0.8, WIDTH / 0.8)),
        ({"fl_x": 30, "fl_y": 32}, {"camera_angle_y": 2 * math.atan(0.4)}, (30, HEIGHT / 0.8)),
        ({"camera_angle_x": 1, "camera_angle_y": 1}, {"fl_x": 50, "fl_y": 52}, (50, 52)),
    ],
)
def test_a_frame_s_own_field_of_view_goes_before_the_focal_length_of_the_file(tmp_path, of_file, of_frame, found):
    write_json(tmp_path / "t.json", {**of_file, "frames": [{"file_path": "a.png", "transform_matrix": [], **of_frame}]})
    transforms = read_transforms(tmp_path / "t.json")
    lens = lens_in(transforms, transforms.frames[0], lambda: (WIDTH, HEIGHT))
    assert (lens.fx, lens.fy) == pytest.approx(found)


def test_a_principal_point_of_larger_images_needs_their_size(tmp_path):
    values = {"fl_x": 76, "cx": 41, "cy": 30, "frames": [{"file_path": "a.png", "transform_matrix": []}]}
    write_json(tmp_path / "t.json", values)
    transforms = read_transforms(tmp_path / "t.json")
    with pytest.raises(
        SceneError, match=f"t.json, a.png: the principal point 41, 30 lies outside its image of {WIDTH}x{HEIGHT}"
    ):
        lens_in(transforms, transforms.frames[0], lambda: (WIDTH, HEIGHT))
    lens = lens_in(transforms, {**transforms.frames[0], "w": 80, "h": 64}, lambda: (WIDTH, HEIGHT))
    assert lens.resized(WIDTH, HEIGHT).fx == 38


@pytest.mark.parametrize("form", ["valley_{:03d}.png", "terrain_{:03d}.png", "latest_train_{:03d}.png", "f_{:03d}.png"])
def test_words_that_all_names_have_split_nothing(tmp_path, form):
    frames = [{"file_path": f"thermal/{form.format(i)}"} for i in range(9)]
    for i, frame in enumerate(frames):
        write_image(tmp_path / frame["file_path"], grey(i))
    write_frames(tmp_path, frames)
    scene = loaded(tmp_path)
    assert [f.name for f in scene.test.frames] == [form.format(0), form.format(8)]
    assert "tell train and test apart" in scene.notes["split_assumed"]


@pytest.mark.parametrize(("said", "found"), [("some\\cloud.ply", True), ("cloud.ply", False)])
def test_the_point_cloud_that_the_file_names_is_found_or_missed(tmp_path, caplog, said, found):
    frames = [{"file_path": f"thermal/{i}.png"} for i in range(9)]
    for i, frame in enumerate(frames):
        write_image(tmp_path / frame["file_path"], grey(i))
    write_frames(tmp_path, frames, ply_file_path=said)
    rows = np.array([(i, i % 3, i % 2) for i in range(30)], dtype=[(axis, "f4") for axis in "xyz"])
    (tmp_path / "some").mkdir()
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "some" / "cloud.ply"))
    scene = loaded(tmp_path)
    assert (len(scene.points) == 30) is found and ("points_random" in scene.notes) is not found
    assert ("ply_file_path of transforms.json is cloud.ply, which is not there" in caplog.text) is not found


@pytest.mark.parametrize(("kind", "red"), [("u1", 204), ("f4", 204), ("f4", 0.8)])
def test_colours_of_points_are_bytes_or_shares(tmp_path, kind, red):
    rows = np.zeros(4, dtype=[(axis, "f4") for axis in "xyz"] + [(colour, kind) for colour in ("red", "green", "blue")])
    rows["red"] = red
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "points.ply"))
    _, colours = ply_points(tmp_path / "points.ply")
    assert colours.max(axis=0).tolist() == pytest.approx([0.8, 0, 0])


def test_a_frame_s_own_mask_goes_before_that_of_its_name(tmp_path):
    own, of_name = np.zeros((2, HEIGHT, WIDTH), np.uint8)
    own[:, 3:], of_name[:, 9:] = 255, 255
    frames = [{"file_path": f"thermal/{i}.png"} for i in range(9)]
    for i, frame in enumerate(frames):
        write_image(tmp_path / frame["file_path"], grey(i))
    write_image(tmp_path / "masks" / "1.png", of_name)
    write_image(tmp_path / "masks" / "2.png", of_name)
    write_image(tmp_path / "masks" / "people.png", own)
    frames[1]["mask_path"] = "masks\\people.png"
    write_frames(tmp_path, frames)
    masks = [view.mask for view in loaded(tmp_path).train]
    assert (
        masks[0].sum() == own.astype(bool).sum() and masks[1].sum() == of_name.astype(bool).sum() and masks[2] is None
    )
    frames[1]["mask_path"] = "masks/nobody.png"
    write_frames(tmp_path, frames)
    with pytest.raises(SceneError, match="mask_path of thermal/1.png is masks/nobody.png, which is not there"):
        loaded(tmp_path)


def test_paths_of_windows_are_paths(tmp_path):
    """colmap2nerf of instant-ngp writes the folder of the images as the system does."""
    for i in range(9):
        write_image(tmp_path / "ir" / "day" / f"{i}.png", grey(i))
    write_frames(tmp_path, [{"file_path": f".\\ir\\day/{i}.png"} for i in range(9)])
    assert len(loaded(tmp_path).train) == 7


def test_a_fisheye_of_instant_ngp_is_one(tmp_path):
    """Its files name no camera model, only is_fisheye: the same k1 to k4 are those of another lens."""
    coefficients = {"k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001}
    for name, kind in (("ngp", {"is_fisheye": True}), ("named", {"camera_model": "OPENCV_FISHEYE"})):
        for i in range(9):
            write_image(tmp_path / name / f"{i}.png", photo(i))
        write_frames(tmp_path / name, [{"file_path": f"{i}.png"} for i in range(9)], **coefficients, **kind)
    ngp, named = (loaded(tmp_path / name) for name in ("ngp", "named"))
    assert torch.equal(ngp.train[0].rgb, named.train[0].rgb) and torch.equal(
        ngp.train[0].camera.K, named.train[0].camera.K
    )
    write_frames(tmp_path / "ngp", [{"file_path": "0.png"}], is_fisheye=True, camera_model="OPENCV")
    with pytest.raises(SceneError, match="is_fisheye is true, but camera_model is OPENCV; keep one of them"):
        loaded(tmp_path / "ngp")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (
            {"camera_model": "OPENCV", "k4": 0.1},
            "k4 is 0.1, and camera model OPENCV has no k4; say camera_model FULL_OPENCV",
        ),
        ({"k4": 0.1}, "camera model OPENCV has no k4"),
        (
            {"camera_model": "PINHOLE", "k1": -0.2, "k2": None},
            "k1 is -0.2, .* PINHOLE has no k1; say camera_model OPENCV",
        ),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.01}, "camera model OPENCV_FISHEYE has no p1; undistort"),
    ],
)
def test_distortion_that_the_camera_model_does_not_have_is_refused(tmp_path, values, said):
    """nerfstudio's k4 is the factor of r^8, OpenCV's divides by 1 + k4 r^2: nerfstudio undistorts no image with it, either."""
    lens = {"fl_x": 50.0, "w": WIDTH, "h": HEIGHT}
    with pytest.raises(SceneError, match=said):
        lens_in(Transforms(tmp_path, lens | values, []), {"file_path": "0.png"}, lambda: (WIDTH, HEIGHT))
    named = lens_in(
        Transforms(tmp_path, lens, []), {"file_path": "0.png", "camera_model": "FULL_OPENCV", "k4": 0.1}, None
    )
    assert named.distortion == (0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0)


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("SIMPLE_PINHOLE", {}),
        ("SIMPLE_RADIAL", {"k1": -0.1}),
        ("RADIAL", {"k1": -0.1, "k2": 0.02}),
        ("SIMPLE_RADIAL_FISHEYE", {"k1": 0.01}),
        ("RADIAL_FISHEYE", {"k1": 0.01, "k2": 0.002}),
    ],
)
def test_two_focal_lengths_count_whatever_the_camera_model_is_called(tmp_path, model, distortion):
    """The second was left out without a word, which nerfstudio takes."""
    values = {"fl_x": 50.0, "w": WIDTH, "h": HEIGHT, "camera_model": model} | distortion
    one, same, two = (
        lens_in(Transforms(tmp_path, values | more, []), {"file_path": "0.png"}, None)
        for more in ({}, {"fl_y": 50.0}, {"fl_y": 60.0})
    )
    assert one == same and (one.fx, one.fy, one.model) == (50.0, 50.0, model)
    assert (two.fx, two.fy) == (50.0, 60.0)
    assert two.fisheye == one.fisheye and [k for k in two.distortion if k] == list(distortion.values())


def test_a_folder_thermal_with_cameras_of_its_own(tmp_path):
    for i, name in enumerate(names(9)):
        write_image(tmp_path / "thermal" / "images" / name, grey(i))
        write_image(tmp_path / "rgb" / "images" / name, photo(i))
    write_frames(tmp_path / "thermal", [{"file_path": f"images/{name}"} for name in names(9)])
    shutil.copy(tmp_path / "thermal" / "transforms.json", tmp_path / "rgb" / "transforms.json")
    scene = loaded(tmp_path)
    view = scene.train[0]
    np.testing.assert_allclose(view.thermal[..., 0] * 255, grey(names(9).index(view.frame.name)), atol=1e-4)
    assert view.rgb is None


def test_cameras_of_photos_are_not_those_of_thermal_images_that_have_their_own(tmp_path, caplog):
    for i, name in enumerate(names(9)):
        write_image(tmp_path / "thermal" / "images" / name, grey(i))
        write_image(tmp_path / "images" / name, photo(i))
    for folder in (tmp_path, tmp_path / "thermal"):
        write_frames(folder, [{"file_path": f"images/{name}"} for name in names(9)])
    assert loaded(tmp_path).train[0].thermal is None
    assert f"for those in thermal/ give data.root={tmp_path}/thermal data.scene=null" in caplog.text
    assert loaded(tmp_path / "thermal").train[0].rgb is None


def test_images_without_any_known_key_are_refused(tmp_path):
    write_frames(tmp_path, [{"picture": "a.png"}])
    with pytest.raises(SceneError, match="frame 0 has no key 'file_path'; it has picture, transform_matrix"):
        loaded(tmp_path)
    write_frames(tmp_path, [{"file_path": 5}])
    with pytest.raises(SceneError, match="frame 0 has 5 under 'file_path'"):
        loaded(tmp_path)


def test_photos_with_a_sparse_model(tmp_path):
    write_colmap(tmp_path, names(9), pixels=[photo(i) for i in range(9)])
    scene = Colmap(root=str(tmp_path), images=None, rgb="images").scene
    assert scene.train[0].thermal is None
    np.testing.assert_allclose(scene.train[0].rgb * 255, photo(1), atol=1e-4)
    with pytest.raises(SceneError, match="data.images=null is for photos alone"):
        Colmap(images=None)


def two_cameras(folder, lists):
    """Frames 0 to 3 of two cameras, whose files have the same names."""
    files = [f"thermal/cam{camera}/{i}.png" for camera in (0, 1) for i in range(4)]
    for i, file in enumerate(files):
        write_image(folder / file, grey(i))
    write_frames(folder, [{"file_path": file} for file in files], **lists(files))
    return loaded(folder)


@pytest.mark.parametrize("file", ["transforms.json", "transforms_{}.json"])
def test_folders_may_go_on_in_that_of_thermal_images(tmp_path, file):
    frames = {part: [{"file_path": f"./{part}/{i}.png"} for i in range(4)] for part in ("train", "test")}
    for at, (part, listed) in enumerate(frames.items()):
        for i, frame in enumerate(listed):
            write_image(tmp_path / frame["file_path"], photo(4 * at + i))
            write_image(tmp_path / "thermal" / frame["file_path"], grey(4 * at + i))
        write_frames(tmp_path, listed if "{}" in file else [*frames["train"], *frames["test"]], file.format(part))
    scene = loaded(tmp_path, split="folders")
    assert [frame.name for frame in scene.test.frames] == [f"thermal/test/{i}.png" for i in range(4)]
    assert np.allclose(scene.test[2].thermal[..., 0].numpy() * 255, grey(6), atol=0.5)
    assert np.allclose(scene.test[2].rgb.numpy() * 255, photo(6), atol=0.5)


def test_one_thermal_image_of_two_cameras_is_refused(tmp_path):
    frames = [{"file_path": f"images/{camera}/{i}.png"} for camera in ("left", "right") for i in range(4)]
    for i, frame in enumerate(frames):
        write_image(tmp_path / frame["file_path"], photo(i))
        write_image(tmp_path / "thermal" / f"{i % 4}.png", grey(i))
    write_frames(tmp_path, frames)
    with pytest.raises(SceneError, match="of both images/left/0.png and images/right/0.png would be thermal/0.png"):
        loaded(tmp_path)


def test_lists_tell_files_of_one_name_apart_by_their_folders(tmp_path):
    scene = two_cameras(tmp_path / "a", lambda files: {"train_filenames": files[:4], "test_filenames": files[4:]})
    assert [f.name for f in scene.test.frames] == [f"thermal/cam1/{i}.png" for i in range(4)]
    assert np.allclose(scene.test[2].thermal[..., 0].numpy() * 255, grey(6), atol=0.5)


def test_frames_in_no_list_are_dropped_and_told(tmp_path):
    scene = two_cameras(tmp_path / "a", lambda files: {"train_filenames": files[1:4], "test_filenames": files[:1]})
    assert [f.name for f in scene.test.frames] == ["thermal/cam0/0.png"] and len(scene.train) == 3
    assert scene.notes["images_unlisted"].startswith("4 frames in no list, dropped: thermal/cam1/0.png")
    with pytest.raises(
        SceneError, match="its lists name none of its frames: other.png is not among thermal/cam0/0.png"
    ):
        two_cameras(tmp_path / "b", lambda files: {"train_filenames": ["other.png"]})
    with pytest.raises(SceneError, match="name thermal/cam0/0.png both for training and for testing; keep one of them"):
        two_cameras(tmp_path / "c", lambda files: {"train_filenames": files, "test_filenames": ["./" + files[0]]})


def test_lists_name_frames_by_their_visible_image(tmp_path):
    frames = [{"file_path": f"rgb/{i}.png", "thermal_file_path": f"thermal/{i}_T.png"} for i in range(6)]
    for i, frame in enumerate(frames):
        write_image(tmp_path / frame["file_path"], photo(i))
        write_image(tmp_path / frame["thermal_file_path"], grey(i))
    visible = [frame["file_path"] for frame in frames]
    write_frames(tmp_path, frames, train_filenames=visible[:4], test_filenames=visible[4:])
    assert [f.name for f in loaded(tmp_path).test.frames] == ["4_T.png", "5_T.png"]


@pytest.mark.parametrize(("center", "used"), [((0.0, 0.0, 0.0), True), ((600.0, 0.0, 0.0), False)])
def test_a_model_of_images_that_are_called_otherwise_is_known_by_its_places(tmp_path, center, used):
    frames = [{"file_path": f"thermal/{i}_T.png"} for i in range(9)]
    for i, frame in enumerate(frames):
        write_image(tmp_path / frame["file_path"], grey(i))
    write_frames(tmp_path, frames)
    write_colmap(tmp_path, names(9), images=None, center=center)
    source = loaded(tmp_path, split="every_8th").notes["points_source"]
    assert ("(COLMAP)" in source) == used and ("units elsewhere" in source) != used


def test_a_model_of_two_cameras_is_matched_by_folders(tmp_path):
    files = [f"thermal/cam{camera}/{i}.png" for camera in (0, 1) for i in range(4)]
    for i, file in enumerate(files):
        write_image(tmp_path / file, grey(i))
    write_frames(tmp_path, [{"file_path": file} for file in files])
    write_colmap(tmp_path, [file.removeprefix("thermal/") for file in files], images=None)
    assert "(COLMAP)" in loaded(tmp_path, split="every_8th").notes["points_source"]


def timed(root, times, **options):
    """A scene whose frames have these times under these keys: [(key, value) or None], and what was noted."""
    for i, name in enumerate(names(len(times))):
        write_image(root / "thermal" / name, grey(i))
    frames = [
        {"file_path": f"thermal/{n}"} | dict([t] if t else []) for n, t in zip(names(len(times)), times, strict=True)
    ]
    write_frames(root, frames)
    return loaded(root, **options)


def times_of(scene):
    """Seconds after the first image, by name."""
    times = {frame.name: frame.time_s for views in (scene.train, scene.test) for frame in views.frames}
    return times if None in times.values() else {name: time - min(times.values()) for name, time in times.items()}


@pytest.mark.parametrize(
    ("times", "seconds"),
    [
        ([("time", 20.0), ("time", 30), ("time", 50.5)], [0.0, 10.0, 30.5]),
        ([("time_s", 5.0), ("time_s", 6.0), ("time_s", 9.0)], [0.0, 1.0, 4.0]),
        ([("time", f"2024-08-06T12:00:{s:02d}Z") for s in (0, 10, 40)], [0.0, 10.0, 40.0]),
    ],
)
def test_frames_have_the_times_that_the_file_gives_them(tmp_path, times, seconds):
    scene = timed(tmp_path, times)
    assert times_of(scene) == dict(zip(names(3), seconds, strict=True))
    assert scene.notes["time_source"].startswith("transforms.json, in seconds")
    assert "shares of the recording" not in scene.notes["time_source"]


def test_times_that_may_be_shares_are_told_and_a_table_comes_first(tmp_path):
    shares = [("time", k / 3) for k in range(4)]
    assert "if they are shares of the recording" in timed(tmp_path, shares).notes["time_source"]
    (tmp_path / "clock.csv").write_text("file,time_s\n" + "".join(f"{n},{60 * k}\n" for k, n in enumerate(names(4))))
    scene = loaded(tmp_path, time_csv="clock.csv")
    assert sorted(times_of(scene).values()) == [0.0, 60.0, 120.0, 180.0]
    assert scene.notes["time_source"] == "clock.csv, column time_s"


def test_without_times_there_are_none(tmp_path):
    scene = timed(tmp_path, [None, None, None])
    assert set(times_of(scene).values()) == {None} and scene.notes["time_source"].startswith("none")


@pytest.mark.parametrize(
    ("times", "told"),
    [
        ([("time", 0.0), None, ("time", 2.0)], r"transforms.json: frame_001.png has no time_s or time, which 2 of 3"),
        (
            [("time", 0.0), ("time", "noon"), ("time", 2.0)],
            r"time of thermal/frame_001.png is 'noon', neither seconds nor",
        ),
        ([("time", 0.0), ("time", [1]), ("time", 2.0)], r"time of thermal/frame_001.png"),
        ([("time", 0.0), ("time", float("nan")), ("time", 2.0)], r"time of thermal/frame_001.png"),
    ],
)
def test_times_that_are_none_are_refused(tmp_path, times, told):
    with pytest.raises(SceneError, match=told):
        timed(tmp_path, times)
