"""What a report says of whom to cite: CITATION.cff, by method."""

from heatsplat.io.citations import citations


def test_a_method_has_its_paper_and_every_report_heatsplat():
    own, paper = citations("etgs")
    assert own.startswith("The heatsplat authors: heatsplat, version ")
    assert paper.startswith("Zhongwen Wang, Han Ling") and "ICLR" in paper and "https://openreview.net/" in paper
    assert "42(4), 2023. https://doi.org/10.1145/3592433" in citations("3dgs")[1]
    assert citations("bicubic_3dgs")[1] == citations("3dgs")[1]
    assert citations("auto") == citations(None) == [own]
