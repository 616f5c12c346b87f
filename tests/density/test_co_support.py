"""Co-support pruning: every modality has to see a Gaussian; all else is adaptive; both bands pull."""

import pytest
import torch

from heatsplat.contracts import Camera, SceneError
from heatsplat.density.adaptive import Adaptive
from heatsplat.density.co_support import CoSupport
from heatsplat.density.ops import Cloud
from heatsplat.renderers.settings import Renderer
from heatsplat.splats import Splats


def control(kind=CoSupport, **options):
    return kind(**{"start": 0, "stop": 100, "every": 10, "reset_every": 1000} | options)


def make_cloud(policy, opacities):
    """Gaussians with opacities [N, M] and an optimiser that has stepped once."""
    opacities = torch.tensor(opacities)
    count = len(opacities)
    splats = Splats(
        {
            "means": torch.arange(3.0 * count).reshape(count, 3),
            "log_scales": torch.full((count, 3), -4.0),
            "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
            "opacity_logits": torch.logit(opacities),
            "emissivity": torch.arange(float(count)).reshape(count, 1, 1),
        }
    )
    optimizer = torch.optim.Adam([{"params": [splats[name]], "name": name, "lr": 0.0} for name in splats.names])
    for name in splats.names:
        splats.raw[name].grad = splats[name].detach().clone()
    optimizer.step()
    return Cloud(splats, optimizer, policy.initial_state(count, torch.device("cpu")))


def refine(policy, cloud, step=9):
    return policy.refine(cloud, step, extent=1.0, generator=torch.Generator().manual_seed(0))


BANDS = [[0.5, 0.5], [0.004, 0.5], [0.5, 0.004], [0.006, 0.006], [0.001, 0.001]]


def test_a_gaussian_stays_that_every_modality_sees():
    policy = control(prune_scale=100.0)
    cloud = make_cloud(policy, BANDS)
    change = refine(policy, cloud)
    assert (change.added, change.removed, len(cloud)) == (0, 3, 2)
    assert cloud.splats["emissivity"].flatten().tolist() == [0.0, 3.0]
    moments = cloud.optimizer.state[cloud.splats["emissivity"]]["exp_avg"].flatten().tolist()
    assert moments == pytest.approx([0.0, 0.3])  # rows and moments go together


def test_adaptive_asks_for_one_modality():
    policy = control(Adaptive)
    cloud = make_cloud(policy, BANDS)
    assert refine(policy, cloud).removed == 1
    assert cloud.splats["emissivity"].flatten().tolist() == [0.0, 1.0, 2.0, 3.0]


def test_it_is_adaptive_where_all_are_seen():
    results = []
    for policy in (control(Adaptive), control()):
        cloud = make_cloud(policy, [[0.5, 0.3], [0.4, 0.2], [0.9, 0.9]])
        cloud.state["gradient"], cloud.state["seen"] = torch.tensor([1e-3, 0.0, 1e-3]), torch.ones(3)
        changes = [refine(policy, cloud, step) for step in (5, 9)]
        results.append((changes, [cloud.splats[name].detach() for name in cloud.splats.names]))
    assert results[0][0] == results[1][0] and results[0][0][0] is None and results[0][0][1].added == 2
    assert all(torch.equal(one, two) for one, two in zip(results[0][1], results[1][1], strict=True))


def test_nothing_happens_between_refinements():
    policy = control()
    cloud = make_cloud(policy, BANDS)
    assert refine(policy, cloud, 5) is None and len(cloud) == 5


def test_a_reset_prunes_none_that_it_lowered():
    policy = control(reset_every=10, reset_opacity=0.01)
    cloud = make_cloud(policy, [[0.5, 0.5], [0.9, 0.02]])
    change = refine(policy, cloud, 9)
    assert change.opacity_reset and len(cloud) == 2
    assert cloud.splats.opacities.max().item() == pytest.approx(0.01)


def test_an_empty_cloud_is_an_error_that_says_why():
    policy = control()
    with pytest.raises(SceneError, match="would prune all 2 Gaussians at step 9: each has an opacity below 0.005"):
        refine(policy, make_cloud(policy, [[0.001, 0.5], [0.5, 0.001]]))


# Both bands pull ------------------------------------------------------------------------------------


def pulls(weights):
    """Gradients of geometry, opacities [2, N] and the density statistic for a loss of (thermal, colour) weights."""
    generator = torch.Generator().manual_seed(3)
    count = 12
    means = torch.rand(count, 3, generator=generator) - 0.5
    geometry = {
        "means": means + torch.tensor([0.0, 0.0, 3.0]),
        "quats": torch.randn(count, 4, generator=generator),
        "scales": torch.full((count, 3), 0.15) * (1 + torch.rand(count, 3, generator=generator)),
    }
    geometry = {name: tensor.requires_grad_() for name, tensor in geometry.items()}
    opacities = (0.2 + 0.6 * torch.rand(2, count, generator=generator)).requires_grad_()
    features = torch.rand(count, 4, generator=generator)
    camera = Camera(torch.eye(4), torch.tensor([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]]), 32, 32)
    renderer = Renderer(backend="cpu", background=0.0)
    output = renderer(*geometry.values(), opacities, lambda ids: features[ids], camera, None, (1, 3))
    heat, color = output.features.split((1, 3), dim=-1)
    (weights[0] * heat.square().sum() + weights[1] * color.square().sum()).backward()
    policy = CoSupport()
    state = policy.initial_state(count, torch.device("cpu"))
    policy.observe(state, output, camera, step=0)
    found = {name: tensor.grad for name, tensor in geometry.items()}
    return found | {
        "thermal": opacities.grad[0],
        "rgb": opacities.grad[1],
        "means2d": output.meta["means2d"].grad,
    }, state


def test_both_bands_pull_geometry_and_the_statistic_and_each_its_own_opacity():
    (heat, heat_state), (color, color_state), (both, both_state) = pulls((1, 0)), pulls((0, 1)), pulls((1, 1))
    for name in ("means", "quats", "scales", "means2d"):
        assert heat[name].abs().max() > 1e-3 and color[name].abs().max() > 1e-3, name
        assert torch.allclose(both[name], heat[name] + color[name], rtol=1e-4, atol=1e-4), name
    assert heat["rgb"].abs().max() == 0 and color["thermal"].abs().max() == 0
    assert torch.allclose(both["thermal"], heat["thermal"], atol=1e-5)
    ndc = 16.0  # half the image, in pixels
    assert torch.allclose(both_state["gradient"], ndc * both["means2d"].norm(dim=1), rtol=1e-5)
    assert heat_state["gradient"].sum() > 0 and color_state["gradient"].sum() > 0
