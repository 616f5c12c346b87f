"""Folders of jobs as a sweep leaves them."""

from pathlib import Path

import yaml

from heatsplat.io.results import METRICS_FILE, RunResults


def job(
    folder: Path, number: int, overrides: list[str], psnr: float | None, scene: str = "cooling", **costs: float
) -> Path:
    """A job's folder as a run leaves it."""
    path = folder / f"etgs_{scene}_{number}_x"
    (path / ".hydra").mkdir(parents=True)
    (path / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    (path / ".hydra" / "config.yaml").write_text(yaml.safe_dump({"data": {"scene": scene}}))
    if psnr is not None:
        results = RunResults(run={"scene": scene})
        results.put("test", "psnr", psnr)
        results.put("test", "mae_c", 40.0 - psnr)
        results.put("cost", "train_seconds", costs.get("seconds", 10.0))
        results.write(path / METRICS_FILE)
    return path
