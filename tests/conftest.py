"""Test processes side by side (pytest -n) share the cores and the films of synthetic scenes; each composes a setting once."""

import gc
import importlib
import logging
import os
import signal
import sys
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from _pytest.logging import catching_logs
from commands import FILMS
from quick_compositions import quick_compositions
from running import filming_once, recording_once

from heatsplat.training.machine import cores, loading, prepare_machine

COLLECTING = ExitStack()  # modules and thousands of tests are no garbage, as libraries of commands are none
COLLECTING.enter_context(loading())
COMPOSING = ExitStack()  # also what is composed for the names of tests, while they are collected
COMPOSING.enter_context(quick_compositions())

os.environ.setdefault("HYPOTHESIS_NO_PLUGINS", "1")  # those of other libraries, whose import takes longer than its own

WORKERS = os.environ.get("PYTEST_XDIST_WORKER_COUNT")
if WORKERS:  # before torch is imported, which reads it once
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, cores() // int(WORKERS))))

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's background job: what it starts would not hear Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Files that take longest, begun first: side by side, no process is left with one of them while the others have none. The first
# two ask for different kernels, which both would compile.
LONGEST = (
    "training/test_presets.py",
    "physics/test_physics_energy_balance.py",
    "viewer/test_page.py",
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


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """A process per core: loading the libraries takes longer than what is waited for."""
    return cores()


def pytest_collection(session):
    """Files of tests are rewritten for their assertions, which takes ten seconds where no cache has them: each process begins
    with a share of its own and finds the others rewritten."""
    if WORKERS:
        own = int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw"))
        folders = [Path(place) for place in session.config.args if Path(place).is_dir()]
        for file in sorted(file for folder in folders for file in folder.rglob("test_*.py"))[own :: int(WORKERS)]:
            if str(file.parent) not in sys.path:
                sys.path.insert(0, str(file.parent))
            with suppress(Exception, pytest.skip.Exception):  # the second import says what it is
                importlib.import_module(file.stem)


def pytest_collection_finish():
    COLLECTING.close()
    for name, one in logging.root.manager.loggerDict.items():
        if name.startswith("torch.") and isinstance(one, logging.Logger):
            one.propagate = True  # pytest listens to each that does not, six times for every test
    gc.set_threshold(5000, 20, 20)  # in place of 700, 10, 10: configurations come and go by the thousand objects


def pytest_unconfigure():
    COMPOSING.close()


def pytest_collection_modifyitems(items):
    place = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get("/".join(item.path.parts[-2:]), len(LONGEST)))


class Loggers:
    """Levels and the like of the hundreds of loggers. To look at all takes as long as a short test, and pytest would do so six
    times for each, for those of which the root does not hear: they are looked up once."""

    def __init__(self) -> None:
        self.known: tuple | None = None  # settings that hold unless a wider fixture was made or undone since
        self.apart: list[logging.Logger] = []  # of which the root does not hear

    def settings(self) -> tuple[int, int, dict[str, tuple[int, bool, bool]]]:
        root, found = logging.root, logging.root.manager.loggerDict
        loggers = [(name, one) for name, one in found.items() if isinstance(one, logging.Logger)]
        self.apart = [one for _, one in loggers if not one.propagate]
        each = {name: (one.level, one.disabled, one.propagate) for name, one in loggers}
        self.known = root.level, root.manager.disable, each
        return self.known

    def catch(self, caught: catching_logs) -> logging.Handler:
        """In place of ``caught.__enter__``."""
        if caught.level is not None:
            caught.handler.setLevel(caught.level)
            caught.orig_level = logging.root.level
            logging.root.setLevel(min(caught.orig_level, caught.level))
        for one in (logging.root, *self.apart):
            one.addHandler(caught.handler)
            caught.attached_loggers.append(one)
        return caught.handler


LOGGERS = Loggers()
if "attached_loggers" in getattr(catching_logs, "__slots__", ()):  # as in the pytest that this was written for
    catching_logs.__enter__ = lambda caught: LOGGERS.catch(caught)


def pytest_fixture_setup(fixturedef):
    if fixturedef.scope != "function":
        LOGGERS.known = None


def pytest_fixture_post_finalizer(fixturedef):
    if fixturedef.scope != "function":
        LOGGERS.known = None


@pytest.fixture(autouse=True)
def logging_as_it_was():
    """A command that runs in the test process sets logging up for itself; the next test starts from what was there."""
    root, found = logging.root, logging.root.manager.loggerDict
    level, muted, before = LOGGERS.known or LOGGERS.settings()
    names = set(found)
    yield
    if LOGGERS.settings() == (level, muted, before):
        return
    root.setLevel(level)
    logging.disable(muted)
    for name, one in found.items():
        if hasattr(one, "level") and (name in before or name not in names):
            one.level, one.disabled, one.propagate = before.get(name, (logging.NOTSET, False, True))
    root.manager._clear_cache()
    LOGGERS.settings()


@pytest.fixture(scope="session", autouse=True)
def threads_as_told():
    """Before anything is timed or compared: a first kernel starts its threads, which sets torch's number to all cores."""
    prepare_machine(None)


@pytest.fixture(scope="session")
def films(tmp_path_factory) -> Path:
    """A folder of scenes that one test process filmed and the others read."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if WORKERS else own) / "films"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="module", autouse=True)
def filmed_once(films):
    """Scenes of the same recording share it: filming takes half of a tiny run. Tests of filming itself call ``film``."""
    from heatsplat.datamodules import synthetic

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "film", recording_once(synthetic.film, films))
        patch.setattr(synthetic.Synthetic, "load", filming_once(synthetic.Synthetic.load, films))
        patch.setenv(FILMS, str(films))
        yield
