"""Runs in the test process: the configuration composed as the command line would, the parts built from it."""

from __future__ import annotations

from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from heatsplat import cli

TINY = ("data.size=tiny", "callbacks.probes=null", "callbacks.images=null", "threads=2")


def compose_run(output_dir: Path, *overrides: str, config_name: str = "train") -> DictConfig:
    """The configuration of ``python src/train.py OVERRIDES`` writing into ``output_dir``."""
    with initialize_config_dir(cli.CONF, version_base="1.3"):
        config = compose(config_name, overrides=list(overrides), return_hydra_config=True)
    with open_dict(config):
        config.hydra.runtime.output_dir = str(output_dir)
    HydraConfig.instance().set_config(config)
    with open_dict(config):
        plain = OmegaConf.to_container(config, resolve=False)
        plain.pop("hydra")
    return OmegaConf.create(plain)


def run(output_dir: Path, *overrides: str):
    """(module, trainer) after a run with these overrides; tests its views too unless test=false is among them."""
    from heatsplat.training.session import fit, prepare_machine

    config = compose_run(output_dir, *overrides)
    prepare_machine(config.threads)
    data = cli.build(cli.resolved(config)["data"])
    plain = cli.resolved(config) if config.budget is None else cli.budgeted(config, data, output_dir)
    plain = cli.with_effects(plain, data)
    trainer = cli.build(
        plain["trainer"], callbacks=cli.build_callbacks(plain["callbacks"]), logger=cli.build(plain["logger"])
    )
    module = cli.build(plain["module"], output_dir=str(output_dir))
    module.recipe = plain
    fit(module, data, trainer, ckpt=plain["ckpt"], test=plain["test"])
    return module, trainer
