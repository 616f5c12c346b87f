"""Loss composition: names, weights, schedules and absence."""

import pytest
import torch

from heatsplat.composition import build, compose
from heatsplat.contracts import Camera
from heatsplat.losses import schedules
from heatsplat.losses.compose import During, Loss, LossInputs, LossTerm, Weighted, known_target, pixel_errors, summands
from heatsplat.losses.low_resolution import OnTargetGrid
from heatsplat.losses.modality_balance import ByOthersShare
from heatsplat.losses.photometric import Photometric


def at(step):
    image = torch.full((2, 2, 1), 3.0, requires_grad=True)
    return LossInputs(image, torch.zeros(2, 2, 1), None, view=None, splats=None, step=step, progress=step / 100)


class Mean(LossTerm):
    def __call__(self, inputs):
        return inputs.prediction.mean()


class Parts(LossTerm):
    def __call__(self, inputs):
        return {"a": inputs.prediction.mean(), "b": 2 * inputs.prediction.mean()}


class Never(LossTerm):
    def __call__(self, inputs):
        pytest.fail("a term of weight zero was evaluated")


mean = Mean()


@pytest.mark.parametrize("finer", [1, 2])
def test_density_control_is_told_of_no_masked_pixel(finer):
    """Of a finer render either, where what stands in masked pixels was taken for the scene."""
    camera = Camera(torch.eye(4), torch.eye(3), 3 * finer, 2 * finer)
    mask = torch.tensor([[True, False, True], [True, True, False]])
    target = torch.where(mask, 0.25, 7.0)[..., None]
    inputs = LossInputs(torch.full((2 * finer, 3 * finer, 1), 0.5), target, mask, view=None, splats=None)
    counts = mask.repeat_interleave(finer, 0).repeat_interleave(finer, 1)
    found = known_target(inputs, camera)[..., 0]
    assert torch.equal(~found.isnan(), counts) and torch.allclose(found[counts], torch.tensor(0.25))
    assert torch.allclose(pixel_errors(inputs, camera), torch.where(counts, 0.25, 0.0))


def test_names_join_term_and_part():
    values = Loss({"plain": mean, "photometric": Parts()})(at(0))
    assert {name: value.item() for name, value in values.items()} == {
        "plain": 3.0,
        "photometric/a": 3.0,
        "photometric/b": 6.0,
    }


def test_a_term_that_is_none_is_absent():
    assert list(Loss({"plain": mean, "edge": None})(at(0))) == ["plain"]


def check(terms, steps=100):
    Loss(terms).check([step / steps for step in range(steps)])


def test_steps_at_which_nothing_is_compared_are_refused():
    check({"first": During(mean, stop=0), "second": During(mean, start=0, stop=100)})
    check({"first": During(mean, stop=0), "second": mean})
    for stop, first in ((0, "never"), (4, "from 0 to 3")):
        told = f"counts at step {stop} of 0 to 99; change .* loss.terms: first {first}, second from 5 to 99"
        with pytest.raises(ValueError, match=told):
            check({"first": During(mean, stop=stop), "second": During(mean, start=5)})
    with pytest.raises(ValueError, match="counts at step 4 of 0 to 99; .* first from 0 to 3, second from 5 to 8"):
        within = During(Weighted(OnTargetGrid(During(ByOthersShare(During(mean, stop=9), 0), start=5)), 0.5), start=2)
        check({"first": Weighted(During(mean, stop=4), 2.0), "second": within})
    with pytest.raises(ValueError, match="counts at step 9 of 0 to 99; .* alone from 0 to 8$"):
        check({"alone": During(mean, stop=9)})
    with pytest.raises(ValueError, match=r"the loss has no term: give one of loss.terms \(plain\) that is not null"):
        Loss({"plain": None})


def test_steps_at_which_weights_are_zero_are_refused():
    late = Weighted(mean, 1.0, lambda progress: schedules.linear(progress, 0.5, 0.5))
    check({"late": late, "early": During(mean, stop=50)})
    with pytest.raises(
        ValueError, match="no term of the loss counts at step 0 of 0 to 99; .* schedule .*: late from 50 to 99$"
    ):
        check({"late": late})
    with pytest.raises(ValueError, match="at step 0 of .*: off never, late from 50 to 99$"):
        check({"off": Weighted(mean, 0.0), "late": late})


