"""A checkpoint that somebody sent: only known parts are built of it, and nothing is imported or called before that is known."""

import copy

import pytest
import torch
from helpers import ALL_METHODS
from running import TINY

from heatsplat import composition
from heatsplat.contracts import SceneError
from heatsplat.runs import run, trust
from heatsplat.runs.resume import resumed
from heatsplat.training.checkpoints import load_checkpoint


@pytest.fixture(scope="module")
def composed():
    return composition.compose([*TINY, "method=3dgs"])


def stored(folder, config):
    path = folder / "sent.ckpt"
    torch.save({"heatsplat": {"config": config}}, path)
    return path


FOREIGN = {
    "a study": {"_target_": "heatsplat.studies.child_runs.train_or_read", "command": ["touch", "x"]},
    "a reader of pickles": {"_target_": "joblib.load", "filename": "x"},
    "torch": {"_target_": "torch.load", "f": "x", "weights_only": False},
    "eval in disguise": {"_target_": "sympy.sympify", "a": "__import__('os').getcwd()"},
    "by a module of ours": {"_target_": "heatsplat.thermal.static.torch.load", "f": "x"},
    "a class of ours that no configuration names": {"_target_": "heatsplat.losses.teacher.Network", "path": "x"},
    "no name": {"_target_": ["os", "system"]},
    "arguments by position": {"_target_": "heatsplat.thermal.static.Static", "_args_": [3]},
    "a function that is called": {"_target_": "heatsplat.losses.teacher.load_teacher", "source": "x.pt2"},
    "deep": [[{"a": {"_target_": "os.system", "_partial_": True}}]],
    "an interpolation": "${oc.env:HOME}",
    "an escaped one": "\\${oc.env:HOME}",
    "a tensor": torch.zeros(2),
    "a key that is no text": {(1, 2): 3},
}


@pytest.mark.parametrize("name", FOREIGN)
@pytest.mark.parametrize("place", ["module", "data", "trainer", "effects"])
def test_nothing_foreign_is_built(composed, tmp_path, monkeypatch, name, place):
    monkeypatch.setattr(run, "build", lambda *_, **__: pytest.fail("something was built"))
    bad = copy.deepcopy(composed)
    bad[place]["extra"] = FOREIGN[name]
    with pytest.raises(SceneError, match=rf"sent\.ckpt is not loaded: {place}\.extra"):
        run.load(stored(tmp_path, bad))


def test_a_configuration_that_contains_itself_is_refused(composed, tmp_path):
    bad = dict(composed)
    bad["data"] = {"root": bad}
    with pytest.raises(SceneError, match="contains itself"):
        run.load(stored(tmp_path, bad))


@pytest.mark.parametrize("here", [True, False], ids=["in the folder", "given"])
def test_what_an_earlier_run_measured_brings_no_code(tmp_path, here):
    config = composition.compose([*TINY, "method=auto"])
    bad = config | {"verdicts": {"relaxation": {"settings": {"degree": FOREIGN["torch"]}}}}
    path = stored(tmp_path, bad)
    if here:
        (tmp_path / "checkpoints").mkdir()
        path = path.rename(tmp_path / "checkpoints" / "last.ckpt")
    with pytest.raises(SceneError, match=r"verdicts\.relaxation\.settings\.degree\._target_ is 'torch\.load'"):
        resumed(config if here else config | {"ckpt": str(path)}, tmp_path)


@pytest.mark.parametrize("method", ALL_METHODS)
def test_every_method_may_be_built_from_its_checkpoint(method):
    config = composition.compose(["data.size=tiny", f"method={method}"])
    known = trust.trusted(config, "own.ckpt")
    assert known["module"] == config["module"] and "callbacks" not in known


def test_classes_of_registered_packages_and_those_that_the_user_names_may_be_built(composed, tmp_path, monkeypatch):
    own = composed | {"thermal": {"_target_": "my_package.heat.Mine"}}
    with pytest.raises(SceneError, match=r"trust=\[my_package\.heat\.Mine\]"):
        trust.trusted(own, "own.ckpt")
    several = own | {"density": {"_target_": "my_package.Rule"}, "loss": {"_target_": "my_package.heat.Mine"}}
    with pytest.raises(SceneError, match=r"_target_ is .*trust=\[my_package\.heat\.Mine,my_package\.Rule\]"):
        trust.trusted(several, "own.ckpt")
    with pytest.raises(
        SceneError, match=r"sent\.ckpt needs my_package\.heat\.Mine, which Python does not find .* PYTHONPATH"
    ):
        built = own | {"module": composed["module"] | {"thermal": own["thermal"]}}
        run.load(stored(tmp_path, built), trust=["my_package.heat.Mine"])
    assert trust.trusted(own, "own.ckpt", ["my_package.heat.Mine"])
    mine = type("Mine", (), {"__module__": "my_package.heat"})
    for one in ("my_package.heat.Mine", mine, [mine]):
        assert run._names(one) == ["my_package.heat.Mine"]

    class Entry:
        value = "my_package.heat:Mine"

    monkeypatch.setattr(trust, "entry_points", lambda group: [Entry] if group == "heatsplat.parts" else [])
    assert trust.trusted(own, "own.ckpt")
    with pytest.raises(SceneError, match=r"my_package\.heat\.os\.system"):
        trust.trusted(own | {"data": {"_target_": "my_package.heat.os.system"}}, "own.ckpt")


def test_a_refusal_to_load_gives_no_dangerous_advice(tmp_path):
    class Evil:
        def __reduce__(self):
            return (print, ("run",))

    torch.save({"heatsplat": Evil()}, tmp_path / "evil.ckpt")
    with pytest.raises(SceneError, match=r"evil\.ckpt is not a checkpoint that can be read: it names print") as told:
        load_checkpoint(tmp_path / "evil.ckpt")
    assert "weights_only" not in str(told.value) and "\n" not in str(told.value)
