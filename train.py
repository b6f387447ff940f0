"""Trains a policy, e.g. python train.py terrain=poles steps=2e6 run=runs/NAME; --help lists every setting."""

import sys

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from tlq import config as settings


@hydra.main(version_base=None, config_path="tlq/conf", config_name="train")
def run(node: DictConfig) -> None:
    from tlq.training import TrainingFailed, train

    try:
        config = settings.from_hydra(node, HydraConfig.get().overrides.task)
        settings.use_cache(config.cache)
        print(f"run {config.run}", flush=True)
        train(config)
    except (ValueError, TrainingFailed) as error:
        settings.fail(error)


if __name__ == "__main__":
    settings.register()
    try:
        settings.check(sys.argv[1:])
    except settings.ConfigError as error:
        settings.fail(error)
    run()
