"""Which runs a leaderboard asks for, and what it refuses."""

import pytest
from boards import ASKED, board, protocol_folder, submission
from omegaconf import OmegaConf
from running import compose_run

from heatsplat.contracts import SceneError
from heatsplat.studies.leaderboard.plan import board_of


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


def test_an_image_is_handed_in_behind_a_sensor_that_is_no_flaw_of_the_camera(tmp_path):
    methods = ["physir", "supirgs", "thermal3dgs", "3dgs"]
    asked = {**ASKED, "root": str(protocol_folder(tmp_path, "coarse_camera", "cooling")), "methods": methods}
    found = board_of(asked, methods)
    images = {method: [found.image(method, scene) for scene in found.scenes] for method in methods}
    assert found.scenes == ["cooling", "coarse_camera"]
    assert images == {
        "physir": ["thermal", "thermal"],
        "supirgs": ["thermal", "clean"],
        "thermal3dgs": ["thermal", "thermal"],
        "3dgs": ["thermal", "clean"],  # has no sensor: they are one
    }
    for job in found.jobs():
        (image,) = (text for text in job if text.startswith("callbacks.temperatures.image="))
        method, scene = (next(t for t in job if t.startswith(key)).split("=")[1] for key in ("method=", "data.scene="))
        assert image.endswith(f"={found.image(method, scene)}")


def test_equal_seconds_are_those_of_the_boards_clock(tmp_path):
    root = protocol_folder(tmp_path, "cooling")
    jobs = {
        clock: board(root, clock=clock, tracks=["steps", "seconds"]).jobs()
        for clock in ("cpu_seconds", "train_seconds")
    }
    timed = {clock: ["budget_clock=cpu_seconds" in job for job in own] for clock, own in jobs.items()}
    assert timed["cpu_seconds"] == [any(text.startswith("budget=") for text in job) for job in jobs["cpu_seconds"]]
    assert {*timed["cpu_seconds"]} == {False, True} and not any(timed["train_seconds"])


def test_a_word_or_number_is_a_list_of_one(tmp_path):
    root = protocol_folder(tmp_path / "root", "cooling", "coarse_camera")
    theirs = str(submission(tmp_path / "theirs", 0.1))
    found = board(root, methods="etgs", scenes="cooling", tracks="steps", seeds=0, submissions=theirs)
    assert [found.methods, found.scenes, found.tracks, found.seeds] == [["etgs"], ["cooling"], ["steps"], [0]]
    assert len(found.submissions) == 1


def test_what_there_is_not_is_refused(tmp_path):
    with pytest.raises(SceneError, match="study=scenes study.target"):
        board(tmp_path)
    root = protocol_folder(tmp_path, "cooling")
    for asked, message in (
        ({"methods": ["4dgs"]}, "leaderboard.methods: there is no 4dgs; there are 3dgs, etgs, supirgs"),
        ({"scenes": ["glass"]}, "leaderboard.scenes: there is no glass; there are cooling"),
        ({"tracks": ["laps"]}, "leaderboard.tracks: there is no laps"),
        ({"root": None}, "leaderboard.root=FOLDER"),
        (
            {"protocol": ASKED["protocol"] | {"scores": ["mae"]}},
            "each of scores of the protocol must be one of mae_c, psnr, .*'mae'",
        ),
        (
            {"protocol": ASKED["protocol"] | {"reference": "3dg"}},
            "the protocol's reference must be one of 3dgs, etgs, .* '3dg'",
        ),
        ({"clock": "seconds"}, "leaderboard.clock must be one of train_seconds, cpu_seconds, got 'seconds'"),
        ({"seeds": ["a"]}, "leaderboard.seeds must be a whole number, 0 or more, got a"),
    ):
        with pytest.raises(SceneError, match=message):
            board(root, **asked)


