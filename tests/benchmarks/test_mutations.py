"""Every naive form that is put back is noticed by a test; study=mutations says by which."""

import functools
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.mutations import MUTATIONS, SURVIVED, Mutation, run
from heatsplat.contracts import SceneError

ROOT = Path(__file__).resolve().parents[2]


@functools.cache
def text_of(path: str) -> str:
    return (ROOT / path).read_text()


def wrong_of(mutation: Mutation) -> list[str]:
    """What a mutation says of the sources and of its tests that is not so."""
    try:
        changed = mutation.source()
        compile(changed, mutation.module, "exec")
    except (ValueError, SyntaxError) as error:
        return [f"{mutation.name}: {error}"]
    wrong = ["changes nothing"] if changed == mutation.path.read_text() else []
    words = shlex.split(mutation.tests)
    paths = words[: words.index("-k")] if "-k" in words else words
    wrong += [f"no {word}" for word in paths if word.partition("::")[2] not in text_of(word.partition("::")[0])]
    keywords = [word for word in words[len(paths) + 1 :] for word in word.split()]
    if len(words) - len(paths) not in (0, 2):
        wrong.append("pytest takes one expression after -k: quote it")
    there = "".join(text_of(word.partition("::")[0]).lower() for word in paths)
    missing = [word for word in keywords if word.lower() not in there and word not in ("and", "or", "not")]
    return [f"{mutation.name}: {told}" for told in (*wrong, *(f"no {word} after -k" for word in missing))]


def test_what_is_mutated_still_stands_in_the_source():
    wrong = [told for mutation in MUTATIONS for told in wrong_of(mutation)]
    assert len(MUTATIONS) > 100
    assert not wrong, "\n".join(wrong)


def test_a_place_that_is_gone_is_named():
    with pytest.raises(ValueError, match=r"mutation 'none' looks for one place in units.py, found 0"):
        Mutation("none", "physics.units", "no such line", "", "tests/physics/test_units.py").source()


def test_names_that_there_are_not_are_told_before_anything_runs(tmp_path):
    with pytest.raises(SceneError, match="each of study.only must be one of .*got 'nope'"):
        run(tmp_path, only=["nope"])
    assert list(tmp_path.iterdir()) == []


PROBE = """
from benchmarks import mutations
harmless = mutations.Mutation("harmless", "physics.units", "return celsius + KELVIN_AT_0_C",
                              "return KELVIN_AT_0_C + celsius", "tests/physics/test_units.py")
fatal = mutations.Mutation("fatal", "physics.units", "return celsius + KELVIN_AT_0_C", "return celsius",
                           "tests/physics/test_units.py -k 'celsius and back'")
mutations.MUTATIONS = (harmless, fatal)
print(mutations.run("OUTPUT"))
"""


def test_a_mutation_that_changes_nothing_survives_and_one_that_does_is_noticed(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", PROBE.replace("OUTPUT", str(tmp_path))],
        cwd=ROOT, env={"PYTHONPATH": str(ROOT / "src"), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "'harmless': None" in done.stdout
    assert "'fatal': 'tests/physics/test_units.py::test_zero_celsius_and_back'" in done.stdout
    assert SURVIVED in (tmp_path / "mutations.md").read_text()


@pytest.mark.slow
def test_a_test_fails_for_every_mutation(tmp_path):
    command = [sys.executable, str(ROOT / "src/study.py"), "study=mutations", "study.document=null"]
    done = subprocess.run([*command, f"hydra.run.dir={tmp_path}"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert SURVIVED not in (tmp_path / "mutations.md").read_text(encoding="utf-8")
