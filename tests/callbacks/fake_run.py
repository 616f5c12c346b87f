"""A training module small enough for tests of callbacks: a wall whose grey value it learns, seen by a few cameras."""

import warnings
from pathlib import Path

import pytorch_lightning as pl
import torch
from pytorch_lightning.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, View, ViewSet
from heatsplat.io.results import RunResults
from heatsplat.sensors.base import SensorChain
from heatsplat.splats import Splats
from heatsplat.training.rng import generator_for
from heatsplat.training.schedule import Schedule

RANGE = ThermalRange(10.0, 50.0)
HEIGHT, WIDTH = 40, 56
SECONDS = 600.0


def warmth(time_s):
    """Image value of the wall at a time: it cools towards 0.2."""
    return 0.2 + 0.6 * torch.exp(-torch.as_tensor(time_s, dtype=torch.float64) / 300.0)


def camera(position):
    """Looks along +z at a wall in the plane z = 4; moves sideways."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -position
    K = torch.tensor([[60.0, 0, WIDTH / 2], [0, 60.0, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, WIDTH, HEIGHT)


def views(split, count, first_id, channels=1, modality="thermal"):
    """Images of the wall: warm on its left half, at 0.1 on the right, with noise."""
    frames = [
        Frame(f"{split}/{i:03d}.png", first_id + i, camera(0.05 * i), SECONDS * i / max(1, count - 1))
        for i in range(count)
    ]

    def decode(i):
        image = torch.full((HEIGHT, WIDTH, channels), 0.1)
        image[:, : WIDTH // 2] = float(warmth(frames[i].time_s))
        noise = 0.004 * torch.randn(image.shape, generator=generator_for(0, frames[i].frame_id, "noise"))
        mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
        mask[:3, :3] = False
        return View(frames[i], mask=mask, **{modality: (image + noise).clamp(0, 1)})

    return ViewSet(frames, decode)


def wall(thermal_range=RANGE, truth=True, channels=1, modality="thermal"):
    """The scene."""
    points = torch.rand(300, 3, generator=generator_for(0, 0, "points")) * torch.tensor([2.0, 1.5, 0.0])
    points = points + torch.tensor([-1.0, -0.75, 4.0])
    known = {"channels": channels, "modality": modality}
    return SceneData(
        name="wall",
        train=views("train", 6, 0, **known),
        val=views("val", 3, 6, **known),
        test=views("test", 4, 9, **known),
        points=points,
        thermal_range=thermal_range,
        notes={"timestamps": "from file names", "root": Path("somewhere")},
        probes=torch.tensor([[-0.5, 0.0, 4.0], [0.5, 0.2, 4.0]]) if truth else None,
        truth=(lambda points, times: RANGE.to_celsius(warmth(times)).expand(len(points), -1)) if truth else None,
    )


class Emitter(torch.nn.Module):
    """Stands for a thermal model with time."""

    needs = frozenset({"time"})
    cost = 7

    def effects(self):
        return {"newton_cooling": {"ambient": "learned"}}


class FakeModule(pl.LightningModule):
    """Learns the wall's value; keeps every promise that callbacks rely on."""

    def __init__(self, scene, output_dir, config=None, poison=None):
        super().__init__()
        generator = generator_for(0, 0, "splats")
        tensors = {
            "means": scene.points,
            "log_scales": torch.randn(300, 3, generator=generator),
            "quats": torch.ones(300, 4),
        }
        self.splats = Splats(tensors | {"opacity_logits": torch.zeros(300, 1)})
        self.scene, self.output_dir, self.config = scene, Path(output_dir), config or {}
        self.thermal, self.sensor = Emitter(), SensorChain()
        self.modality = "thermal" if scene.train[0].thermal is not None else "rgb"
        self.channels = scene.train[0].image(self.modality).shape[-1]
        self.results, self.density_change = RunResults(), None
        self.schedule, self.supersample = Schedule(8), 1
        self.value = torch.nn.Parameter(torch.tensor(0.9))
        self.poison = poison or {}
        self.calls = 0

    def predict(self, frame):
        self.calls += 1
        image = torch.full((frame.camera.height, frame.camera.width, self.channels), 0.1)
        image[:, : WIDTH // 2] = self.value.detach() * float(warmth(frame.time_s))
        return image.clamp(0, 1)

    def attribute_maps(self, frame):
        return {}

    def training_step(self, view, batch_idx):
        target = view.image(self.modality)[:, : WIDTH // 2].mean()
        data = (self.value * float(warmth(view.time_s)) - target).square()
        prior = 1e-6 * self.splats.raw["log_scales"].square().mean()
        terms = {"data": data, "prior": prior}
        if self.poison.get("loss") == self.global_step:
            terms["prior"] = prior * float("nan")
        if self.poison.get("gradient") == self.global_step:
            terms["prior"] = prior + (self.splats.raw["quats"][5, 2] * 0).sqrt()  # 0 in value, NaN in gradient
        return {"loss": sum(terms.values()), "terms": {name: term.detach() for name, term in terms.items()}}

    def validation_step(self, view, batch_idx):
        return {"view": view, "prediction": self.predict(view.frame), "seconds": 0.001}

    test_step = validation_step

    def transfer_batch_to_device(self, batch, device, dataloader_idx):
        return batch.to(device)

    def configure_optimizers(self):
        groups = [{"params": [p], "name": name, "lr": 1e-3} for name, p in self.splats.raw.items()]
        return torch.optim.Adam([*groups, {"params": [self.value], "name": "value", "lr": 0.05}])


def loader(items, steps=None):
    """Views one by one, repeated to a number of steps."""
    positions = range(len(items)) if steps is None else [i % len(items) for i in range(steps)]
    return torch.utils.data.DataLoader(items.subset(positions), batch_size=None)


def trainer(tmp_path, callbacks, steps=12, every=6, **options):
    """A trainer as the configuration makes it, writing into ``tmp_path``."""
    options = {"logger": TensorBoardLogger(str(tmp_path), name="tb", version="", default_hp_metric=False)} | options
    return pl.Trainer(
        accelerator="cpu",
        max_steps=steps,
        val_check_interval=every,
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=any(isinstance(c, pl.callbacks.ModelCheckpoint) for c in callbacks),
        callbacks=callbacks,
        **options,
    )


def fit(module, run, ckpt=None):
    """Trains the module; data loaders as long as the run. Lightning's advice on such short runs is not for tests."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run.fit(module, loader(module.scene.train, run.max_steps), loader(module.scene.val), ckpt_path=ckpt)


def evaluate(module, run):
    """Tests the module."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run.test(module, loader(module.scene.test), verbose=False)


def events(tmp_path):
    """What TensorBoard holds."""
    found = EventAccumulator(str(tmp_path / "tb"), size_guidance={"images": 0, "scalars": 0})
    return found.Reload()
