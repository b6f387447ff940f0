"""Trains a policy, e.g. python train.py terrain=poles steps=2e6 run=runs/NAME; --help lists every setting."""

import sys

from tlq.cores import join, use_all_cores

use_all_cores()  # before JAX starts

import hydra  # noqa: E402
from hydra.core.hydra_config import HydraConfig  # noqa: E402
from omegaconf import DictConfig  # noqa: E402

from tlq import cli  # noqa: E402
from tlq import config as settings  # noqa: E402


@hydra.main(version_base=None, config_path="tlq/conf", config_name="train")
def run(node: DictConfig) -> None:
    """One run, of the configuration that Hydra composed."""
    from tlq.training import TrainingFailed, train

    try:
        config = settings.from_hydra(node, HydraConfig.get().overrides.task)
        if config.coordinator:
            join(config.coordinator, config.processes, config.process)
        settings.use_cache(config.cache)
        train(config)
    except (ValueError, OSError) as error:
        cli.fail(error)
    except TrainingFailed as error:
        cli.fail(error, at_once=True)
    except KeyboardInterrupt:  # once training goes on it is a request to save and stop
        cli.stopped()


if __name__ == "__main__":
    settings.register()
    try:
        sys.argv[1:] = settings.clean(sys.argv[1:])
    except cli.UsageError as error:
        cli.fail(error)
    run()
