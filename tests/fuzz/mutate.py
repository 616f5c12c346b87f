"""Damage by chance: changes to bytes, JSON and tables, and a guard that sees what a reader makes of them.

Every input has a number; the same number gives the same damage, so a failure is repeated by its number.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import random
import resource
import select
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SECONDS = 60.0  # without an answer: a hang, also on a busy machine
MEMORY = 4 << 30  # bytes beyond what the process has when it begins
TEXT = {".json", ".csv", ".txt", ".obj", ".ply"}
VALUES = [
    float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 1e30, -1.0, 0, 1e-300, -273.16, 2**63, 10**400, True, None,
    "", "warm", "1,5", "../../x", "\0", [], {}, [1, [2]], [[1, 2], [3]], {"a": 1}, "x" * 5000,
]  # fmt: skip
CELLS = ["", "nan", "inf", "-1e308", "x", '"', "1;2", "2024-13-40T99:00:00", "9" * 400, "\0", "0,5", "-5", "é", "1e3"]


@dataclass(frozen=True)
class Outcome:
    """What became of one input: "loads", "refused", or a failure ("traceback", "unnamed", "nonsense", "hang", "crash")."""

    number: int
    kind: str
    text: str = ""

    @property
    def failed(self) -> bool:
        return self.kind not in ("loads", "refused")


def damage(folder: Path, rng: random.Random) -> list[str]:
    """Damages one to three files below a folder, or removes or exchanges them; says what was done."""
    done = []
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        if not files:
            break
        # Few files describe a scene and many are its images: the kinds have equal chances.
        kind = rng.choice(sorted({path.suffix for path in files}))
        path = rng.choice([path for path in files if path.suffix == kind])
        how = rng.random()
        if how < 0.04:
            path.unlink()
            done.append(f"{path.name} removed")
        elif how < 0.08:
            other = rng.choice(files)
            path.write_bytes(other.read_bytes())
            done.append(f"{path.name} is now {other.name}")
        else:
            path.write_bytes(damaged(path.read_bytes(), path.suffix, rng))
            done.append(f"{path.name} damaged")
    return done


def damaged(data: bytes, suffix: str, rng: random.Random) -> bytes:
    """The content of a file of that kind with some damage: to its structure where it has one, else to its bytes."""
    if suffix == ".json" and rng.random() < 0.8:
        with contextlib.suppress(ValueError):
            values = json.loads(data)
            for _ in range(rng.choice([1, 1, 2])):
                values = _other_value(values, rng)
            return json.dumps(values).encode()
    if suffix in TEXT and suffix != ".json" and rng.random() < 0.7:
        return _other_lines(data, rng)
    return other_bytes(data, rng)


def other_bytes(data: bytes, rng: random.Random) -> bytes:
    """The bytes with some flipped, cut off, added, repeated, removed or overwritten."""
    out = bytearray(data)
    at = rng.randrange(len(out)) if out else 0
    if out and rng.random() < 0.3:  # headers and counts stand at the beginning
        at = rng.randrange(min(len(out), 64))
    some = rng.choice([1, 2, 4, 8, 50, 1000])
    how = rng.randrange(7)
    if how == 0:
        del out[at:]
    elif how == 1:
        out += rng.randbytes(some)
    elif how == 2:
        del out[at : at + some]
    elif how == 3:
        out[at:at] = out[at : at + some]
    elif how == 4:
        out[at : at + some] = rng.choice([b"\0", b"\xff", b"\x80"]) * len(out[at : at + some])
    elif how == 5:
        out[at : at + 8] = rng.randbytes(len(out[at : at + 8]))
    else:
        for _ in range(rng.choice([1, 1, 3, 30])):
            if out:
                out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _other_value(values: Any, rng: random.Random) -> Any:
    """JSON with one of its values exchanged, dropped, repeated or made longer, at any depth."""
    if isinstance(values, dict | list) and values and rng.random() < 0.9:
        key = rng.choice(sorted(values)) if isinstance(values, dict) else rng.randrange(len(values))
        how = rng.random()
        if how < 0.1:
            del values[key]
        elif how < 0.2 and isinstance(values, list):
            values.insert(key, values[key])
        elif how < 0.2:
            values[key + "_"] = values.pop(key)
        else:
            values[key] = _other_value(values[key], rng)
        return values
    if isinstance(values, int | float) and abs(values) < 1e300 and rng.random() < 0.4:
        return values * rng.choice([-1, 0.5, 2, 1e3, 1e-3]) + rng.choice([0, 1e-2, 1])
    return rng.choice(VALUES)


def _other_lines(data: bytes, rng: random.Random) -> bytes:
    """Text with a word or a line exchanged, dropped, repeated, or its separators others."""
    lines = data.decode("latin-1").splitlines(keepends=True) or [""]
    at = rng.randrange(len(lines))
    how = rng.randrange(6)
    if how == 0:
        del lines[at]
    elif how == 1:
        lines.insert(at, lines[at])
    elif how == 2:
        lines[at] = lines[at][: rng.randrange(len(lines[at]) + 1)]
    elif how == 3:
        return "".join(lines).replace(",", rng.choice([";", "\t", " ", ",,"])).encode("latin-1")
    else:
        separator = "," if "," in lines[at] else " "
        words = lines[at].rstrip("\n").split(separator)
        words[rng.randrange(len(words))] = rng.choice(CELLS)
        lines[at] = separator.join(words) + "\n"
    return "".join(lines).encode("latin-1", "replace")


def guarded(numbers: range, work: Callable[[int], Outcome]) -> Iterator[Outcome]:
    """``work`` of every number in a process of its own, which may hang, run out of memory or be killed."""
    left = list(numbers)
    while left:
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reading)
            _work_off(left, work, writing)
        os.close(writing)
        with os.fdopen(reading, "rb") as answers:
            while left:
                ready, _, _ = select.select([answers], [], [], SECONDS)
                try:
                    outcome = pickle.load(answers) if ready else Outcome(left[0], "hang", f"no answer in {SECONDS:g} s")
                except EOFError:
                    outcome = Outcome(left[0], "crash")
                left.pop(0)
                yield outcome
                if outcome.kind in ("hang", "crash"):
                    break
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def _work_off(numbers: list[int], work: Callable[[int], Outcome], writing: int) -> None:
    """The child: never returns."""
    try:
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
        with os.fdopen(writing, "wb", buffering=0) as answers:
            for number in numbers:
                answers.write(pickle.dumps(work(number)))
        signal.pause()  # the parent ends this process: its own end would run what the parent's libraries left to do
    finally:
        os._exit(1)


def damaged_copy(template: Path, place: Path, number: int) -> list[str]:
    """Copies a folder to ``place`` and damages it by the number; says what was done."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(template, place)
    return damage(place, random.Random(number))


