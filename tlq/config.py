"""The configuration of a training run, and what turns a command line into one.

Each room's defaults stand in its own dataclass; Hydra's groups `terrain` and `method` only name a choice.
"""

import dataclasses
import os
import time
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tg
from envs.config import METHODS, EnvConfig
from tlq.cli import UsageError, unknown
from tlq.files import whole
from tlq.networks import BEFORE as BEFORE_NETWORKS
from tlq.networks import NetworkConfig
from tlq.ppo import PPOConfig

_WIDTH = (1, 4096)
LIMITS: dict[str, tuple[float, float]] = {
    "num_envs": (1, 1 << 22),
    "steps": (1, 10**15),
    "seed": (0, 2**32 - 1),
    "devices": (0, 1 << 16),
    "processes": (1, 1 << 16),
    "process": (0, 1 << 16),
    "checkpoint_every": (0.0, 1e9),
    "keep": (1, 10_000),
    "log_every": (0.0, 1e9),
    "policy.memory_layers": (1, 16),
    "policy.memory_width": _WIDTH,
    "policy.encoder": _WIDTH,
    "policy.foot_encoder": _WIDTH,
    "policy.head": _WIDTH,
    "policy.leg_head": (0, 4096),
    "policy.foothold_head": (0, 4096),
    "policy.leg_context": _WIDTH,
    "policy.critic": _WIDTH,
    "policy.initial_std": (0.01, 10.0),
    "policy.min_std": (1e-4, 1.0),
    "policy.feet": (4, 4),
    "ppo.unroll": (1, 10_000),
    "ppo.epochs": (1, 1000),
    "ppo.minibatches": (1, 1 << 20),
    "ppo.discount": (0.0, 1.0),
    "ppo.gae_lambda": (0.0, 1.0),
    "ppo.clip": (1e-4, 10.0),
    "ppo.learning_rate": (1e-9, 1.0),
    "ppo.learning_rate_min": (1e-9, 1.0),
    "ppo.learning_rate_max": (1e-9, 1.0),
    "ppo.kl_target": (0.0, 10.0),
    "ppo.kl_stop": (0.0, 1e3),
    "ppo.entropy": (0.0, 10.0),
    "ppo.value_loss": (0.0, 1e3),
    "ppo.max_grad_norm": (1e-6, 1e6),
    "ppo.reward_scaling": (1e-6, 1e6),
    "ppo.guide": (0.0, 1e3),
    "ppo.guide_rate": (0.0, 1.0),
    "ppo.critic_rate": (0.0, 1.0),
    "ppo.guide_epochs": (1, 1000),
    "ppo.average": (0.0, 0.99999),
    "ppo.taken_over": (0.0, 1e3),
    "init_spread": (0.01, 100.0),
}
"""Limits of the numbers outside of `env` (those have theirs in `envs.limits`), both ends included."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A training run: what a user sets on the command line of train.py."""

    env: Any = None
    """The environment (`envs.EnvConfig`); `terrain=` and `method=` set its main choices."""
    policy: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    """Sizes of policy and critic."""
    ppo: PPOConfig = dataclasses.field(default_factory=PPOConfig)
    """Settings of the update."""
    num_envs: int = 1024
    """Environments B over all devices."""
    steps: int = 10_000_000
    """Environment steps after which the run is complete; written 2e6 or 2_000_000."""
    seed: int = 0
    """Seed of everything random in training; the terrains have their own (`env.terrain.seed`)."""
    run: str = ""
    """Folder of the run; default runs/<terrain>-<method>-<date-time>."""
    resume: bool = False
    """Go on with the run in that folder, with the settings it was started with."""
    init: str = ""
    """Run folder or policy file whose parameters and normaliser to start from."""
    init_spread: float = 1.0
    """Factor on the spread, beyond `policy.min_std`, with which the policy that `init` names explores: one that walks,
    but on narrow footholds stumbles over its own exploration, goes on better with less."""
    devices: int = 0
    """Devices to use; 0: all of them."""
    coordinator: str = ""
    """For training on several hosts: host:port of process 0, the same in every process, or "auto" under Slurm, Open MPI
    or Kubernetes. Empty: this process alone."""
    processes: int = 1
    """Number of processes, with a coordinator's address."""
    process: int = 0
    """Number of this process, from 0."""
    checkpoint_every: float = 300.0
    """Seconds between checkpoints."""
    keep: int = 3
    """Checkpoints kept."""
    log_every: float = 10.0
    """Seconds between lines of text."""
    cache: str = "~/.cache/tlq/jax"
    """Folder of JAX's compilation cache; empty: none."""


