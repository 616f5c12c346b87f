"""Every method on CUDA: steps, images and attributes; where there is no GPU on an emulated one, which refuses mixed devices."""

import contextlib
from importlib.util import find_spec

import pytest
import torch
from emulated_cuda import OnDevice, emulated_cuda
from helpers import ALL_METHODS
from running import TINY

from heatsplat.composition import build, compose
from heatsplat.runs.stepping import Stepper

QUICK = {
    "etgs",
    "scaffold_gs",
    "ravigs",
    "instant_ngp",
    "supirgs",
}  # in ``make test``, as every kind of rows and sensor
SCENES = {"energy_balance": "outdoor_true", "thermogs": "outdoor"}
METHODS = sorted(set(ALL_METHODS) - {"auto"})  # its parts depend on the scene
FIELDS = {"instant_ngp", "thermonerf"}
FEW = {"scaffold_gs": "init.voxel=0.5"}  # Gaussians, which the emulated device renders slowly; a hundred of the others
REAL = torch.cuda.is_available() and find_spec("gsplat") is not None


@pytest.mark.parametrize(
    "method", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in METHODS]
)
def test_steps_and_images(method):
    scene_name = [f"data.scene={SCENES[method]}"] if method in SCENES else []
    renderer = [] if REAL or method in FIELDS else ["renderer=reference"]
    few = [FEW.get(method, "init.count=100")] if method not in FIELDS else []
    plain = compose([*TINY, "max_steps=4", *few, f"method={method}", *scene_name, *renderer])
    scene, module = build(plain["data"]).scene, build(plain["module"])
    with contextlib.nullcontext("cuda") if REAL else emulated_cuda() as device:
        stepper = Stepper(module, scene, step=0, device=device)
        for k in range(2):
            module.trainer.global_step = k
            stepper.step(scene.train[k])
        trained = [x for x in module.parameters() if x.grad is not None]
        assert trained and all(x.is_cuda and x.grad.is_cuda for x in trained)
        frame = (scene.test if len(scene.test) else scene.train).frames[0]
        images = module.predict_all(frame)
        assert all(image.is_cuda and bool(image.isfinite().all()) for image in images.values())
        assert all(not image.is_cuda or image.ndim == 2 for image in module.attribute_maps(frame).values())


def test_the_emulated_device_refuses_what_cuda_refuses():
    with emulated_cuda() as device:
        there = torch.rand(4, 3).to(device).requires_grad_()
        assert (there.device, there.is_cuda, torch.zeros(2, device=device).is_cuda) == (device, True, True)
        for mixed in (
            lambda: there + torch.ones(3),
            lambda: torch.cat([there, torch.ones(1, 3)]),
            lambda: torch.ones(5)[torch.arange(2, device=device)],
            lambda: torch.rand(3, generator=torch.Generator(), device=device),
        ):
            with pytest.raises(RuntimeError, match="device"):
                mixed()
        with pytest.raises(TypeError, match="convert cuda:0 device"):
            there.detach().numpy()
        (there[torch.tensor([1, 2])] * 2 + 1.0).sum().backward()
        assert isinstance(there.grad, OnDevice) and there.grad.cpu().sum().item() == 12.0
        there.detach().view(-1)[2:3].fill_(7.0)
        assert there[0, 2].item() == 7.0
        layer = torch.nn.Linear(3, 2).to(device)
        optimizer, before = torch.optim.Adam(layer.parameters()), layer.weight.detach().cpu().clone()
        layer(there).square().sum().backward()
        optimizer.step()
        assert not torch.equal(layer.weight.detach().cpu(), before)
