"""The sweep over knobs: each row is the default with one number changed."""

from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf
from running import compose_run

ROOT = Path(__file__).resolve().parents[2]
ROWS = yaml.safe_load((ROOT / "conf/experiment/knobs.yaml").read_text())["hydra"]["sweeper"]["rows"]
DEFAULT = compose_run("experiment=knobs")


def test_the_first_row_is_the_default():
    assert next(iter(ROWS.items())) == ("default", {"set": []})


@pytest.mark.parametrize("name", list(ROWS)[1:])
def test_a_row_is_called_what_it_sets_and_sets_what_is_not_the_default(name):
    (override,) = ROWS[name]["set"]
    key, _, value = override.partition("=")
    assert name == f"{key.rpartition('.')[2]} {value}"
    changed = OmegaConf.select(compose_run("experiment=knobs", override), key)
    assert changed == float(value) != OmegaConf.select(DEFAULT, key)