def default_config() -> TrainConfig:
    """All defaults, the environment's included."""
    import envs

    return TrainConfig(env=envs.EnvConfig())


def make(
    name: str = "poles", *, num_terrains: int | None = None, method: str = "ours", **overrides: Any
) -> Any:
    """The quadruped on a kind of terrain, as a Brax environment (one instance, no auto-reset).

    overrides: other fields of `envs.EnvConfig` by name; nested ones with __ for the dot, e.g. tg__step_length=0.25.
    """
    import envs

    values = {
        "terrain.kind": name,
        "method": method,
        **{k.replace("__", "."): v for k, v in overrides.items()},
    }
    if num_terrains is not None:
        values["terrain.num_terrains"] = num_terrains
    return envs.make(changed(envs.EnvConfig(), values))


def changed(config: Any, values: Mapping[str, Any]) -> Any:
    """Copy of a nested dataclass with the fields at dotted keys set."""
    for key, value in values.items():
        config = replace(config, key, value)
    return config


def replace(config: Any, key: str, value: Any) -> Any:
    """Copy of a nested dataclass with the field at a dotted key set."""
    name, _, rest = key.partition(".")
    known = [f.name for f in dataclasses.fields(config)]
    if name not in known:
        raise UsageError(unknown("setting", name, known))
    return dataclasses.replace(
        config, **{name: replace(getattr(config, name), rest, value) if rest else value}
    )


# -- Hydra -----------------------------------------------------------------------------------------------------------


def register() -> None:
    """Makes the schema and the choices of the groups known to Hydra."""
    from hydra.core.config_store import ConfigStore
    from omegaconf import OmegaConf

    import terrains

    store = ConfigStore.instance()
    schema = OmegaConf.structured(default_config())
    _writable(schema)
    store.store(name="schema", node=schema, provider="tlq")
    for kind in terrains.kinds():
        store.store(group="terrain", name=kind, node={"kind": kind}, package="env.terrain", provider="tlq")
    for method in METHODS:
        store.store(group="method", name=method, node={"method": method}, package="env", provider="tlq")


def _writable(node: Any) -> None:
    """Frozen dataclasses become read-only nodes, which Hydra couldn't override."""
    from omegaconf import DictConfig, OmegaConf

    OmegaConf.set_readonly(node, False)
    if isinstance(node, DictConfig) and not node._is_none():
        for key in node:
            child = node._get_node(key)
            if isinstance(child, DictConfig):
                _writable(child)


def clean(arguments: Sequence[str]) -> list[str]:
    """The command line with whole numbers written as such.

    Raises UsageError, one line that names the valid choices, where Hydra would answer with many.
    """
    cleaned, flags, after = [], [], ""
    for argument in arguments:
        if argument.startswith("-") or after in ("-c", "--cfg", "-p", "--package"):
            flags.append(argument)
            cleaned.append(argument)
        else:
            cleaned.append(_clean(argument))
        after = argument
    if not flags:
        _try(cleaned)
    return cleaned


