"""Maps of a model's attributes: which views, what the picture shows, and none without attributes or companions."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fake_run import HEIGHT, WIDTH, FakeModule, evaluate, events, fit, trainer, wall

from heatsplat.callbacks import attributes
from heatsplat.callbacks.attributes import (
    LEARNED_FILE,
    AttributeErrors,
    AttributeMaps,
    LearnedValues,
    attribute_picture,
)
from heatsplat.callbacks.metrics import QualityMetrics
from heatsplat.callbacks.report_text import learned_section
from heatsplat.contracts import Environment, ViewSet
from heatsplat.io.pictures import UNKNOWN
from heatsplat.io.tables import read_csv


class Telling(FakeModule):
    """Knows the emissivity and the age of the wall."""

    def attribute_maps(self, frame):
        ramp = torch.linspace(0.2, 0.8, WIDTH).expand(HEIGHT, WIDTH).clone()
        ramp[:5] = torch.nan
        return {"emissivity": ramp, "age": 3.0 + torch.zeros(HEIGHT, WIDTH)}


def test_maps_are_drawn_at_validation_and_at_the_end(tmp_path):
    module = Telling(wall(), tmp_path)
    watchers = [AttributeMaps(val_views=2, test_views=1)]
    fit(module, trainer(tmp_path, watchers, steps=4, every=2))
    evaluate(module, trainer(tmp_path, watchers))
    drawn = sorted(path.relative_to(tmp_path / "renders").as_posix() for path in tmp_path.glob("renders/*/*/*.png"))
    assert drawn == ["attributes/test/0009_000.png", "attributes/val/0006_000.png", "attributes/val/0008_002.png"]
    assert {"attributes/val/0006_000", "attributes/test/0009_000"} <= set(events(tmp_path).Tags()["images"])


def test_the_picture_shows_each_map_beside_its_bar(tmp_path):
    module = Telling(wall(), tmp_path)
    picture = attribute_picture(module, module.scene.test.frames[0])
    single = attribute_picture(FakeModule(wall(), tmp_path), module.scene.test.frames[0])
    assert single is None
    grey = np.isin(picture, UNKNOWN).all(axis=-1)
    factor = round(260 / HEIGHT)
    assert grey.sum() >= 5 * factor * WIDTH * factor  # what is not known
    colors = np.unique(picture.reshape(-1, 3), axis=0)
    assert len(colors) > 200  # the ramp runs through the whole map


def drawn(monkeypatch, maps):
    """Panels and columns of the picture of some maps."""
    found = []
    monkeypatch.setattr(attributes, "compose", lambda panels, title, columns: found.append((panels, columns)))
    attribute_picture(SimpleNamespace(attribute_maps=lambda frame: maps), wall().test.frames[0])
    return found[0]


def test_a_constant_is_a_number_and_names_are_words(tmp_path, monkeypatch):
    flat = 0.4312936 + 2e-7 * torch.rand(HEIGHT, WIDTH)
    ramp = torch.linspace(5.0, 9.0, WIDTH).expand(HEIGHT, WIDTH)
    maps = {"core_coupling": flat, "convection_w_m2_k": ramp, "mean_surface_c": flat + 11, "sun": torch.nan * flat}
    shown, columns = drawn(monkeypatch, maps)
    assert [panel.title for panel in shown] == ["core coupling", "convection", "mean surface", "sun"]
    texts = ["0.4313 everywhere", "", "11.43 °C everywhere", "known nowhere"]
    assert [panel.text for panel in shown] == texts
    assert [panel.bar and panel.bar.unit for panel in shown] == [None, "W/(m² K)", None, None]
    assert columns == 4
    monkeypatch.undo()
    module = Telling(wall(), tmp_path)
    module.attribute_maps = lambda frame: {f"map {i}": ramp * (1 + i) for i in range(13)}
    height, width = attribute_picture(module, module.scene.test.frames[0]).shape[:2]
    assert 0.5 < height / width < 2


def test_what_is_impossible_stands_in_the_title_of_a_map(monkeypatch):
    maps = {name: torch.linspace(0.0, 2.0, 101)[None] for name in ("absorptivity", "core_coupling")}
    shown, _ = drawn(monkeypatch, maps)
    assert [panel.title for panel in shown] == ["absorptivity: 50 % above 1, which is impossible", "core coupling"]


def test_models_without_attributes_or_companions_leave_nothing(tmp_path):
    module = FakeModule(wall(), tmp_path)
    watchers = [AttributeMaps(), QualityMetrics(lpips_net=None)]
    fit(module, trainer(tmp_path, watchers, steps=4, every=2))
    evaluate(module, trainer(tmp_path, watchers))
    assert not (tmp_path / "renders").exists()
    assert not [name for name in module.results.test if name.startswith("rgb")]
    assert not [name for name in read_csv(tmp_path / "test_per_image.csv")[0] if name.startswith("rgb")]


def test_companions_are_scored_as_images(tmp_path):
    class Joint(FakeModule):
        def validation_step(self, view, batch_idx):
            return super().validation_step(view, batch_idx) | {"companions": {"rgb": view.rgb * 0.9}}

        test_step = validation_step

    scene = wall()

    def decode(i):
        return replace(scene.test[i], rgb=torch.full((HEIGHT, WIDTH, 3), 0.5))

    module = Joint(replace(scene, test=ViewSet(scene.test.frames, decode)), tmp_path)
    evaluate(module, trainer(tmp_path, [QualityMetrics(lpips_net=None)]))
    assert abs(module.results.test["rgb_psnr"] - 20 * np.log10(1 / 0.05)) < 1e-4
    assert module.results.reasons["test.rgb_lpips"] == "not asked for"
    assert module.results.test["psnr"] != module.results.test["rgb_psnr"]


class Knowing(FakeModule):
    """Tells an absorptivity of 0.6 and a convection of 9 W/m²K of every Gaussian."""

    def attributes(self, frame):
        count = len(self.splats)
        return {
            "absorptivity": torch.full((count,), 0.6),
            "convection": torch.full((count,), 9.0),
            "age": torch.ones(count),
        }


class Table:
    """A thermal model whose table says an absorptivity of 0.9."""

    def prior(self, splats):
        return {"absorptivity": torch.full((len(splats),), 0.9)}


def test_errors_of_attributes_stand_beside_those_of_the_table(tmp_path):
    def truth(points):
        ones = torch.ones(len(points), dtype=torch.float64)
        return {"absorptivity": 0.7 * ones, "convection_w_m2_k": 12.0 * ones, "biot": ones}

    module = Knowing(replace(wall(), true_attributes=truth), tmp_path)
    module.thermal.prior = Table().prior
    evaluate(module, trainer(tmp_path, [AttributeErrors()]))
    errors = module.results.data["attribute_errors"]
    assert errors == {
        "absorptivity": pytest.approx(0.1),
        "convection": pytest.approx(3.0),
        "absorptivity, table": pytest.approx(0.2),
    }


def test_scenes_without_true_attributes_have_no_errors(tmp_path):
    module = Knowing(wall(), tmp_path)
    evaluate(module, trainer(tmp_path, [AttributeErrors()]))
    assert "attribute_errors" not in module.results.data


def learned(folder, monkeypatch, scene=None, times=1.0, **options):
    """What is written of a model of two Gaussians that training views show and a hundred that they hardly do."""
    scene = scene or wall()
    weights = torch.cat([torch.full((2,), 500.0), torch.full((100,), 1e-3)]).double()
    told = {
        "emissivity": times * torch.cat([torch.tensor([0.4, 0.8]), torch.full((100,), 0.1)]),
        "absent": torch.full((102,), torch.nan),
    }
    off = {"emissivity": torch.cat([torch.tensor([0.05, 0.05]), torch.full((100,), 9.0)])}
    seen = []
    monkeypatch.setattr(attributes, "shown", lambda module, views: seen.extend(views.frames) or weights)
    monkeypatch.setattr(attributes, "Uncertainty", lambda module: SimpleNamespace(of_attributes=lambda frame: off))
    taken = {frame.frame_id for frame in scene.frames}
    module = SimpleNamespace(
        scene=scene,
        # Of a view that no one took: a model that counts images by their numbers would tell of the first one alone.
        attributes=lambda frame: {} if frame.frame_id in taken else told,
        splats=SimpleNamespace(means=torch.arange(306.0).reshape(102, 3)),
        output_dir=folder,
    )
    LearnedValues(**options).on_test_epoch_end(None, module)
    assert len(seen) == min(len(scene.train), options.get("views", 32))
    return read_csv(folder / LEARNED_FILE)


def test_what_was_learned_counts_gaussians_by_what_views_show_of_them(tmp_path, monkeypatch):
    (row,) = learned(tmp_path, monkeypatch, views=3)
    assert (row["name"], row["low"], row["high"], row["deviation"]) == ("emissivity", 0.4, 0.8, None)
    text = "\n".join(learned_section(tmp_path))
    assert "0.4 to 0.8" in text and "90 % of what training views show" in text
    assert "±" not in text and "callbacks=uncertainty" in text


def test_how_far_the_value_of_one_gaussian_is_off_stands_beside_where_it_is_asked_for(tmp_path, monkeypatch):
    (row,) = learned(tmp_path, monkeypatch, deviations=True)
    assert row["deviation"] == 0.05
    text = "\n".join(learned_section(tmp_path))
    assert "± 0.05" in text and "median standard deviation" in text


def test_what_is_true_stands_beside_where_the_scene_knows_it(tmp_path, monkeypatch):
    """Over the Gaussians that views show, of which those that the model tells nothing of do not count."""

    def truth(points):
        assert points.shape == (102, 3)
        return {"emissivity": torch.cat([torch.tensor([0.5, 0.5]), torch.full((100,), 0.99)]).double()}

    (row,) = learned(tmp_path, monkeypatch, replace(wall(), true_attributes=truth))
    assert row["truth"] == 0.5 and row["median"] == 0.4
    text = "\n".join(learned_section(tmp_path))
    assert "| median | truth | 90 % interval | unit |" in text and "| emissivity | 0.4 | 0.5 | 0.4 to 0.8 |" in text
    assert "The truth is the median of what the scene has there." in text
    for scene in (wall(), replace(wall(), true_attributes=lambda points: {"biot": torch.ones(len(points))})):
        (row,) = learned(tmp_path, monkeypatch, scene)
        assert "truth" not in row and "truth" not in "\n".join(learned_section(tmp_path))
    mixed = attributes._true_median(torch.tensor([0.1, 0.2, 0.9]), np.array([np.nan, 0.5, np.nan]), np.ones(3))
    assert mixed == pytest.approx(0.2) and attributes._true_median(None, np.ones(3), np.ones(3)) is None


def test_what_no_surface_can_have_is_remarked(tmp_path, monkeypatch):
    (row,) = learned(tmp_path, monkeypatch)
    assert row["remark"] is None and "remark" not in "".join(learned_section(tmp_path))
    (row,) = learned(tmp_path, monkeypatch, times=2.0)
    told = "not told by these images: 50 % above 1, which is impossible"
    assert row["remark"] == told and told in "".join(learned_section(tmp_path))
    scene = wall()
    frames = [replace(frame, environment=Environment(irradiance_w_m2=0.0)) for frame in scene.train.frames]
    night = replace(scene, train=ViewSet(frames, scene.train._decode))
    (row,) = learned(tmp_path, monkeypatch, night, times=2.0)
    assert row["remark"] == f"{told}; none was taken in daylight"
