"""How far hard cases of arithmetic err, in the printed form and in ours: the table in docs/stability.md.

Truths have 120 digits (mpmath). Errors are the worst of seeded draws, rounded up to one digit; a number that the document
has already stays while what is measured lies within a factor of ten of it, so that the document does not depend on the
machine (libraries of elementary functions differ in the last bit).
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import torch

from benchmarks.stability.case import TYPES, Case, measured
from heatsplat.io.tables import markdown_table
from heatsplat.studies.options import subset_of

log = logging.getLogger("heatsplat")

FAMILIES = {
    "closed_form": "Heat in closed form",
    "balance": "Balance of heat",
    "black_bodies": "Black bodies",
    "splatting": "Splatting",
    "sensing": "Sensor and field",
    "images": "Losses",
}
COLUMNS = tuple((kind, name) for kind in ("value", "slope") for name in TYPES)
SAME_WITHIN = 10.0  # see above
ROUNDING = 1e-15  # errors below are rounding of float64 or none at all, on any machine
ABSENT, INFINITE = "", "∞"

Row = dict[tuple[str, str], float | None]
HEAD = """# Numerical stability in hard cases

This page is generated: `make stability` measures every number, and a test (`tests/benchmarks`) fails if one no longer holds.

Each case compares the formula as printed in a paper with our form. In every case the printed form loses at least one digit more,
often all of them, or ends in NaN; ours stays below a promised number of machine epsilons ε (1.2e-7 in float32, 2.2e-16 in
float64). The test checks both.

Errors are the maximum over seeded random inputs in the stated range, relative to a reference with 120 digits, in float32 and
float64, for values and for the gradients from autograd ("slope"). ∞ stands for NaN or infinity. An empty cell means that the
combination does not exist: a form without a gradient, or a kernel with one type. Numbers are rounded up to one digit and hold
within a factor of ten on any machine.

Tests in `tests/stability` cover renderers, training, step sizes and random inputs. `python src/study.py study=mutations` puts
unstable forms back one by one and lists the tests that notice ([mutations](mutations.md)).
"""


def run(output_dir: Path | str, document: str | None = None, families: Sequence[str] | None = None) -> str:
    """The document, also written to stability.md in ``output_dir`` and to ``document``.

    Args:
        output_dir: folder of the results.
        document: file whose numbers stay where they still hold, and that is written; None for none.
        families: which of FAMILIES; None for all. Only a whole document is written to ``document``.

    Raises:
        SceneError: there is no such family.
    """
    families = None if families is None else subset_of("study.families", families, FAMILIES)
    torch.set_num_threads(1)  # tiny tensors
    committed = Path(document).read_text(encoding="utf-8") if document and Path(document).exists() else ""
    text = written(measurements(families), committed)
    Path(output_dir).mkdir(parents=True, exist_ok=True)
    (Path(output_dir) / "stability.md").write_text(text, encoding="utf-8")
    if document and families is None:
        Path(document).write_text(text, encoding="utf-8")
    log.info("%s", text)
    return text


def cases(family: str) -> tuple[Case, ...]:
    """The cases of a family."""
    return import_module(f"benchmarks.stability.{family}").CASES


def measurements(families: Sequence[str] | None = None) -> list[tuple[str, Case, dict[str, Row]]]:
    """(family, case, worst errors by form and column) of all cases of the families."""
    found = []
    for family in families or FAMILIES:
        for case in cases(family):
            errors = measured(case)
            found.append((family, case, {form: {c: errors[form, *c] for c in COLUMNS} for form in ("printed", "ours")}))
    return found


def written(rows: list[tuple[str, Case, dict[str, Row]]], committed: str = "") -> str:
    """The document; numbers of ``committed``, an earlier one, stay where they still hold."""
    before, tables = numbers_of(committed), {}
    for family, case, forms in rows:
        for form, errors in forms.items():
            old = before.get((case.name, form), [None] * len(COLUMNS))
            cells = [cell(errors[column], text) for column, text in zip(COLUMNS, old, strict=True)]
            about = f"**{case.name}.** {case.ranges}. Error over {case.error}." if form == "printed" else ""
            what = f"printed: {case.printed}" if form == "printed" else f"ours (at most {case.promise:g} ε)"
            tables.setdefault(family, []).append((about, what, *cells))
    head = ("hard case", "form", "float32", "float64", "slope, float32", "slope, float64")
    lines = [HEAD.rstrip()]
    for family, cells in tables.items():
        lines += [f"\n## {FAMILIES[family]}\n", *markdown_table(head, cells)]
    return "\n".join(lines) + "\n"


def cell(error: float | None, before: str | None = None) -> str:
    """An error rounded up to one digit, or ``before`` where that still holds."""
    if error is None:
        return ABSENT
    if before is not None and holds(error, before):
        return before
    if not math.isfinite(error):
        return INFINITE
    if error < ROUNDING:
        return f"< {ROUNDING:.0e}"
    exponent = math.floor(math.log10(error))
    digit = math.ceil(error / 10.0**exponent - 1e-9)
    return f"{digit if digit < 10 else 1}e{exponent + (digit == 10):+03d}"


def holds(error: float | None, text: str) -> bool:
    """Whether a cell of the document says what was measured, within a factor of ten."""
    if error is None or text == ABSENT:
        return error is None and text == ABSENT
    if text == INFINITE or not math.isfinite(error):
        return text == INFINITE and not math.isfinite(error)
    if text.startswith("<"):
        return error < SAME_WITHIN * ROUNDING
    return float(text) / SAME_WITHIN <= max(error, ROUNDING / SAME_WITHIN) <= float(text) * SAME_WITHIN


def numbers_of(document: str) -> dict[tuple[str, str], list[str]]:
    """Cells of an earlier document by (name of the case, form)."""
    found, name = {}, ""
    for line in document.splitlines():
        parts = [part.strip() for part in re.split(r"(?<!\\)\|", line)[1:-1]]
        if len(parts) != 2 + len(COLUMNS) or parts[1] in ("form", "---"):
            continue
        if parts[0]:
            name = re.match(r"\*\*(.*?)\.\*\*", parts[0])[1]
        found[name, parts[1].split(":")[0].split(" ")[0]] = parts[2:]
    return found