def _clean(argument: str) -> str:
    import terrains

    choices: dict[str, Sequence[str]] = {"terrain": terrains.kinds(), "method": METHODS}
    key, equals, value = argument.partition("=")
    if key.startswith(("hydra", "+", "~")):
        return argument
    if not equals:
        raise UsageError(f"'{argument}' isn't of the form key=value, e.g. terrain=poles")
    if key in choices:
        for name in value.split(","):  # a sweep has several
            if name not in choices[key]:
                raise UsageError(unknown(key, name, choices[key]))
        return argument
    default: Any = default_config()
    for i, name in enumerate(key.split(".")):
        known = [f.name for f in dataclasses.fields(default)] if dataclasses.is_dataclass(default) else []
        if name not in known:
            raise UsageError(unknown("setting", key, [*choices, *known] if i == 0 else known))
        default = getattr(default, name)
    if dataclasses.is_dataclass(default):
        raise UsageError(
            f"{key} is a group of settings, e.g. {key}.{dataclasses.fields(default)[0].name}={value}"
        )
    if type(default) in (int, float, bool):
        value = ",".join(_number(key, part, type(default)) for part in value.split(","))
    return f"{key}={value}"


def _number(key: str, text: str, kind: type) -> str:
    """Hydra's spelling of a number or truth value: 2e6 is a whole number too."""
    if kind is bool:
        if text.lower() in ("true", "false"):
            return text
        raise UsageError(f"{key}={text} isn't true or false")
    try:
        number = float(text)
        if kind is int and number != int(number):
            raise ValueError
    except (ValueError, OverflowError):
        raise UsageError(f"{key}={text} isn't a {'whole ' if kind is int else ''}number") from None
    plain = text.lstrip("+-").replace("_", "").isdigit()
    return text if kind is float or plain else str(int(number))


def _try(arguments: Sequence[str]) -> Any:
    """What Hydra makes of the arguments."""
    from hydra import compose, initialize_config_dir

    try:
        with initialize_config_dir(str(Path(__file__).parent / "conf"), version_base=None):
            return compose("train", list(arguments))
    except Exception as error:  # its parser and OmegaConf raise many kinds on nonsense
        why = str(error.__cause__ or error).strip().partition("\n")[0] or type(error).__name__
        raise UsageError(f"{why} ({' '.join(map(repr, arguments))})") from None


def from_hydra(node: Any, overrides: Sequence[str] = ()) -> TrainConfig:
    """Typed configuration from what Hydra composed; overrides: the command line, needed for `resume`."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        data = OmegaConf.to_container(node, resolve=True)
    except OmegaConfBaseException as error:  # an interpolation that leads nowhere
        raise UsageError(str(error).strip().partition("\n")[0]) from None
    if data["resume"]:
        data = _resumed(data, overrides)
    config = build(TrainConfig, data)
    validate(config)
    return config if config.run else dataclasses.replace(config, run=default_run(config))


def _resumed(data: dict[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """The settings a run was started with, changed by those given on the command line."""
    from omegaconf import OmegaConf

    path = Path(data["run"]) / "config.yaml"
    if not data["run"] or not path.exists():
        raise UsageError(f"run={data['run']} holds no run to resume")
    saved = OmegaConf.to_container(OmegaConf.create(dataclasses.asdict(load_config(path))))
    groups = {"terrain": saved["env"]["terrain"]["kind"], "method": saved["env"]["method"]}
    for override in overrides:
        key, _, value = override.lstrip("+").partition("=")
        if groups.get(key, value) != value:
            raise UsageError(
                f"{path} has {key}={groups[key]}; for another one, start a run with init={data['run']}"
            )
        if key in groups:
            continue
        new, old = data, saved
        *parents, last = key.split(".")
        for name in parents:
            new, old = new[name], old[name]
        old[last] = new[last]
    return saved


def training_env(metadata: dict[str, Any]) -> Any:
    """The `envs.EnvConfig` in which a policy was trained, from its file's metadata."""
    env = metadata["training"]["env"]
    return build(EnvConfig, env | {"tg": tg.BEFORE | env["tg"]})


