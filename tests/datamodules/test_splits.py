import json

import numpy as np
import pytest
from layouts import names, viewmats, write_colmap

from heatsplat.contracts import SceneError
from heatsplat.datamodules.assemble import FITTED, build_scene
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.raw_scene import RawFrame, RawScene, SceneOptions
from heatsplat.datamodules.splits import SplitRule, block, by_folder, by_list, by_name, every_nth, quarter_centre


def test_every_8th_follows_plain_string_order():
    names = [f"{i}.png" for i in range(20)]
    train, test = every_nth(names)
    assert {names[i] for i in test} == set(sorted(names)[::8])
    assert sorted(train + test) == list(range(20))


def test_307_registered_views_give_the_39_test_views_that_ti_nsd_reports():
    assert len(every_nth([f"{i}.png" for i in range(307)])[1]) == 39


def test_all_trains_on_every_frame_and_says_what_scores_then_tell(tmp_path, caplog):
    files = names(11)
    write_colmap(tmp_path, files)
    caplog.set_level("INFO")
    scene = Colmap(root=str(tmp_path), split="all").scene
    assert [frame.name for frame in scene.train.frames] == files and len(scene.frames) == 11
    held_out = Colmap(root=str(tmp_path)).scene.test
    assert [frame.name for frame in scene.test.frames] == [frame.name for frame in held_out.frames]
    assert scene.notes["split_in_both"] == "2 test frames trained on, too: " + FITTED and FITTED in caplog.text
    assert not any(record.levelname == "WARNING" for record in caplog.records)


def test_every_so_many_th_training_frame_is_used_and_what_is_held_out_stays(tmp_path):
    files = names(21)
    write_colmap(tmp_path, files)
    whole, few = (Colmap(root=str(tmp_path), every=every).scene for every in (1, 3))
    named = [[frame.name for frame in views.frames] for views in (whole.train, few.train, whole.test, few.test)]
    assert named[1] == named[0][::3] and named[2] == named[3]
    assert "every" not in whole.notes and few.notes["every"] == "6 of 18, by data.every=3"
    assert few.notes["train_views"] == 6 and "split_left_out" not in few.notes
    shared = {frame.name: frame.frame_id for frame in whole.frames}
    assert all(shared[frame.name] == frame.frame_id for frame in few.frames)
    with pytest.raises(SceneError, match="data.every must be a whole number, 1 or more, got 0"):
        _ = Colmap(root=str(tmp_path), every=0).scene


def by_two(frames, every):
    data = RawScene("s", frames, np.random.default_rng(0).uniform(-1, 1, (30, 3)))
    scene = build_scene(data, SceneOptions(SplitRule("json"), every=every))
    return [frame.name for frame in scene.train.frames], scene.notes["every"]


def turned(named, lenses):
    """Frames in the order of their times, the last one for testing."""
    return [
        RawFrame(name, viewmats(3)[0], lens, lambda: np.zeros((32, 40), np.uint8), time_s=float(i),
                 subset="train" if i < len(named) - 1 else "test")
        for i, (name, lens) in enumerate(zip(named, lenses, strict=True))
    ]  # fmt: skip


def test_of_several_cameras_each_is_thinned_by_itself_in_the_order_of_time():
    wide, far = (Lens(focal, focal, 20.0, 16.0, 40, 32) for focal in (30.0, 60.0))
    files = [f"{i:03d}.png" for i in range(13)]
    taken, note = by_two(turned(files, [wide, far] * 6 + [wide]), 2)  # they take turns
    assert taken == [files[i] for i in (0, 1, 4, 5, 8, 9)] and note == "6 of 12, by data.every=2 of each of 2 cameras"
    folders = [f"{'left' if i % 2 else 'right'}/{i // 2}.png" for i in range(13)]
    assert by_two(turned(folders, [wide] * 13), 3)[0] == ["right/0.png", "left/0.png", "right/3.png", "left/3.png"]
    # A lens for each image, as some reconstructions fit them, or a folder, makes no camera of each.
    own = [Lens(30.0 + 0.01 * i, 30.0, 20.0, 16.0, 40, 32) for i in range(13)]
    assert by_two(turned(files, own), 2) == (files[:12:2], "6 of 12, by data.every=2")
    assert by_two(turned([f"{i:02d}/a.png" for i in range(13)], own), 4)[0] == ["00/a.png", "04/a.png", "08/a.png"]


def test_where_nothing_is_held_out_test_frames_are_some_of_those_used(tmp_path):
    write_colmap(tmp_path, files := names(21))
    scene = Colmap(root=str(tmp_path), split="all", every=2).scene
    used, tested = ([frame.name for frame in views.frames] for views in (scene.train, scene.test))
    assert used == files[::2] and tested == used[::8]
    assert scene.notes["split_in_both"] == "2 test frames trained on, too: " + FITTED


def test_quarter_centre_takes_the_middle_eighth_of_each_quarter():
    _, test = quarter_centre(range(221))
    # quarters of 55, 55, 55 and 56 frames: 6, 6, 6 and 7 test frames from (55 - 6) // 2 = 24 and (56 - 7) // 2 = 24 on
    expected = [q * 55 + 24 + k for q, count in enumerate((6, 6, 6, 7)) for k in range(count)]
    assert test == expected


def test_quarter_centre_follows_the_given_order():
    order = list(range(32))[::-1]
    assert quarter_centre(order)[1] == sorted(31 - i for i in quarter_centre(range(32))[1])


@pytest.mark.parametrize("count", [4, 5, 9, 40])
def test_quarter_centre_always_tests_something_in_each_quarter(count):
    train, test = quarter_centre(range(count))
    assert len(test) >= 4
    assert sorted(train + test) == list(range(count))


