"""The moving picture: as many images as asked for, all of one size, in a file that stands alone."""

import torch
from fake_run import FakeModule, wall
from PIL import Image

from heatsplat.callbacks import turntable
from heatsplat.callbacks.turntable import TURNTABLE_FILE, Turntable
from heatsplat.io.pictures import compose


def test_it_turns(tmp_path):
    module = FakeModule(wall(), tmp_path)
    seen = iter(range(1, 9))
    module.predict = lambda frame: torch.full((frame.camera.height, frame.camera.width, 1), next(seen) / 9)
    Turntable(frames=5, size=48, milliseconds=80).on_test_epoch_end(None, module)
    with Image.open(tmp_path / TURNTABLE_FILE) as picture:
        assert picture.n_frames == 5 and picture.is_animated and picture.info["loop"] == 0
        assert picture.convert("RGB").getcolors(maxcolors=100_000) is not None and min(picture.size) > 100


def test_what_is_hotter_than_the_bar_is_told(tmp_path, monkeypatch):
    """As in a gap of the record, which no training image has shown."""
    shown = []

    def keep(panels, title):
        shown.append((panels[0], title))
        return compose(panels, title)

    monkeypatch.setattr(turntable, "compose", keep)
    module = FakeModule(wall(), tmp_path)
    module.predict = lambda frame: torch.full((frame.camera.height, frame.camera.width, 1), 0.95)
    Turntable(frames=1, size=48).on_test_epoch_end(None, module)
    panel, title = shown[0]
    assert panel.bar.above and not panel.bar.below
    assert panel.title.startswith("100 % above 4") and title == "240.0 s"


def test_runs_that_render_finer_than_their_images_turn_as_fine(tmp_path):
    sizes = []

    def predict(frame):
        sizes.append((frame.camera.width, frame.camera.height))
        return torch.full((frame.camera.height, frame.camera.width, 1), 0.5)

    for finer in (1, 4):
        module = FakeModule(wall(), tmp_path)
        module.predict, module.supersample = predict, finer
        Turntable(frames=1, size=4096).on_test_epoch_end(None, module)
    camera = wall().train.frames[0].camera
    assert sizes == [(camera.width, camera.height), (4 * camera.width, 4 * camera.height)]
