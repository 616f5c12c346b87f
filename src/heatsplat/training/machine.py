"""What a process has of its machine. Imports nothing heavy: the command line asks before it composes a configuration."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import ModuleType

# Lightning's remarks that no user can act on: workers, its products, a deprecation of torch, checkpoints of another
# folder or with other callbacks, SLURM where a run was started by hand, loaders that cannot resume (ours takes the step
# from the trainer, so a resumed run sees the right views), runs without validation, and schedules that go on while
# gradients wait.
NOISE = (
    r".*does not have many workers.*",
    r".*LeafSpec.*",
    r".*`isinstance\(treespec.*",
    r".*Checkpoint directory.*",
    r".*transfer_batch_to.*",
    r".*smaller than the logging interval.*",
    r".*dirpath has changed.*",
    r".*callbacks used to create the checkpoint need.*",
    r".*dataloader is not resumable.*",
    r".*`srun` command is available.*",
    r".*but have no `val_dataloader`.*",
    r".*`lr_scheduler.step\(\)` before.*",
)

_loaded = False  # libraries were, in this process, or are being


def cores() -> int:
    """CPU cores that this process may use: on a cluster those of the job, not those of the node."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def usual_threads() -> int:
    """Threads of a process that was told no number: OMP_NUM_THREADS, as all of OpenMP takes it; else a core each."""
    given = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()  # a number for each level of nesting
    return int(given) if given.isdecimal() and int(given) > 0 else cores()


@contextmanager
def _stand_ins() -> Iterator[None]:
    """While it lasts, next to nothing is found in place of torch's compiler and of SciPy's signals, unless they are there.

    Lightning and torchmetrics load both to tell compiled modules and to add a name to an old SciPy, which takes a third of the
    time in which a command loads its libraries. Who asks for them afterwards gets them.
    """
    compiler, signals = ModuleType("torch._dynamo"), ModuleType("scipy.signal")
    compiler.OptimizedModule = type("OptimizedModule", (), {})  # what torch.compile makes of a module: none is one
    compiler.disable = lambda function=None, *_, **__: (lambda given: given) if function is None else function
    signals.hamming = None  # the name that would be added
    stand_ins = {module.__name__: module for module in (compiler, signals) if module.__name__ not in sys.modules}
    sys.modules.update(stand_ins)
    try:
        yield
    finally:
        for name in stand_ins:
            del sys.modules[name]


def _leave_compiler_out() -> None:
    """Optimisers would load torch's compiler to tell it to let their methods alone; this is what it would leave there."""
    from torch.optim import Optimizer

    for name in ("add_param_group", "load_state_dict", "state_dict", "zero_grad"):
        method = getattr(getattr(Optimizer, name), "__wrapped__", None)
        if method is not None and "torch._dynamo" not in sys.modules:
            method.__dynamo_disable = method


@contextmanager
def loading() -> Iterator[None]:
    """The first time in a process, what is loaded meanwhile is left out of the search for garbage, then and later on.

    There is none among libraries, and the search takes a third of the time in which a command loads them. Later it would
    keep what jobs of a sweep have left behind. Lightning is loaded first, without what no command uses (``_stand_ins``).
    """
    global _loaded
    if _loaded:  # gc.get_freeze_count knows too, and counts half a million objects for it, which takes 0.1 s
        yield
        return
    _loaded = True
    gc.disable()
    try:
        with _stand_ins():
            import pytorch_lightning  # noqa: F401
        _leave_compiler_out()
        yield
    finally:
        gc.freeze()
        gc.enable()


def clear_away() -> None:
    """Gives the system the memory that earlier jobs of a process have left, which would count as a later job's."""
    gc.collect()
    with suppress(OSError, AttributeError, TypeError):  # systems without glibc, which keeps what is free in between
        ctypes.CDLL(None).malloc_trim(0)


def prepare_machine(threads: int | None) -> None:
    """Fixes the number of CPU threads (None: ``usual_threads``) and quietens messages that no user can act on."""
    import torch  # here, for it is heavy, as kernels are

    from heatsplat.kernels.scheduling import use_threads

    threads = threads or usual_threads()
    # Kernels first: starting their threads sets OpenMP's number, which is torch's too, to all cores.
    use_threads(threads)
    torch.set_num_threads(threads)
    torch.backends.cudnn.allow_tf32 = (
        False  # or windows of SSIM have ten bits on CUDA, and variances of flat images none
    )
    for pattern in NOISE:
        warnings.filterwarnings("ignore", message=pattern)
    for name in ("pytorch_lightning", "pytorch_lightning.utilities.rank_zero", "lightning_fabric.utilities.rank_zero"):
        logging.getLogger(name).setLevel(logging.WARNING)  # of the first, Lightning's import makes INFO again