def test_terms_that_are_all_absent_are_told():
    with pytest.raises(ValueError, match="every term of loss.terms is absent at this step"):
        summands({}, {})


def test_it_is_known_whether_some_term_compares_the_images_of_a_companion():
    own, colour = Photometric(), Photometric(modality="rgb")
    assert not Loss({"own": own}).compares("rgb")
    for term in (colour, Weighted(colour, 0.5), During(Weighted(OnTargetGrid(colour)), 5), ByOthersShare(colour, 1)):
        assert Loss({"own": own, "colour": term}).compares("rgb")
    for none in (Weighted(colour, 0.0), ByOthersShare(colour, 1, 0.0)):
        assert not Loss({"own": own, "colour": During(none)}).compares("rgb")


@pytest.mark.parametrize("method", ["3dgs_ir", "mftg", "msmg", "ommg", "ravigs", "thermonerf"])
def test_every_loss_of_two_images_compares_both(method):
    config = compose([f"method={method}"])
    assert build(config["thermal"]).companions == ("rgb",) and build(config["loss"]).compares("rgb")


def test_weight_and_schedule_multiply():
    ramp = Weighted(mean, weight=0.5, schedule=lambda progress: schedules.linear(progress, 0.2, 0.6))
    assert Loss({"ramp": ramp})(at(40))["ramp"].item() == pytest.approx(3.0 * 0.5 * 0.5)


def test_weight_zero_equals_absent():
    assert Loss({"off": Weighted(Never(), 0.0)})(at(0)) == {}
    late = Weighted(Never(), 1.0, lambda progress: schedules.linear(progress, 0.5, 0.5))
    assert Loss({"late": late})(at(49)) == {}
    assert list(Loss({"late": Weighted(mean, 1.0, late.schedule)})(at(50))) == ["late"]


@pytest.mark.parametrize("progress, expected", [(0.0, 2.0), (0.1, 2.0), (0.2, 2.5), (0.3, 3.0), (0.5, 4.0), (1.0, 4.0)])
def test_linear_ramp(progress, expected):
    assert schedules.linear(progress, 0.1, 0.5, before=2.0, after=4.0) == pytest.approx(expected)


def test_a_ramp_that_ends_before_it_starts_is_refused():
    with pytest.raises(ValueError, match="ends at 0.1 of the run, before it starts at 0.4"):
        schedules.linear(0.2, 0.4, 0.1)


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        (lambda image: None, "None"),
        (lambda image: image.mean().item(), "of type float"),
        (lambda image: (image.mean(), image.mean()), "of type tuple"),
        (lambda image: image, r"a tensor of shape \[2, 2, 1\]"),
        (lambda image: {"a": image.mean(), "b": image[0, 0].expand(3)}, r"a tensor of shape \[3\]"),
    ],
)
@pytest.mark.parametrize("around", [lambda term: term, Weighted])
def test_a_term_that_returns_no_scalar_is_named(returned, told, around):
    class Mistaken(LossTerm):
        def __call__(self, inputs):
            return returned(inputs.prediction)

    with pytest.raises(ValueError, match=f"loss term Mistaken returned is {told}; it must be a scalar tensor"):
        Loss({"mine": around(Mistaken())})(at(0))


def test_what_is_no_loss_term_is_refused_by_name():
    def plain(inputs):
        return inputs.prediction.mean()

    with pytest.raises(ValueError, match="loss.terms.mine is of type function; a loss term derives from .*LossTerm"):
        Loss({"mine": plain})
    with pytest.raises(ValueError, match="loss.terms.mine.term.term is of type function"):
        Loss({"mine": During(Weighted(plain))})


def test_two_terms_of_one_name_and_regularisers_that_are_no_scalars_are_refused():
    one = torch.ones(())
    assert summands({"a": one}, {}, {"b": one}) == {"a": one, "b": one}
    with pytest.raises(ValueError, match="two loss terms are called 'smooth'"):
        summands({"smooth": one}, {"smooth": 2 * one})
    with pytest.raises(ValueError, match=r"loss term 'mine' is a tensor of shape \[4\]; it must be a scalar"):
        summands({"mine": torch.ones(4)})
    with pytest.raises(ValueError, match="loss term 'mine' is of type float"):
        summands({"mine": 0.5})
