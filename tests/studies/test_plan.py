"""Which runs a leaderboard asks for, and what it refuses."""

import pytest
from boards import board, protocol_folder

from heatsplat.contracts import SceneError


def test_every_method_meets_every_scene_once_for_each_seed(tmp_path):
    found = board(protocol_folder(tmp_path, "heath", "coarse_camera", "cooling"))
    assert found.scenes == ["cooling", "coarse_camera", "heath"]  # those of the protocol first, in its order
    jobs = found.jobs(["threads=1"])
    assert len(jobs) == 2 * (3 * 3 - 2) and jobs[0][-1] == "threads=1"
    methods = [next(text for text in job if text.startswith("method=")) for job in jobs]
    assert methods.count("method=supirgs") == 2  # on the coarse camera alone
    (coarse, *_) = [job for job in jobs if "method=supirgs" in job]
    assert {"data.scene=coarse_camera", "data.degrade=null", "callbacks.temperatures.image=clean"} <= set(coarse)
    assert {"max_steps=2000", "leaderboard.track=steps", "seed=0"} <= set(jobs[0])
    assert all("seed=0" in job for job in jobs[:7]) and all("seed=1" in job for job in jobs[7:])
    assert found.left_out("supirgs", "cooling").startswith("it is for low-resolution images")
    assert board(tmp_path, train=False).jobs() == []


def test_what_there_is_not_is_refused(tmp_path):
    with pytest.raises(SceneError, match="study=scenes study.target"):
        board(tmp_path)
    root = protocol_folder(tmp_path, "cooling")
    for asked, message in (
        ({"methods": ["4dgs"]}, "leaderboard.methods: there is no 4dgs; there are 3dgs, etgs, supirgs"),
        ({"scenes": ["glass"]}, "leaderboard.scenes: there is no glass; there are cooling"),
        ({"tracks": ["laps"]}, "leaderboard.tracks: there is no laps"),
        ({"root": None}, "leaderboard.root=FOLDER"),
    ):
        with pytest.raises(SceneError, match=message):
            board(root, **asked)
