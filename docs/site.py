"""What ``make docs`` adds to the pages of this folder: the files at the top of the repository, and a page for every module."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = Path(__file__).resolve().parents[1]
TOP = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
SOURCES = ROOT / "build" / "reference"  # as a wheel has them
PACKAGES = {"heatsplat": ROOT / "src" / "heatsplat"} | {
    f"heatsplat.{name}": ROOT / name for name in ("datamodules", "preparation")
}


def on_startup(**_: object) -> None:
    """Copies the packages to where mkdocstrings looks for them."""
    shutil.rmtree(SOURCES, ignore_errors=True)
    for package, folder in PACKAGES.items():
        shutil.copytree(folder, SOURCES.joinpath(*package.split(".")), ignore=shutil.ignore_patterns("__pycache__"))


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The files of the site, with README, CONTRIBUTING, CHANGELOG and the reference; the reference's place in ``nav``."""
    from mkdocs.structure.files import File

    for name, page in TOP.items():
        text = linked(re.sub(r"\]\(docs/", "](", (ROOT / name).read_text(encoding="utf-8")))
        files.append(File.generated(config, page, content=text))
    tree: dict = {}
    for path in sorted((SOURCES / "heatsplat").rglob("*.py")):
        parts = path.relative_to(SOURCES).with_suffix("").parts
        if parts[-1].startswith("_") and parts[-1] != "__init__":
            continue
        module = ".".join(parts).removesuffix(".__init__")
        page = "/".join(["reference", *parts[:-1], "index" if parts[-1] == "__init__" else parts[-1]]) + ".md"
        files.append(File.generated(config, page, content=f"# {module}\n\n::: {module}\n"))
        branch = tree
        for part in parts[:-1]:
            branch = branch.setdefault(part, {})
        branch[parts[-1]] = page
    config.nav.append({"Reference": nested(tree["heatsplat"])})
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """A page whose links to the top of the repository lead to pages of the site."""
    return linked(markdown, "../")


def linked(markdown: str, top: str = "") -> str:
    """Text whose links to files at the top of the repository, at ``top``, lead to their pages, to the same heading of them."""
    for name, page in TOP.items():
        markdown = re.sub(rf"\]\({re.escape(top + name)}(?=[)#])", f"]({page}", markdown)
    return markdown


def nested(tree: dict) -> list:
    """A branch of the modules as an entry of ``nav``: the package's own page, then what is in it."""
    own = [tree["__init__"]] if "__init__" in tree else []
    inner = [
        {name: nested(page) if isinstance(page, dict) else page} for name, page in tree.items() if name != "__init__"
    ]
    return own + inner