def campaign(
    kinds: Iterable[str],
    write_templates: Callable[[Path], None],
    fuzzed: Callable[[str, Path, Path, range], list[Outcome]],
    arguments: Sequence[str],
) -> int:
    """Exit code of a command that damages inputs until its time is over: 0 where all were loaded or refused by name.

    Failures are printed as they are found; at the end stands how many inputs of each kind had which outcome.

    Args:
        kinds: of input.
        write_templates: writes whole inputs of all kinds into a folder.
        fuzzed: outcomes of a kind's inputs, of (kind, folder of the templates, folder for a copy, their numbers).
        arguments: of the command: seconds, and for one input its kind and number.
    """
    seconds = float(arguments[0])
    kinds, number = arguments[1:2] or list(kinds), int(arguments[2]) if arguments[2:] else None
    counts: dict[str, Counter] = {kind: Counter() for kind in kinds}
    begin, first, some = time.monotonic(), number or 0, 50 if number is None else 1
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        write_templates(root / "whole")
        while True:
            for kind in kinds:
                for outcome in fuzzed(kind, root / "whole", root / "copy", range(first, first + some)):
                    counts[kind][outcome.kind] += 1
                    if outcome.failed or number is not None:
                        print(f"{kind} {outcome.number}: {outcome.kind}: {outcome.text}", flush=True)
            first += some
            if number is not None or time.monotonic() - begin > seconds:
                break
    counts["all"] = sum(counts.values(), Counter())
    for kind, counted in counts.items():
        print(f"{kind:24} {sum(counted.values()):6}  " + ", ".join(f"{k} {n}" for k, n in sorted(counted.items())))
    return int(bool(set(counts["all"]) - {"loads", "refused"}))
