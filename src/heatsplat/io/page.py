"""report.html: a report in Markdown as one page, with its pictures in it."""

from __future__ import annotations

import base64
import html
import io
import re
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
from markdown_it import MarkdownIt
from PIL import Image

from heatsplat.io.files import write_atomically

PAGE_FILE = "report.html"
QUALITY = 85  # of WebP, of 100, for still pictures
WEBP_SIDE = 16383  # pixels of a side, the most that WebP has
FOLDED = ("The run", "Data: findings and assumptions", "Definitions of the scores", "Versions")
STYLE = """
:root { color-scheme: light dark; --paper: #ffffff; --ink: #1b1f24; --faint: #5d6672; --line: #e3e6ea; --accent: #b84a08; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #14171b; --ink: #eceef1; --faint: #98a1ab; --line: #2a2f36; --accent: #ff8a3d; }
}
body { margin: 0 auto; padding: 2rem 1.25rem 4rem; max-width: 1160px; background: var(--paper); color: var(--ink);
  font: 16px/1.55 Inter, system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.75rem; font-weight: 650; letter-spacing: -.01em; margin: 0 0 .6rem; }
h2, summary { font-size: 1.15rem; font-weight: 600; margin: 2.4rem 0 .8rem;
  border-top: 1px solid var(--line); padding-top: 1.2rem; }
summary { cursor: pointer; }
nav { display: flex; flex-wrap: wrap; gap: .4rem; font-size: .85rem; }
nav a { padding: .15rem .7rem; border: 1px solid var(--line); border-radius: 1rem; color: var(--ink); text-decoration: none; }
nav a:hover { border-color: var(--accent); color: var(--accent); }
a { color: var(--accent); }
img { max-width: 100%; height: auto; border: 1px solid var(--line); border-radius: 8px; background: #fff; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .93rem; font-variant-numeric: tabular-nums; overflow-wrap: normal; }
th, td { padding: .35rem 1.4rem .35rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { text-align: left; color: var(--faint); font-size: .85rem; font-weight: 600; }
@media print { details { display: block; } nav { display: none; } }
"""


def write_page(path: Path, text: str) -> None:
    """Writes the page of a report beside it: pictures are taken from the same folder, links stay as they are."""
    write_atomically(path, page(text, path.parent))


def page(text: str, folder: Path) -> str:
    """The page of a report in Markdown whose pictures lie in ``folder``; those that do not, or were damaged, are left out."""
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table")
    body = markdown.render(text)
    body = re.sub(
        r'<img src="([^"]+)" alt="([^"]*)" />', lambda found: _embedded(folder / unquote(found[1]), found[2]), body
    )
    body = re.sub(r"<table>.*?</table>", lambda found: f'<div class="wide">{found[0]}</div>', body, flags=re.S)
    head, *parts = re.split(r"<h2>(.*?)</h2>", body)
    sections, titles = [], []
    for number, (title, content) in enumerate(zip(parts[::2], parts[1::2], strict=True)):
        if html.unescape(title) in FOLDED:
            sections.append(f"<details><summary>{title}</summary>{content}</details>")
        else:
            sections.append(f'<section id="s{number}"><h2>{title}</h2>{content}</section>')
            titles.append(f'<a href="#s{number}">{title}</a>')
    name = re.search(r"<h1>(.*?)</h1>", head)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{name[1] if name else "heatsplat"}</title><link rel="icon" href="data:,"><style>{STYLE}</style></head>\n'
        f"<body>{head}<nav>{''.join(titles)}</nav>\n{''.join(sections)}</body></html>\n"
    )


def plain(text: str) -> str:
    """Markdown that shows a text as it is: names of scenes and files may hold what it takes for emphasis, links or headings."""
    return re.sub(r"[\\\[\]`*~<&]|(?<![^\W_])_|_(?![^\W_])|(?<!\S)#", r"\\\g<0>", text)


def _embedded(path: Path, alternative: str) -> str:
    """A picture with its content in it; stills as WebP, moving ones and drawings (SVG) as they are. Empty where none can
    be read."""
    if not path.exists():
        return ""
    content = path.read_bytes()
    if path.suffix == ".svg":
        return f'<img src="data:image/svg+xml;base64,{_base64(content)}" alt="{alternative}">'
    if path.suffix == ".png":  # by OpenCV: of more than 179 million pixels Pillow refuses a picture as an attack
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        if pixels is None:
            return ""
        content, (width, height) = _as_webp(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))
    else:
        with Image.open(io.BytesIO(content)) as picture:
            width, height = picture.size
            if not getattr(picture, "is_animated", False):
                content, (width, height) = _as_webp(np.asarray(picture.convert("RGB")))
    size = f'width="{width}" height="{height}"'
    return f'<img src="data:image/webp;base64,{_base64(content)}" alt="{alternative}" {size}>'


def _as_webp(pixels: np.ndarray) -> tuple[bytes, tuple[int, int]]:
    """A picture [H, W, 3] as a file, and its width and height: smaller where WebP knows none as large."""
    picture, stored = Image.fromarray(pixels), io.BytesIO()
    picture.thumbnail((WEBP_SIDE, WEBP_SIDE))
    picture.save(stored, "WEBP", quality=QUALITY, method=2)
    return stored.getvalue(), picture.size


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
