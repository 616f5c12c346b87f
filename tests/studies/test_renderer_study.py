"""The renderer benchmark: its peer draws the same image, and its table is complete and plausible."""

import csv

import torch

from heatsplat.renderers import rasterization
from heatsplat.studies.renderer import Case, build, render_torch_tiles, run


def test_the_torch_tiles_draw_what_the_renderer_draws():
    scene, _ = build(Case(500, 48, 40, channels=3))
    arguments = {key: scene[key] for key in ("means", "quats", "scales", "opacities", "features")} | scene["camera"]
    expected = rasterization(**arguments, backend="reference").features
    found = render_torch_tiles(**arguments)
    assert (found - expected).abs().mean() < 1e-4  # it does not stop at a transmittance of 1e-4


def test_a_small_study_writes_a_table_with_floors_and_ratios(tmp_path):
    threads = torch.get_num_threads()
    rows = run(
        tmp_path, counts=(500, 1000), sizes=((64, 48),), channels=(1,), modalities=(1,), threads=(1,), rounds=2,
        torch_tiles=((500, 64, 48),),
    )  # fmt: skip
    torch.set_num_threads(threads)
    assert len(rows) == 3 and rows[-1]["torch tiles / cpu"] > 1
    assert all(0 < row["share_of_floor_forward"] <= 1.05 for row in rows)
    with open(tmp_path / "renderer.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == 3
    assert "of floor" in (tmp_path / "renderer.md").read_text()
    assert (tmp_path / "renderer.png").stat().st_size > 1000
