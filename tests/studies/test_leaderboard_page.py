"""The page of a leaderboard: one file whose data are whole, with pictures, and links only where they lead somewhere."""

import base64
import json
import re

import cv2
import numpy as np
from boards import ASKED, board, protocol_folder, run_of

from heatsplat.io.pictures import THERMAL
from heatsplat.studies.leaderboard.page import TEMPLATE, WIDTH, _picture, page
from heatsplat.studies.leaderboard.standings import standings


def content(text: str) -> dict:
    return json.loads(re.search(r"^const board = (.*);$", text, re.M)[1])


def test_the_page_has_all_entries_pictures_and_links(tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "sweep"
    run_of(sweep, "3dgs", "cooling", 0, 1.0)
    run_of(sweep, "etgs", "cooling", 0, -1.0)
    asked = board(root)
    found = standings(sweep, asked)
    text = page(found, asked, sweep)
    assert "http" not in text.replace("http://www.w3.org/2000/svg", "")  # self-contained
    told = content(text)
    (scene,) = told["scenes"]
    assert scene["name"] == "cooling" and [shown["view"] for shown in scene["pictures"]] == ["times_00008"]
    shown = scene["pictures"][0]
    assert set(shown["renders"]) == set(shown["errors"]) == {"3dgs", "etgs"}
    picture = np.frombuffer(base64.b64decode(shown["errors"]["3dgs"].partition(",")[2]), np.uint8)
    blue, _, red = cv2.imdecode(picture, cv2.IMREAD_COLOR).mean((0, 1))
    assert red > blue  # too warm
    entry = next(one for one in told["entries"] if one["method"] == "3dgs")
    assert entry["links"] == ["3dgs_cooling_steps_0/.hydra/config.yaml"] and len(entry["rank"]) == 2
    assert next(one for one in told["entries"] if one["method"] == "supirgs")["reason"].startswith("it is for")
    assert content(page(found, asked, None))["entries"][0]["links"] == []


def test_the_page_is_told_which_way_is_better(tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "cooling"), tmp_path / "sweep"
    for method, off in (("3dgs", 1.0), ("etgs", 0.1)):
        run_of(sweep, method, "cooling", 0, off)
    for first, higher in (("mae_c", False), ("psnr", True)):
        asked = board(root, protocol=ASKED["protocol"] | {"scores": [first]})
        told = content(page(standings(sweep, asked), asked, sweep))
        assert told["higher"] == higher and [one["method"] for one in told["beside"]] == ["etgs", "3dgs"]


def test_methods_that_ran_without_the_reference_stand_in_the_table(tmp_path):
    root, sweep = protocol_folder(tmp_path / "root", "cooling", "driven"), tmp_path / "sweep"
    run_of(sweep, "etgs", "cooling", 0, 1.0)
    asked = board(root)
    told = content(page(standings(sweep, asked), asked, sweep))["beside"]
    assert [(one["method"], one["beside"], one["scenes"]) for one in told] == [("etgs", None, 0)]
    assert told[0]["cost"]["gaussians"] == 1000
    run_of(sweep, "3dgs", "driven", 0, 1.0)
    told = content(page(standings(sweep, asked), asked, sweep))["beside"]
    assert [(one["method"], one["beside"], one["scenes"]) for one in told] == [("3dgs", 1.0, 1), ("etgs", None, 0)]


def test_pictures_are_no_wider_than_they_are_shown():
    assert f"figure img {{ display: block; width: {WIDTH}px;" in TEMPLATE.read_text(encoding="utf-8")
    halves = np.repeat([[0.0, 1.0]], 256, 0).repeat(160, 1)
    for values, size in ((halves, (160, WIDTH, 3)), (halves[:52, 128:192], (52, 64, 3))):
        stored = np.frombuffer(base64.b64decode(_picture(values, 0.0, 1.0, THERMAL).partition(",")[2]), np.uint8)
        picture = cv2.imdecode(stored, cv2.IMREAD_COLOR)
        assert picture.shape == size
        assert picture[:, : size[1] // 4].mean() + 80 < picture[:, -size[1] // 4 :].mean()  # dark and bright as before
