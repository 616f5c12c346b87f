"""Lists that parametrise the generic tests: what exists is tested."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ALL_RENDERERS = ("reference", "cpu", "gsplat")
ALL_METHODS = tuple(sorted(path.stem for path in (ROOT / "conf" / "method").glob("*.yaml")))
