"""The rows that put our defaults back: each changes what it says and nothing else, to what ``recipe=published`` has."""

from collections.abc import Mapping
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf
from running import compose_run

ROWS = yaml.safe_load(Path(__file__).resolve().parents[2].joinpath("conf/experiment/defaults.yaml").read_text())
ROWS = {name: row["set"] for name, row in ROWS["hydra"]["sweeper"]["rows"].items()}
OURS, *SINGLE, ALL = ROWS


def settings(*overrides: str) -> dict[str, object]:
    """What a run is made of: key with dots -> value."""
    found: dict[str, object] = {}

    def look(place: str, value: Mapping) -> None:
        for key, each in value.items():
            if isinstance(each, Mapping):
                look(f"{place}{key}.", each)
            else:
                found[f"{place}{key}"] = each

    config = OmegaConf.to_container(compose_run("experiment=defaults", *overrides), resolve=True)
    look("", {key: value for key, value in config.items() if key not in ("module", "published")})
    return found


def changes(ours: dict[str, object], other: dict[str, object]) -> dict[str, object]:
    return {key: value for key, value in other.items() if ours.get(key, KeyError) != value}


@pytest.mark.parametrize("method", ["etgs", "ravigs", "thermogs", "auto"])
def test_each_row_changes_settings_of_its_own_and_the_last_row_all_of_them(method):
    ours = settings(f"method={method}", *ROWS[OURS])
    rows = {name: changes(ours, settings(f"method={method}", *ROWS[name])) for name in SINGLE}
    assert [name for name, changed in rows.items() if not changed] == []
    keys = [key for changed in rows.values() for key in changed]
    assert len(keys) == len(set(keys))
    together = changes(ours, settings(f"method={method}", *ROWS[ALL]))
    assert together == {key: value for changed in rows.values() for key, value in changed.items()}


def test_rows_go_back_to_what_the_recipe_of_the_papers_has():
    """Of a method whose papers say nothing else; its cap, background and harmonics are no rows."""
    ours, published = settings("method=3dgs"), settings("method=3dgs", "recipe=published")
    back = settings("method=3dgs", *ROWS[ALL])
    assert changes(back, published).keys() == {"cap_max", "density.cap_max", "renderer.background", "thermal.sh_degree"}
    assert len(changes(ours, back)) > 10
