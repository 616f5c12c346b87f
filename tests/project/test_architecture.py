"""Who may import whom (docs/architecture.md), read from the source with ast."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "heatsplat"

# Package -> packages of heatsplat that it may import. Packages are folders, or single files at the top of heatsplat.
ALLOWED = {
    "errors": set(),
    "contracts": {"errors"},
    "derivatives": set(),
    "same_bits": {"derivatives"},
    "physics": {"contracts", "derivatives", "kernels", "same_bits"},
    "geometry": {"contracts", "derivatives", "kernels"},
    "kernels": set(),
    "splats": {"contracts", "same_bits"},
    "sensors": {"contracts", "derivatives", "geometry", "physics", "kernels", "same_bits"},
    "losses": {"contracts", "derivatives", "geometry", "physics", "kernels", "same_bits", "splats"},
    "metrics": {"contracts", "geometry", "physics"},
    "renderers": {"contracts", "derivatives", "geometry", "splats", "kernels"},
    "thermal": {"contracts", "derivatives", "geometry", "physics", "same_bits", "splats", "kernels"},
    "density": {"contracts", "geometry", "physics", "same_bits", "splats"},
    "effects": {"contracts", "geometry", "physics", "kernels", "training"},
    "io": {"contracts", "errors", "metrics", "physics", "geometry", "heatsplat"},
    "callbacks": {
        "contracts",
        "export",
        "geometry",
        "metrics",
        "physics",
        "io",
        "kernels",
        "heatsplat",
        "shots",
        "uncertainty",
        "viewer",
    },
    "export": {"contracts", "geometry", "io", "physics", "renderers", "shots", "uncertainty"},
    "viewer": {"contracts", "export", "io"},
    "composition": {"io", "training", "heatsplat"},
    "explanations": {"composition", "errors", "io"},
    "usage": {"composition", "io"},
    "doctor": {"contracts", "effects", "geometry", "io", "physics"},
    "runs": {
        "contracts",
        "composition",
        "doctor",
        "effects",
        "errors",
        "geometry",
        "io",
        "renderers",
        "shots",
        "splats",
        "training",
    },
    "studies": {"composition", "contracts", "geometry", "losses", "metrics", "io", "training"},
    "training": {
        "contracts",
        "geometry",
        "splats",
        "sensors",
        "losses",
        "renderers",
        "thermal",
        "density",
        "io",
        "kernels",
        "physics",
        "same_bits",
    },  # fmt: skip
    "shots": {"contracts", "geometry", "io"},
    "uncertainty": {"contracts", "geometry", "physics", "shots", "thermal"},
    "cli": {
        "composition",
        "errors",
        "explanations",
        "export",
        "runs",
        "io",
        "training",
        "shots",
        "studies",
        "uncertainty",
        "usage",
        "viewer",
    },
    "datamodules": {"contracts", "geometry", "physics", "sensors", "training"},
    "preparation": {"contracts", "datamodules", "doctor", "export", "geometry", "io", "physics", "runs"},
}
BESIDE = ("datamodules", "preparation")  # beside src/; only configurations name what is in them
BASES_ONLY = {"thermal": {"base"}, "density": {"base", "ops"}, "sensors": {"base"}}  # what training may know
# Third-party package -> places that may import it.
DOORS = {
    "hydra": {"cli", "composition", "explanations"},
    "omegaconf": {"cli", "composition", "explanations"},
    "pytorch_lightning": {"training", "callbacks", "datamodules"},
    "pycolmap": {"datamodules/formats"},
    "pvlib": {"datamodules"},
    "cv2": {"datamodules/formats", "datamodules/synthetic_scene", "io", "metrics", "preparation"},
    "numba": {"kernels"},
    "gsplat": {"renderers"},
    "triton": {"kernels/gpu"},
}


@cache
def sources() -> list[Path]:
    return sorted([*PACKAGE.rglob("*.py"), *(path for name in BESIDE for path in (ROOT / name).rglob("*.py"))])


def package_of(path: Path) -> str:
    return path.relative_to(PACKAGE if PACKAGE in path.parents else ROOT).parts[0].removesuffix(".py")


def place_of(path: Path) -> str:
    relative = path.relative_to(PACKAGE if PACKAGE in path.parents else ROOT)
    return relative.parent.as_posix() if relative.parent.as_posix() != "." else relative.stem


@cache
def imports_of(path: Path) -> frozenset[str]:
    """Dotted names that a file imports, anywhere in it: module names, and module.name for "from module import name"."""
    found, inside = set(), [ast.parse(path.read_text())]
    while inside:
        node = inside.pop()
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif not isinstance(node, ast.expr):  # which holds no statement
            inside += ast.iter_child_nodes(node)
    return frozenset(found)


PACKAGES = sorted({package_of(path) for path in sources()})


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_what_they_may(package):
    if package == "__init__":
        return
    files = [path for path in sources() if package_of(path) == package]
    assert package in ALLOWED, f"{files[0]} is in no known package; give it one in docs/architecture.md and here"
    for path, name in [(file, name) for file in files for name in imports_of(file)]:
        parts = name.split(".")
        if parts[0] == "heatsplat" and parts[1:2] and parts[1] in BESIDE:
            assert package in BESIDE, f"{path} imports {name}: only configurations name what lies beside src/"
        assert parts[0] != "benchmarks", f"{path} imports {name}: the package never imports what stands beside it"
        if parts[0] != "heatsplat" or len(parts) == 1 or package == parts[1]:
            continue
        there = parts[1] in BESIDE or (PACKAGE / parts[1]).exists()
        other = parts[1] if there or (PACKAGE / f"{parts[1]}.py").exists() else "heatsplat"
        assert other in ALLOWED[package], f"{path} imports {name}: {package} may import {sorted(ALLOWED[package])}"
        if package == "training" and other in BASES_ONLY:
            assert parts[2] in BASES_ONLY[other], f"{path} imports {name}: training knows no variant by name"


@pytest.mark.parametrize("package", DOORS)
def test_third_party_packages_come_in_by_their_door(package):
    for path in sources():
        if package in {name.split(".")[0] for name in imports_of(path)}:
            place = place_of(path)
            assert any(place == door or place.startswith(f"{door}/") for door in DOORS[package]), (
                f"{path} imports {package}, which belongs in {sorted(DOORS[package])}"
            )


def test_kernels_know_numpy_and_numba_only():
    for path in (PACKAGE / "kernels").rglob("*.py"):
        assert "torch" not in {name.split(".")[0] for name in imports_of(path)}, path


def test_the_table_of_the_page_says_what_is_allowed():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)(?:/|\.py)` \|.*\| ([^|]*) \|$", page, re.M)
    assert {name: set(re.findall(r"`(\w+)`", imports)) for name, imports in rows} == ALLOWED


def test_the_check_itself_sees_a_forbidden_import(tmp_path):
    source = tmp_path / "bad.py"
    source.write_text("from heatsplat.training import module\nimport cv2\n")
    assert imports_of(source) == {"heatsplat.training.module", "cv2"}
    source = tmp_path / "hidden.py"
    source.write_text("try:\n    pass\nexcept OSError:\n    with open('x'):\n        import triton\n")
    source.write_text(source.read_text() + "match 1:\n    case _:\n        def f(): import gsplat.a as b\n")
    assert imports_of(source) == {"triton", "gsplat.a"}