def test_what_the_board_decides_is_not_given_for_all_runs(tmp_path):
    root = protocol_folder(tmp_path, "cooling")
    for key, instead in (("method", "methods"), ("data.scene", "scenes"), ("seed", "seeds")):
        with pytest.raises(SceneError, match=rf"{key}=.*choose among them with leaderboard.{instead}=\[...\]"):
            board(root, given=["max_steps", key])
    assert board(root, given=["max_steps"]).methods


def test_the_command_is_refused_before_anything_runs(tmp_path, monkeypatch, caplog):
    compose_run("method=3dgs")
    # Imported here: composing loads plugins, and with them the classes that sweep, anew.
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

    from hydra_plugins.heatsplat_sweeper.rows import RowSweeper

    started = []
    monkeypatch.setattr(BasicSweeper, "sweep", lambda self, arguments: started.append(arguments))
    root = protocol_folder(tmp_path / "root", "cooling")
    taken = submission(tmp_path / "theirs", 0.1, method="3dgs")
    for asked, arguments, message in (
        ({}, ["experiment=leaderboard", "seed=0,1"], "leaderboard.seeds=[...]"),
        (
            {},
            ["experiment=leaderboard", "threads=1", "max_steps=5,9"],
            "max_steps: a leaderboard has one run of each method,",
        ),
        ({"submissions": [str(taken)]}, ["experiment=leaderboard"], "give the submission another name"),
        ({"earlier": str(tmp_path / "none.html")}, ["experiment=leaderboard"], "cannot be read"),
    ):
        sweeper = RowSweeper()
        loader = type("Loader", (), {"get_group_options": lambda self, group: ["3dgs"]})()
        sweeper.hydra_context = type("Context", (), {"config_loader": loader})()
        sweeper.config = OmegaConf.create(
            {"leaderboard": {**ASKED, "root": str(root), **asked}, "hydra": {"sweep": {"dir": str(tmp_path / "sweep")}}}
        )
        with pytest.raises(SystemExit):
            sweeper.sweep(arguments)
        assert message in caplog.messages[-1] and started == []


def test_a_submission_has_a_name_of_its_own_and_a_track_of_the_board(tmp_path):
    """With a name of ours it would count as another seed of that method; in a track that there is not it would vanish."""
    root = protocol_folder(tmp_path / "root", "cooling")
    for told, message in (
        (
            {"method": "3dgs"},
            r'metrics.json: "method" is 3dgs, a method of heatsplat; give the submission another name',
        ),
        (
            {"method": "supirgs"},
            "give the submission another name",
        ),  # not on this board, but perhaps on an earlier page
        ({"track": "laps"}, r'metrics.json: "track" is laps; this board has steps. Name one'),
        ({"scenes": {"cooling": 12}}, "scenes.cooling is 12"),
        ({"method": "ours\nand theirs"}, 'metrics.json needs "method": a name'),
        ({"method": " "}, 'metrics.json needs "method": a name'),
    ):
        folder = submission(tmp_path / "theirs", 0.1, **told)
        with pytest.raises(SceneError, match=message):
            board(root, methods=["3dgs"], submissions=[str(folder)])
    (found,) = board(root, submissions=[str(submission(tmp_path / "theirs", 0.1))]).submissions
    assert (found.method, found.track, found.command) == ("theirs", "steps", "a submission")
    assert found.scores["cooling"].mean("mae_c") == pytest.approx(0.1, abs=1e-5)


def test_two_runs_of_other_code_are_two_seeds(tmp_path):
    """Of two that say the same seed one would count, without a word."""
    root = protocol_folder(tmp_path / "root", "cooling")
    first, second = (str(submission(tmp_path / name, 0.1, seed=0)) for name in ("first", "second"))
    with pytest.raises(SceneError, match=r"first and .*second both hand in seed 0 of theirs on cooling: .* leave one"):
        board(root, submissions=[first, second])
    assert len(board(root, submissions=[first, f"{second}/../first"]).submissions) == 1  # the same folder
    submission(tmp_path / "second", 0.1, seed=1, machine="RTX 4090")
    assert [one.machine for one in board(root, submissions=[first, second]).submissions] == ["", "RTX 4090"]
