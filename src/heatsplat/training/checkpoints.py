"""Checkpoint files: written as a whole or not at all, read as plain containers only, refused where they were damaged."""

from __future__ import annotations

import io
import pickle
import re
import zipfile
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning.plugins.io import CheckpointIO

from heatsplat.contracts import SceneError
from heatsplat.io.files import size_told, write_atomically
from heatsplat.io.results import checkpoint_of


class CheckpointFiles(CheckpointIO):
    """How a trainer writes and reads checkpoints.

    A checkpoint is a zip archive, in which every part has a checksum (CRC-32). It is written beside its place, flushed to
    the disk and renamed: what has its name is whole, whenever the process was killed and however full the disk is.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        path = Path(path)
        for left in path.parent.glob(f".{path.name}.*"):  # by a process that was killed; the folder is ours alone
            left.unlink()
        content = io.BytesIO()
        torch.save(checkpoint, content)
        try:
            write_atomically(path, content.getbuffer())
        except OSError as error:
            raise SceneError(
                f"the checkpoint of step {checkpoint['global_step']} ({size_told(content.tell())}) could not be written to "
                f"{path}: {error.strerror}. Earlier checkpoints are as they were; make room and start the same command again"
            ) from error

    def load_checkpoint(self, path: str | Path, *_: Any, **__: Any) -> dict[str, Any]:
        return load_checkpoint(path)

    def remove_checkpoint(self, path: str | Path) -> None:
        Path(path).unlink(missing_ok=True)


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """The checkpoint as a dict of tensors and plain containers; nothing in it is executed.

    Args:
        path: of the file; a run's folder, or its folder of checkpoints, for its last one.

    Raises:
        SceneError: there is none at ``path``, or it was damaged or holds anything else, with the others in its folder.
    """
    path = checkpoint_of(path)
    there = sorted(str(p) for p in path.parent.glob("*.ckpt")) or sorted(str(p) for p in path.rglob("*.ckpt"))
    others = [other for other in there if other != str(path)]
    remedy = f"; there are: {', '.join(others)}" if others else ""
    if not path.is_file():
        raise SceneError(f"no checkpoint at {path}{remedy}")
    try:
        with path.open("rb") as file:
            broken = _broken(file)
            if broken is None:
                file.seek(0)
                found = torch.load(file, map_location="cpu", weights_only=True)
                broken = None if isinstance(found, dict) else "it holds no dict"
    except pickle.UnpicklingError as error:
        named = re.search(r"GLOBAL ([\w.]+)", str(error))
        broken = (
            f"it names {named[1]}, and a checkpoint is tensors and plain values" if named else "its index is damaged"
        )
    except Exception as error:  # zipfile and torch raise a dozen types on bytes that are no checkpoint
        broken = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
    if broken is not None:
        raise SceneError(f"{path} is not a checkpoint that can be read: {broken}{remedy}")
    return found


def step_of(path: Path) -> int:
    """The step of a checkpoint, of which no tensor is read; -1 where the file cannot be read."""
    try:
        return int(torch.load(path, map_location="cpu", weights_only=True, mmap=True)["global_step"])
    except Exception:  # as of ``load_checkpoint``, which says what is wrong
        return -1


def _broken(file: io.BufferedReader) -> str | None:
    """What is wrong with the bytes of a checkpoint, or None. torch reads past wrong checksums."""
    with zipfile.ZipFile(file) as archive:
        if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
            return "it is compressed, which heatsplat never does"
        part = archive.testzip()
        return part and f"{part} in it is damaged (its checksum differs)"