@pytest.mark.parametrize(("position", "first"), [(0.0, 0), (0.5, 15), (1.0, 30)])
def test_block_holds_out_one_stretch(position, first):
    _, test = block(range(40), fraction=0.25, position=position)
    assert test == list(range(first, first + 10))


def test_block_refuses_impossible_fractions():
    with pytest.raises(SceneError, match="data.split_fraction in"):
        SplitRule("block", fraction=1.5)


def test_names_and_folders():
    assert by_name(["frame_train_1.png", "a/frame_eval_2.png"]) == ([0], [1])
    assert by_folder(["train/1.png", "test/2.png", "x/val/3.png"]) == ([0], [1, 2])


def test_names_say_which_file_speaks_of_neither():
    with pytest.raises(SceneError, match="frame_003.png says neither.*data.split=every_8th"):
        by_name(["frame_train_001.png", "frame_003.png"])


def test_lists_in_text_and_json(tmp_path):
    names = ["a/1.png", "a/2.png", "a/3.png"]
    (tmp_path / "test.txt").write_text("2.png\n\n3\n")
    assert by_list(names, tmp_path / "test.txt") == ([0], [1, 2])
    (tmp_path / "split.json").write_text(json.dumps({"train": ["1"], "test": ["a/3.png"]}))
    assert by_list(names, tmp_path / "split.json") == ([0], [2])


def test_a_listed_name_is_the_frame_of_that_name_before_one_that_ends_so(tmp_path):
    path = tmp_path / "test.txt"
    path.write_text("b.png\n")
    assert by_list(["a/b.png", "b.png"], path) == ([0], [1])
    path.write_text("right/1\n")
    assert by_list(["left/1.png", "right/1.png"], path) == ([0], [1])


@pytest.mark.parametrize(
    "listed", ["images/2.png", "images\\2.png", "./images/2", "D:\\flight\\images\\2.PNG", "2.jpg"]
)
def test_lists_may_have_folders_and_endings_that_the_scene_has_not(tmp_path, listed):
    path = tmp_path / "test.txt"
    path.write_text(f"{listed}\n")
    assert by_list(["1.png", "2.png"], path) == ([0], [1])
    with pytest.raises(SceneError, match="which is no frame of the scene"):
        by_list(["1.png", "left/2.png"], path)


@pytest.mark.parametrize("listed", ["1.png", "1"])
def test_a_listed_name_that_several_frames_may_have_is_refused(tmp_path, listed):
    path = tmp_path / "test.txt"
    path.write_text(f"{listed}\n")
    with pytest.raises(
        SceneError, match=f"lists '{listed}', which may be left/1.png or right/1.png; write the name with"
    ):
        by_list(["left/1.png", "right/1.png"], path)


def test_lists_name_the_frame_that_does_not_exist(tmp_path):
    (tmp_path / "test.txt").write_text("9.png\n")
    with pytest.raises(SceneError, match=r"test.txt lists '9.png', which is no frame.*'1.png'"):
        by_list(["1.png"], tmp_path / "test.txt")


def test_lists_are_looked_for_in_the_scene_and_then_in_the_working_directory(tmp_path, monkeypatch):
    here, scene = tmp_path / "here", tmp_path / "data" / "flight"
    here.mkdir()
    scene.mkdir(parents=True)
    monkeypatch.chdir(here)
    module = Colmap(root=str(tmp_path / "data"), scene="flight", split="list", split_file="test.txt")
    asked = (["1.png", "2.png"], [0, 1], [None, None])
    with pytest.raises(
        SceneError, match=f"split_file=test.txt: there is no file {scene}/test.txt and no {here}/test.txt"
    ):
        module.split(*asked)
    (here / "test.txt").write_text("1.png")
    assert module.split(*asked) == ([1], [0])
    (scene / "test.txt").write_text("2.png")
    assert module.split(*asked) == ([0], [1])
    whole = SplitRule("list", file=here / "test.txt", folder=scene)
    assert whole(*asked) == ([1], [0])


def test_rules_that_leave_nothing_to_train_or_test_are_refused():
    with pytest.raises(SceneError, match="data.split=every_8th leaves 0 training and 1 test"):
        SplitRule("every_8th")(["a"], [0], [None])
    with pytest.raises(SceneError, match="data.split=json leaves 0 training and 0 test"):
        SplitRule("json")(["a"], [0], [None])


def test_what_is_no_split_is_refused_before_anything_is_read():
    with pytest.raises(SceneError, match="data.split must be one of every_8th, quarter_centre, .*, got 'thirds'"):
        SplitRule("thirds")
    with pytest.raises(SceneError, match="data.split=list needs data.split_file"):
        SplitRule("list")
    with pytest.raises(
        SceneError, match="data.split_file=a.txt has no effect with data.split=block: add data.split=list"
    ):
        SplitRule("block", file="a.txt")


def test_frames_in_both_lists_are_told(tmp_path, caplog):
    files = names(3)
    write_colmap(tmp_path, files)
    (tmp_path / "split.json").write_text(json.dumps({"train": files[:2], "test": files[1:]}))
    scene = Colmap(root=str(tmp_path), split="list", split_file="split.json").scene
    assert (len(scene.train), len(scene.test), len(scene.frames)) == (2, 2, 3)
    assert (
        f"data.split=list: training and test have 1 frame in common ({files[1]}), so that scores flatter" in caplog.text
    )
    assert scene.notes["split_in_both"] == "1 test frame trained on, too: " + FITTED
