"""Test processes side by side (pytest -n) share the cores; a synthetic scene is filmed once in each of them."""

import copy
import functools
import logging
import os
import pickle
import signal
from collections import defaultdict

import hydra
import omegaconf
import pytest
from hydra._internal import defaults_list
from hydra._internal.config_repository import ConfigRepository
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra

from heatsplat.composition import CONF
from heatsplat.training.machine import cores, prepare_machine

WORKERS = os.environ.get("PYTEST_XDIST_WORKER_COUNT")
if WORKERS:  # before torch is imported, which reads it once
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, cores() // int(WORKERS))))

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's background job: what it starts would not hear Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)

FILMING = {"datamodules"}  # folders with tests of filming itself
# Files that take longest, begun first: side by side, no process is left with one of them while the others have none.
LONGEST = (
    "viewer/test_page.py",
    "training/test_presets.py",
    "physics/test_physics_energy_balance.py",
    "project/test_command_line.py",
    "project/test_readme.py",
    "studies/test_sweeps.py",
    "project/test_notebooks.py",
    "project/test_extending.py",
    "density/test_rules_in_runs.py",
    "runs/test_budget.py",
    "benchmarks/test_evidence.py",
    "studies/test_reproduction.py",
    "thermal/test_energy_balance.py",
    "faults/test_killed_runs.py",
    "physics/test_marching.py",
    "training/test_auto_runs.py",
    "effects/test_swept_points.py",
    "benchmarks/test_work_precision.py",
    "effects/test_heat_source.py",
    "effects/test_physical_harmonic_source.py",
    "kernels/test_platforms.py",
    "datamodules/test_synthetic.py",
    "preparation/test_devices.py",
    "preparation/test_prepare.py",
    "training/test_runs.py",
    "fuzz/test_readers.py",
    "benchmarks/test_stability.py",
    "benchmarks/test_budget_grid.py",
    "effects/test_real_scenes.py",
    "export/test_snapshot.py",
    "density/test_inheritance.py",
    "renderers/test_contract.py",
    "benchmarks/test_mutations.py",
    "doctor/test_checks_drift.py",
    "physics/test_relaxation.py",
    "datamodules/test_glass.py",
    "datamodules/test_outdoor_true.py",
)
FILMED = {}  # settings of a recording -> the scene, which nobody changes


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """One process more than there are cores: tests wait for commands that they start."""
    return cores() + 1


def pytest_collection_modifyitems(items):
    place = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get("/".join(item.path.parts[-2:]), len(LONGEST)))


@pytest.fixture(autouse=True)
def logging_as_it_was():
    """A command that runs in the test process sets logging up for itself; the next test starts from what was there."""
    root, found = logging.getLogger(), logging.root.manager.loggerDict
    level, muted, names = root.level, root.manager.disable, set(found)
    before = {name: (one.level, one.disabled, one.propagate) for name, one in found.items() if hasattr(one, "level")}
    yield
    root.setLevel(level)
    logging.disable(muted)
    for name, one in found.items():
        if hasattr(one, "level") and (name in before or name not in names):
            one.level, one.disabled, one.propagate = before.get(name, (logging.NOTSET, False, True))
    root.manager._clear_cache()


@pytest.fixture(scope="session", autouse=True)
def threads_as_told():
    """Before anything is timed or compared: a first kernel starts its threads, which sets torch's number to all cores."""
    prepare_machine(None)


@pytest.fixture(scope="session", autouse=True)
def configurations_read_once():
    """Files of conf/ and interpolations are parsed once in each process: the suite composes more than a thousand times, 0.25 s
    each, half of that parsing.

    What is found beside further folders (``hydra.searchpath``) is read anew; tests write those. And Hydra makes a map of all
    choices for each of some thirty files, a fifth of the time, which it reads only where a default depends on another. What
    is left are copies: those of what every node says of itself hold nothing but names, types and flags, and go attribute by
    attribute; the store of Hydra's own settings copies what it gives, and is not copied itself. A composition that is asked
    for again, from the same working directory, is the first one, copied: planning a budget composes the same five times.
    """
    read, known = ConfigRepository.load_config, {}
    map_of = defaults_list._create_interpolation_map
    parse = functools.cache(omegaconf.base.parse)
    compose, composed = hydra.compose, {}

    def load_config(self, config_path):
        if [source.path for source in self.sources if source.scheme() == "file"] != [CONF]:
            return read(self, config_path)
        if config_path not in known:
            known[config_path] = pickle.dumps(read(self, config_path))  # what is returned gets changed
        return pickle.loads(known[config_path])

    def compose_once(config_name=None, overrides=(), return_hydra_config=False):
        places = [place.path for place in GlobalHydra.instance().config_loader().get_search_path().get_path()]
        files = [place.removeprefix("file://") for place in places if not place.startswith(("pkg://", "structured://"))]
        if files != [CONF] or any("searchpath" in text for text in overrides):
            return compose(config_name, list(overrides), return_hydra_config)
        key = config_name, tuple(overrides), return_hydra_config, os.getcwd()
        if key not in composed:
            composed[key] = pickle.dumps(compose(config_name, list(overrides), return_hydra_config))
        return pickle.loads(composed[key])

    def copied(self, memo):
        new = object.__new__(type(self))
        new.__dict__.update(self.__dict__)
        new.flags = None if self.flags is None else dict(self.flags)
        new.resolver_cache = copy.deepcopy(self.resolver_cache, memo) if self.resolver_cache else defaultdict(dict)
        return new

    def choices(overrides, defaults, self_added):
        depends = any(not one.is_self() and not one.is_override() and one.is_interpolation() for one in defaults)
        return map_of(overrides, defaults, self_added) if depends else None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConfigRepository, "load_config", load_config)
        patch.setattr(defaults_list, "_create_interpolation_map", choices)
        patch.setattr(hydra, "compose", compose_once)
        patch.setattr(omegaconf.base.Metadata, "__deepcopy__", copied, raising=False)
        patch.setattr(ConfigStore, "__deepcopy__", lambda self, memo: self, raising=False)
        patch.setattr(omegaconf.base, "parse", parse)
        patch.setattr(omegaconf._utils, "parse", parse)
        yield


@pytest.fixture(scope="module", autouse=True)
def filmed_once(request):
    """Runs on the same recording share it: filming takes half of a tiny run. Tests of filming itself film."""
    if request.path.parent.name in FILMING:
        yield
        return
    from heatsplat.datamodules.synthetic import Synthetic

    film = Synthetic.load

    def load(self):
        own = {key: value for key, value in vars(self).items() if key not in ("trainer", "scene") and key[0] != "_"}
        settings = repr(sorted(own.items()))
        if settings not in FILMED:
            FILMED[settings] = film(self)
        return FILMED[settings]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Synthetic, "load", load)
        yield
