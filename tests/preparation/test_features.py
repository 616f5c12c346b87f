"""Features in a COLMAP database, and what is said where weights are missing."""

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
        Aliked()._networks  # noqa: B018
