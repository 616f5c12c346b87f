"""docs/testing.md: its table names exactly the tests that `make test` may leave out."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "testing.md").read_text()
TABLE = dict(re.findall(r"^\| `(tests/[\w/]+\.py)` \| ([^|]+) \|", TEXT, re.M))
TESTS = sorted((ROOT / "tests").rglob("test_*.py"))


def left_out(path: Path) -> set[str]:
    """Words for why tests of a file may not run: "slow", "gpu", or "needs" something that is missing."""
    found, text = set(), path.read_text(encoding="utf-8")
    if not re.search(r"\b(slow|gpu|skipif|importorskip)\b", text):
        return found
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute):
            mark = isinstance(node.value, ast.Attribute) and node.value.attr == "mark"
            if mark and node.attr in ("slow", "gpu"):
                found.add(node.attr)
            elif node.attr in ("skipif", "importorskip"):
                found.add("needs")
    return found


def test_what_may_be_left_out_is_listed_with_its_reason():
    wrong = []
    for path in TESTS:
        name, reasons = str(path.relative_to(ROOT)), left_out(path)
        stated = TABLE.get(name, "")
        listed = (name in TABLE) == bool(reasons)
        marked = {"slow", "gpu"} & reasons == {word for word in ("slow", "gpu") if word in stated}
        needed = "needs" not in reasons or "needs" in stated or "gpu" in stated or stated == "slow"
        if not (listed and marked and needed):
            wrong.append(f"{name} is marked {sorted(reasons) or 'by nothing'}, its row says {stated or 'nothing'}")
    assert len(TESTS) > 400
    assert not wrong, "\n".join(["docs/testing.md, table:", *wrong])


def test_files_that_begin_first_are_there():
    names = re.findall(r'^    "(\w+/test_\w+\.py)",$', (ROOT / "tests" / "conftest.py").read_text(), re.M)
    assert len(names) > 20 and [name for name in names if not (ROOT / "tests" / name).exists()] == []


def test_the_page_names_every_folder_and_no_file_that_is_gone():
    assert [name for name in TABLE if not (ROOT / name).exists()] == []
    named = set(re.findall(r"`(?:tests/)?(\w+)`", TEXT.split("Three habits")[0]))
    folders = {path.parent.name for path in TESTS} - {"tests"}
    assert folders <= named, folders - named