def build(cls: Any, data: dict[str, Any]) -> Any:
    """Nested frozen dataclass from a nested dict; lists become tuples, so that configurations can be hashed."""
    hints = typing.get_type_hints(cls)
    known = [f.name for f in dataclasses.fields(cls)]
    for name in data:
        if name not in known:
            raise UsageError(unknown("setting", name, known))
    values = {}
    for name, value in data.items():
        kind = hints[name]
        if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
            kind = next(k for k in typing.get_args(kind) if k is not type(None))
        if cls is TrainConfig and name == "env":
            import envs

            kind = envs.EnvConfig
        nested = isinstance(value, dict) and dataclasses.is_dataclass(kind)
        values[name] = build(kind, value) if nested else _tuples(value)
    return cls(**values)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value


def validate(config: TrainConfig) -> None:
    """Raises UsageError for values that no type excludes."""
    from tlq.memory import KINDS

    if config.policy.memory not in KINDS:
        raise UsageError(unknown("policy.memory", config.policy.memory, KINDS))
    from envs import env as environment
    from envs.limits import check_values, leaves

    own = {name: value for name, value in leaves(config) if not name.startswith("env.")}
    try:
        check_values(own, LIMITS)
        if config.env is not None:
            environment.check(config.env)
    except ValueError as error:
        raise UsageError(str(error)) from None
    if not config.policy.foot_encoder or not config.policy.critic:
        raise UsageError("policy.foot_encoder and policy.critic need at least one layer each")
    if config.policy.min_std >= config.policy.initial_std:
        raise UsageError("policy.min_std must be below policy.initial_std")
    if config.ppo.learning_rate_min > config.ppo.learning_rate_max:
        raise UsageError("ppo.learning_rate_min must not be above ppo.learning_rate_max")
    if not 0 <= config.process < config.processes:
        raise UsageError(f"process={config.process} must be from 0 to processes - 1 = {config.processes - 1}")
    if config.processes > 1 and config.coordinator in ("", "auto"):
        raise UsageError(
            f"processes={config.processes} needs the address of process 0, e.g. coordinator=192.168.0.1:1234"
        )
    if config.coordinator and not config.run:
        raise UsageError("with coordinator= set run=, the same folder in every process")
    if config.init_spread != 1.0 and not config.init:
        raise UsageError("init_spread needs init=, a run folder or policy file")
    if config.num_envs % config.ppo.minibatches:
        raise UsageError(
            f"num_envs={config.num_envs} must be a multiple of ppo.minibatches={config.ppo.minibatches}"
        )


def default_run(config: TrainConfig) -> str:
    """runs/<terrain>-<method>-<date-time>."""
    return f"runs/{config.env.terrain.kind}-{config.env.method}-{time.strftime('%Y%m%d-%H%M%S')}"


def save_config(config: TrainConfig, path: Path) -> None:
    """Writes the resolved configuration as YAML."""
    from omegaconf import OmegaConf

    with whole(path) as temporary:
        OmegaConf.save(
            OmegaConf.create(dataclasses.asdict(dataclasses.replace(config, resume=False))), temporary
        )


def load_config(path: Path) -> TrainConfig:
    """Reads what `save_config` wrote; raises UsageError where it isn't that."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError  # type: ignore[import-untyped]

    try:
        # Merged into the schema, which gives every value its type.
        schema = OmegaConf.structured(default_config())
        _writable(schema)
        found = OmegaConf.merge({"env": {"tg": tg.BEFORE}, "policy": BEFORE_NETWORKS}, OmegaConf.load(path))
        return build(TrainConfig, OmegaConf.to_container(OmegaConf.merge(schema, found)))
    except (
        OmegaConfBaseException,
        YAMLError,
        UnicodeDecodeError,
        UsageError,
        ValueError,
        TypeError,
    ) as error:
        why = str(error).strip().partition("\n")[0]
        raise UsageError(f"{path} is damaged, or of another version: {why}") from None


def use_cache(folder: str) -> None:
    """Turns on JAX's persistent compilation cache."""
    import jax

    if folder:
        jax.config.update("jax_compilation_cache_dir", os.path.expanduser(folder))
