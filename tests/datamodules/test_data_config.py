import inspect
from itertools import islice
from pathlib import Path

import pytest
import pytorch_lightning as pl
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import get_class, instantiate
from layouts import names, write_colmap

from heatsplat.contracts import SceneError
from heatsplat.datamodules.base import SceneDataModule
from heatsplat.datamodules.colmap import Colmap

CONF = Path(__file__).parents[2] / "conf"
LOADERS = ("rhd", "thermoscenes", "nerfstudio", "ti_nsd", "colmap", "rgbt_scenes", "ntr", "thermo")


def config_of(data, *overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(overrides=["+seed=7", f"+data={data}", *overrides]).data


def loaders(loader):
    """A loader and those that it is built on, down to the one that all are."""
    return [owner for owner in loader.__mro__ if issubclass(owner, SceneDataModule)]


@pytest.mark.parametrize("data", LOADERS)
def test_every_option_of_a_loader_has_a_key_and_every_key_an_option(data):
    config = config_of(data)
    loader = get_class(config._target_)
    options = set()
    for owner in loaders(loader):
        options |= {k for k, p in inspect.signature(owner.__init__).parameters.items() if p.kind == p.KEYWORD_ONLY}
    assert set(config) - {"_target_"} == options
    assert config.seed == 7


@pytest.mark.parametrize("data", LOADERS)
def test_defaults_of_keys_and_options_agree(data):
    config = config_of(data)
    loader = get_class(config._target_)
    merged = {}
    for owner in reversed(loaders(loader)):
        parameters = inspect.signature(owner.__init__).parameters.values()
        merged |= {p.name: p.default for p in parameters if p.kind == p.KEYWORD_ONLY}
    merged.pop("seed")
    assert {key: config[key] for key in merged} == merged


@pytest.mark.parametrize("data", LOADERS)
def test_every_key_is_explained(data):
    text = "".join(
        (CONF / "data" / f"{file}.yaml").read_text() for file in ("shared/views", "shared/surroundings", data)
    )
    keys = [line for line in text.splitlines() if line and line[0] not in "# -_" and not line.startswith("defaults")]
    keys = [line for line in keys if not line.startswith("  ")]
    assert len(keys) > 12
    assert all("#" in line for line in keys), [line for line in keys if "#" not in line]


@pytest.mark.parametrize("data", LOADERS)
def test_a_loader_without_root_says_so(data):
    with pytest.raises(SceneError, match="data.root is not set"):
        instantiate(config_of(data), _convert_="all").setup()


def test_unknown_keys_are_refused():
    with pytest.raises(Exception, match="unexpected keyword argument 'downscal'"):
        instantiate(config_of("colmap", "+data.downscal=2"), _convert_="all")


class Recorder(pl.LightningModule):
    """Writes down which views it is trained on."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen = []

    def training_step(self, view, index):
        self.seen.append((self.global_step, view.frame.name))
        return self.weight * view.thermal.mean()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def fit(root, steps, resume=None):
    module = Recorder()
    trainer = pl.Trainer(
        max_steps=steps,
        max_epochs=-1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        accelerator="cpu",
        limit_val_batches=0,
    )
    trainer.fit(module, datamodule=Colmap(root=str(root), seed=3), ckpt_path=resume)
    return module.seen, trainer


@pytest.mark.filterwarnings("ignore")
def test_a_resumed_fit_sees_the_views_of_an_uninterrupted_one(tmp_path):
    write_colmap(tmp_path, names(9))
    whole, _ = fit(tmp_path, 25)
    first, trainer = fit(tmp_path, 11)
    trainer.save_checkpoint(tmp_path / "last.ckpt")
    rest, _ = fit(tmp_path, 25, resume=tmp_path / "last.ckpt")
    assert len(whole) == 25 and first + rest == whole
    assert len({name for _, name in whole[:7]}) == 7


def test_views_arrive_one_by_one(tmp_path):
    module = Colmap(root=str(write_colmap(tmp_path, names(9))))
    module.setup("fit")
    module.setup("test")
    assert [v.frame.name for v in module.test_dataloader()] == [f.name for f in module.scene.test.frames]
    assert len(list(module.val_dataloader())) == 2
    frames = module.scene.train.frames
    seen = islice(module.train_dataloader(), len(frames))  # it has no end
    assert sorted(view.frame.name for view in seen) == [frame.name for frame in frames]


def test_the_scene_is_loaded_once(tmp_path):
    module = Colmap(root=str(write_colmap(tmp_path, names(9))))
    assert module.scene is module.scene
