"""A report in Markdown becomes one page that needs no other file."""

import numpy as np
from PIL import Image

from heatsplat.io.page import page, write_page
from heatsplat.io.pictures import write_png

TEXT = """# etgs on <b>

## Scores

| score | value |
|---|---:|
| psnr | 39 |

![a view](renders/a.png)

![not there](renders/no.png)

[numbers](a.csv)

## Versions

- torch: 2
"""


def test_pictures_are_in_it_and_details_are_folded(tmp_path):
    (tmp_path / "renders").mkdir()
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(tmp_path / "renders" / "a.png")
    write_page(tmp_path / "report.html", TEXT)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert text == page(TEXT, tmp_path)
    assert text.count("<img") == 1 and 'src="data:image/webp;base64,' in text and 'width="8" height="6"' in text
    assert "<title>etgs on &lt;b&gt;</title>" in text and "<b>" not in text
    assert '<td style="text-align:right">39</td>' in text and '<a href="a.csv">numbers</a>' in text
    assert "<details><summary>Versions</summary>" in text and ">Versions</a>" not in text


def test_drawings_stay_drawings(tmp_path):
    (tmp_path / "a.svg").write_text("<svg/>")
    assert '<img src="data:image/svg+xml;base64,PHN2Zy8+" alt="drawn">' in page("# run\n\n![drawn](a.svg)\n", tmp_path)


def test_pictures_of_any_size_are_in_it_and_damaged_ones_are_not(tmp_path, monkeypatch):
    def shown(height: int, width: int) -> str:
        write_png(tmp_path / "a.png", np.zeros((height, width, 3), np.uint8))
        return page("# run\n\n![wide](a.png)\n", tmp_path)

    assert 'width="16383" height="96"' in shown(100, 17000)  # three images of 5,500 pixels beside each other
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)  # of more than twice as many Pillow refuses to open a file
    assert 'width="50" height="60"' in shown(60, 50)
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:60])
    assert "<img" not in page("# run\n\n![wide](a.png)\n", tmp_path)
