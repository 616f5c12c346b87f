"""docs/site.py: links to the top of the repository lead to pages of the site, which mkdocs itself is not needed for."""

import importlib.util
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def site():
    spec = importlib.util.spec_from_file_location("site_of_the_docs", DOCS / "site.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_links_keep_their_anchors(site):
    assert site.on_page_markdown("[a](../README.md) [b](../README.md#results), [c](../CHANGELOG.md#v1)") == (
        "[a](index.md) [b](index.md#results), [c](changelog.md#v1)"
    )
    assert site.on_page_markdown("[a](../README.mdx) [b](README.md)") == "[a](../README.mdx) [b](README.md)"
    assert site.linked("[a](CONTRIBUTING.md#tests) [b](scaling.md)") == "[a](contributing.md#tests) [b](scaling.md)"


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda page: page.name)
def test_no_link_of_a_page_leaves_the_site(site, page):
    assert re.findall(r"\]\(\.\./[^)]*\)", site.on_page_markdown(page.read_text(encoding="utf-8"))) == []
