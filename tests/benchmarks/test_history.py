"""Speed over time: one line of ratios for each commit and machine, and a picture of them."""

import pytest

from benchmarks import history
from heatsplat.contracts import SceneError

TABLES = {
    "renderer": [{"share_forward": 0.5, "share_backward": 0.2}, {"share_forward": 0.125, "share_backward": 0.2}],
    "peers": [{"case": "500, 64x48", "peer": "torch tiles", "ratio, 1 thread(s)": 90.0, "ratio, 2 thread(s)": 160.0}],
    "loss": [{"full window, ratio": 4.0, "separable, ratio": 2.0}],
    "training": [
        {"method": "3dgs", "case": "a", "threads": 2, "ratio": 1.0},
        {"method": "etgs", "case": "a", "threads": 2, "ratio": 1.2},
    ],
}  # fmt: skip


def test_ratios_of_a_kind_are_one_and_no_millisecond_is_among_them():
    found = history.ratios(TABLES)
    assert found["forward: its floor / its time"] == (pytest.approx(0.25), history.HIGHER)
    assert found["torch tiles / ours, 500, 64x48, 2 thread(s)"][0] == pytest.approx(160.0)
    assert found["step: etgs / the first method, a, 2 thr."] == (pytest.approx(1.2), history.LOWER)
    assert len(found) == 7


def test_a_line_takes_the_place_of_the_earlier_one_of_its_commit_and_machine(tmp_path, monkeypatch):
    path = tmp_path / "history.jsonl"
    for number, made, where in (
        ("b", "2026-02-01", "x"),
        ("a", "2026-01-01", "x"),
        ("a", "2026-01-01", "y"),
        ("a", "2026-01-01", "x"),
    ):
        monkeypatch.setattr(history, "commit", lambda number=number, made=made: (number, made, False))
        monkeypatch.setattr(history, "processor", lambda where=where: where)
        history.add_line(path, TABLES)
    lines = history.run(tmp_path / "out", str(path))
    assert [(line["commit"], line["machine"]) for line in lines] == [("a", "y"), ("a", "x"), ("b", "x")]
    assert (tmp_path / "out" / "history.png").stat().st_size > 10_000
    assert "| b | 2026-02-01 | x |" in (tmp_path / "out" / "history.md").read_text()


def test_what_is_no_line_is_named(tmp_path):
    with pytest.raises(SceneError, match="has no lines yet: make bench"):
        history.run(tmp_path, str(tmp_path / "none.jsonl"))
    (tmp_path / "bad.jsonl").write_text('{"commit": "a"}\n')
    with pytest.raises(SceneError, match="bad.jsonl, line 1 is no line of make bench"):
        history.read_lines(tmp_path / "bad.jsonl")


def test_this_checkout_and_machine_have_names():
    number, made, _ = history.commit()
    assert (len(number), made[:2]) in ((12, "20"), (0, "")) and "cores" in history.processor()
