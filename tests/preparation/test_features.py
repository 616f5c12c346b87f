"""Features in a COLMAP database, and what is said where weights are missing."""

import re

import cv2
import numpy as np
import pycolmap
import pytest
import torch

from heatsplat.contracts import SceneError
from heatsplat.preparation.features import WEIGHTS, Aliked, Sift


def test_sift_finds_a_shifted_picture_again(tmp_path):
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 255, (160, 220), np.uint8), (0, 0), 3)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    names = ["thermal/a.png", "thermal/b.png"]
    (tmp_path / "thermal").mkdir()
    for name, left in zip(names, (0, 20), strict=True):
        cv2.imwrite(str(tmp_path / name), picture[:, left : left + 200])
    database = tmp_path / "database.db"
    sift = Sift(most=500)
    for name in names:
        sift.extract(database, tmp_path, name, pycolmap.ImageReaderOptions(camera_model="PINHOLE"))
    sift.match(database, [(names[0], names[1])], tmp_path / "pairs.txt", 0)
    with pycolmap.Database.open(database) as opened:
        assert opened.num_images() == 2
        one, other = (image.image_id for image in opened.read_all_images())
        pairs = opened.read_matches(one, other)
        apart = opened.read_keypoints(one)[pairs[:, 0], :2] - opened.read_keypoints(other)[pairs[:, 1], :2]
    assert len(pairs) > 30 and np.abs(np.median(apart, axis=0) - [20, 0]).max() < 0.2


def test_missing_weights_are_named_with_their_place(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(SceneError, match=f"{WEIGHTS[0]} and {WEIGHTS[1]} into .*checkpoints"):
        Aliked()


def test_aliked_and_lightglue_take_their_weights_as_they_were_released(tmp_path, monkeypatch):
    from kornia.feature import ALIKED, LightGlue

    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    torch.manual_seed(0)
    networks = ALIKED("aliked-n16"), LightGlue(None, input_dim=128, weights=None)
    for network, name in zip(networks, WEIGHTS, strict=True):
        state = {
            re.sub(r"^transformers.(\d+).(self|cross)_attn", r"\2_attn.\1", k): v
            for k, v in network.state_dict().items()
        }
        torch.save(state, tmp_path / "checkpoints" / name)
    names, database, aliked = ["a.png", "b.png"], tmp_path / "database.db", Aliked(most=30)
    for network, loaded in zip(networks, aliked._networks, strict=True):
        assert all(torch.equal(v, loaded.state_dict()[k]) for k, v in network.state_dict().items())
    for name in names:
        cv2.imwrite(str(tmp_path / name), np.random.default_rng(0).integers(0, 255, (64, 96), np.uint8))
        aliked.extract(database, tmp_path, name, pycolmap.ImageReaderOptions(camera_model="PINHOLE"))
    aliked.match(database, [(names[0], names[1])], tmp_path / "pairs.txt", 0)
    with pycolmap.Database.open(database) as opened:
        assert [opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()] == [30, 30]
    torch.save({"other": torch.zeros(1)}, tmp_path / "checkpoints" / WEIGHTS[1])
    with pytest.raises(SceneError, match=f"{WEIGHTS[1]} lacks .* weights of LightGlue"):
        Aliked()._networks  # noqa: B018
