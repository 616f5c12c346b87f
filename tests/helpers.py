"""Lists that parametrise the generic tests: what exists is tested."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ALL_RENDERERS = ("reference", "cpu", "gsplat")
ALL_METHODS = tuple(sorted(path.stem for path in (ROOT / "conf" / "method").glob("*.yaml")))
OF_ANCHORS, OF_NOTHING = (
    ("scaffold_gs",),
    ("instant_ngp", "thermonerf"),
)  # what rows of the splats are, where not Gaussians
OF_GAUSSIANS = tuple(sorted(set(ALL_METHODS) - {*OF_ANCHORS, *OF_NOTHING}))
