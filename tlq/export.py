"""Exports a policy into one npz file, or the bare network to ONNX.

    python -m tlq.export run=runs/NAME out=FILE.npz      # or FILE.onnx: a run's newest checkpoint
    python -m tlq.export policy=FILE.npz out=FILE.onnx   # an exported policy, or the name of a shipped one

The npz file holds `graph` (JSON, see `tlq.graph`), `metadata` (JSON, see `describe`) and the initialisers, which have
the names of the parameters in a checkpoint. `tlq.runtime` reads it.
"""

import dataclasses
import functools
import json
import os
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tlq.cli import UsageError, find_policy, option, parse, run
from tlq.files import whole
from tlq.graph import INPUTS, OUTPUTS, Graph
from tlq.runtime import FORMAT, VERSION, load_policy

_PARAMS = "params.policy.params."
PLACE = ("run", "resume", "init", "devices", "cache", "coordinator", "processes", "process")
"""Settings that say where a run took place, not what it was."""
_MEAN, _STD = "normaliser.mean.state", "normaliser.std.state"


def export_policy(
    path: str | os.PathLike[str],
    config: Any,
    params: Any,
    normaliser: Any,
    extra_metadata: Mapping[str, Any] | None = None,
) -> None:
    """Writes a policy file, whole or not at all.

    Args:
      path: of the npz file.
      config: `TrainConfig` of the run.
      params: the policy's parameters, as Flax has them: {"params": ...}.
      normaliser: Brax's running statistics, with `mean` and `std` of "state" (S,).
      extra_metadata: more JSON for the metadata, e.g. {"env_steps": 1000}.
    """
    import jax

    from tlq.checkpoint import names

    tree = {"params": {"policy": params}, "normaliser": normaliser}
    arrays = dict(zip(names(tree), jax.device_get(jax.tree.leaves(tree)), strict=True))
    write(path, config, arrays, extra_metadata)


def write(
    path: str | os.PathLike[str],
    config: Any,
    arrays: Mapping[str, np.ndarray],
    extra_metadata: Mapping[str, Any] | None = None,
) -> None:
    """As `export_policy`, from arrays by their names in a checkpoint, e.g. 'normaliser.mean.state'."""
    from tlq.networks import LEG_SIGN

    kept = {
        n: np.asarray(x, np.float32) for n, x in arrays.items() if n.startswith(_PARAMS) or n in (_MEAN, _STD)
    }
    metadata = describe(config) | dict(extra_metadata or {})
    size = sum(part["size"] for part in metadata["observation"])
    if kept[_MEAN].shape != (size,):
        raise ValueError(
            f"the normaliser is for {kept[_MEAN].size} observed values, the environment shows {size}"
        )
    if any(n.endswith("leg_action.kernel") for n in kept):
        kept["leg_sign"] = LEG_SIGN
    nodes = policy_graph(config.policy, kept, heights=100 if config.env.method != "blind" else 0)
    Graph(nodes, kept)
    _save(Path(path), nodes, kept, metadata)


def _save(
    path: Path, nodes: list[dict[str, Any]], arrays: Mapping[str, Any], metadata: dict[str, Any]
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **_text(graph=nodes, metadata=metadata), **arrays)


def _text(**values: Any) -> dict[str, Any]:
    return {name: np.array(json.dumps(value)) for name, value in values.items()}


# -- what the file says about robot and controller -------------------------------------------------------------------


def describe(config: Any) -> dict[str, Any]:
    """The metadata: everything the runtime and a robot's driver need to know. SI units, radians, legs LF RF LR RR."""
    robot, core = _robot_and_core(config.env)
    c, geometry = core.config, core.geometry
    offsets = np.cumsum([0, *(size for _, size in core.layout)]).tolist()
    return {
        "format": FORMAT,
        "version": VERSION,
        "robot": config.env.robot.name,
        "method": config.env.method,
        "terrain": config.env.terrain.kind,
        "joint_names": list(robot.joint_names),
        "default_pose": _floats(core.default_pose),
        "joint_lower": _floats(core.lower),
        "joint_upper": _floats(core.upper),
        "kp": config.env.robot.kp,
        "kd": config.env.robot.kd,
        "torque_limit": _floats(robot.torque_limit),
        "control_dt": core.dt,
        "tg": dataclasses.asdict(c),
        "leg": {name: _floats(value) for name, value in geometry._asdict().items()},
        "base_foot": _floats(core.base_foot),
        "sag": core.sag,
        "action": [
            {"name": "frequency", "offset": 0, "size": 1, "scale": c.frequency_range, "unit": "Hz"},
            {"name": "lift", "offset": 1, "size": 1, "scale": c.lift_range, "unit": "m"},
            {"name": "residual", "offset": 2, "size": 12, "scale": c.residual_range, "unit": "rad"},
        ],
        "observation": [
            {"name": name, "offset": offset, "size": size}
            for (name, size), offset in zip(core.layout, offsets, strict=False)
        ],
        "memory": {"kind": config.policy.memory, "size": _memory_size(config.policy)},
        "training": _settings(config),
        "commit": commit(),
    }


def _settings(config: Any) -> dict[str, Any]:
    """The training's settings, without those that say where on a machine it ran."""
    settings = dataclasses.asdict(config)
    return {k: v for k, v in settings.items() if k not in PLACE}


@functools.lru_cache(maxsize=4)
def _robot_and_core(env: Any) -> tuple[Any, Any]:
    from envs.env import make_core
    from envs.robot import make_robot

    robot = make_robot(env.robot)
    return robot, make_core(env, robot)


def _memory_size(policy: Any) -> int:
    return 0 if policy.memory == "none" else policy.memory_layers * policy.memory_width


def _floats(x: Any) -> Any:
    return np.asarray(x, float).tolist()


@functools.cache
def commit() -> str:
    """Commit of the code, with a + if files were changed since; empty outside a repository."""
    root = Path(__file__).resolve().parents[1]

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return ""


# -- the graph -------------------------------------------------------------------------------------------------------


class _Builder:
    """Collects nodes; every method returns the name of what the new nodes give."""

    def __init__(self) -> None:
        self.nodes: list[dict[str, Any]] = []

    def add(self, op: str, *inputs: str, outputs: tuple[str, ...] = (), **attributes: Any) -> Any:
        names = outputs or (f"{op}_{len(self.nodes)}",)
        self.nodes.append(
            {"op": op, "inputs": list(inputs), "outputs": list(names), "attributes": attributes}
        )
        return names[0] if len(names) == 1 else names

    def dense(self, layer: str, x: str, bias: bool = True) -> str:
        y = self.add("MatMul", x, f"{_PARAMS}{layer}.kernel")
        return self.add("Add", y, f"{_PARAMS}{layer}.bias") if bias else y

    def elu(self, layer: str, x: str) -> str:
        return self.add("Elu", self.dense(layer, x))

    def split(self, x: str, *sizes: int) -> list[str]:
        names = tuple(f"Split_{len(self.nodes)}_{i}" for i in range(len(sizes)))
        parts = self.add("Split", x, outputs=names, axis=-1, split=list(sizes))
        return [parts] if len(sizes) == 1 else list(parts)

    def norm(self, layer: str, x: str) -> str:
        names = [f"{_PARAMS}{layer}.{part}" for part in ("scale", "bias")]
        return self.add("LayerNormalization", x, *names, axis=-1, epsilon=1e-6)

    def mix(self, gate: str, a: str, b: str) -> str:
        """(1 - gate) a + gate b."""
        return self.add("Add", a, self.add("Mul", gate, self.add("Sub", b, a)))

    def mingru(self, layer: str, h: str, x: str, width: int) -> tuple[str, str]:
        """`tlq.memory.MinGRU`: next memory and output."""
        z, c, g = self.split(self.dense(f"{layer}.gates", self.norm(f"{layer}.norm", x)), width, width, width)
        h = self.mix(self.add("Sigmoid", z), h, self.add("Tanh", c))
        silu = self.add("Mul", g, self.add("Sigmoid", g))
        return h, self.add("Add", x, self.dense(f"{layer}.out", self.add("Mul", h, silu)))

    def gru(self, layer: str, h: str, x: str, width: int) -> tuple[str, str]:
        """`tlq.memory.GRU`: next memory and output."""
        u = self.norm(f"{layer}.norm", x)

        def gate(name: str) -> str:
            inner = self.dense(f"{layer}.cell.h{name}", h, bias=False)
            return self.add("Sigmoid", self.add("Add", self.dense(f"{layer}.cell.i{name}", u), inner))

        r, z = gate("r"), gate("z")
        reset = self.add("Mul", r, self.dense(f"{layer}.cell.hn", h))
        n = self.add("Tanh", self.add("Add", self.dense(f"{layer}.cell.in", u), reset))
        h = self.mix(z, n, h)
        return h, self.add("Add", x, self.dense(f"{layer}.out", h))


def policy_graph(policy: Any, arrays: Mapping[str, np.ndarray], heights: int) -> list[dict[str, Any]]:
    """Nodes of `tlq.networks.Policy` with its normaliser before it and tanh(mean) behind it.

    Args:
      policy: `NetworkConfig`.
      arrays: initialisers, for their shapes.
      heights: how many of the last entries of the observation are heights (not normalised).
    """
    from tlq.networks import CLIP, LAST, RESIDUALS, SAME_SIDE

    b, size = _Builder(), arrays[_MEAN].size
    normal = b.add("Div", b.add("Sub", "observation", _MEAN), _STD)
    normal = b.add("Clip", normal, min=-CLIP, max=CLIP)
    if heights:
        proprio = b.add("Slice", normal, axes=[-1], starts=[0], ends=[size - heights])
        foot = b.add("Slice", "observation", axes=[-1], starts=[size - heights], ends=[size])
        foot = b.add("Gather", foot, axis=-1, indices=SAME_SIDE.tolist())
        foot = heights_by_foot = b.add("Reshape", foot, shape=[policy.feet, heights // policy.feet])
        for i in range(len(policy.foot_encoder)):
            foot = b.elu(f"foot_{i}", foot)
        flat = b.add("Reshape", foot, shape=[policy.feet * policy.foot_encoder[-1]])
        x = b.add("Concat", b.elu("proprio", proprio), flat, axis=-1)
    else:
        x = b.elu("proprio", normal)
    x = b.elu("mix", x)
    y = b.dense("to_memory", x)
    y = _add_memory(b, policy, y)
    y = b.elu("head", b.add("Concat", x, y, axis=-1))
    actions = arrays[f"{_PARAMS}action.bias"].size // 2
    mean, _ = b.split(b.dense("action", y), actions, actions)
    led = any(name.startswith(f"{_PARAMS}footholds.") for name in arrays)
    if led and f"{_PARAMS}footholds.share.kernel" not in arrays:
        raise ValueError(
            "the policy's part for footholds is of an older version; train.py init= starts from the rest"
        )
    if heights and (policy.leg_head or led):
        shared, residuals = b.split(mean, RESIDUALS.start, actions - RESIDUALS.start)
        if policy.leg_head:
            residuals = b.add("Add", residuals, _legs(b, policy, "", [foot], y)[0])
        if led:
            last = ""
            if f"{_PARAMS}footholds.keep.kernel" in arrays:
                last = b.add("Slice", "observation", axes=[-1], starts=[LAST.start], ends=[LAST.stop])
            residuals = _footholds(b, policy, proprio, heights_by_foot, residuals, last)
        mean = b.add("Concat", shared, residuals, axis=-1)
    b.add("Tanh", mean, outputs=("action",))
    return b.nodes


def _footholds(b: _Builder, policy: Any, proprio: str, foot: str, rest: str, last: str) -> str:
    """Residuals (12,) of `tlq.networks.Footholds` with the rest's; foot: the heights (4, 25) of the feet; last: those
    (12,) of the last action, of which a share is kept, or empty.
    """
    for i in range(len(policy.foot_encoder)):
        foot = b.elu(f"footholds.foot_{i}", foot)
    width = policy.foot_encoder[-1]
    order = np.arange(policy.feet * width).reshape(policy.feet, width)[::-1].reshape(-1)
    flat = b.add("Reshape", foot, shape=[policy.feet * width])
    across = b.add("Gather", flat, axis=-1, indices=order.tolist())
    across = b.add("Reshape", across, shape=[policy.feet, width])
    own, leg = _legs(b, policy, "footholds.", [foot, across], b.elu("footholds.proprio", proprio))
    share = b.add("Reshape", b.dense("footholds.share", leg), shape=[3 * policy.feet])
    if last:
        keep = b.add("Reshape", b.dense("footholds.keep", leg), shape=[3 * policy.feet])
        own = b.add("Add", own, b.add("Mul", b.add("Sigmoid", keep), last))
    return b.mix(b.add("Sigmoid", share), rest, own)


def _legs(b: _Builder, policy: Any, prefix: str, foot: list[str], context: str) -> tuple[str, str]:
    """Residuals (12,) of the layers of `prefix` from what each foot sees, (4, ..) each, and a context of all legs; and
    the layer (4, ..) before them.
    """
    context = b.dense(f"{prefix}to_legs", context)
    context = b.add("Reshape", context, shape=[policy.feet, policy.leg_context])
    leg = b.elu(f"{prefix}leg", b.add("Concat", *foot, context, axis=-1))
    residuals = b.add("Mul", b.dense(f"{prefix}leg_action", leg), "leg_sign")
    return b.add("Reshape", residuals, shape=[3 * policy.feet]), leg


def _add_memory(b: _Builder, policy: Any, y: str) -> str:
    if policy.memory == "none":
        b.add("Identity", "memory", outputs=("memory_out",))
        return y
    block = {"mingru": b.mingru, "gru": b.gru}[policy.memory]
    memories = []
    for i, h in enumerate(b.split("memory", *[policy.memory_width] * policy.memory_layers)):
        h, y = block(f"memory.layer_{i}", h, y, policy.memory_width)
        memories.append(h)
    b.add("Concat", *memories, axis=-1, outputs=("memory_out",))
    return y


# -- ONNX ------------------------------------------------------------------------------------------------------------


def write_onnx(path: str | os.PathLike[str], policy_file: str | os.PathLike[str]) -> None:
    """Converts a policy file's network to ONNX (opset 17); needs the package onnx.

    Inputs `observation` (S,) and `memory` (M,), outputs `action` (14,) and `memory_out` (M,). The trajectory generator
    and the leg kinematics are not in it; the metadata goes along as text.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    policy = load_policy(policy_file)
    nodes, constants = [], dict(policy.arrays)
    for node in policy.graph.nodes:
        attributes, inputs = dict(node["attributes"]), list(node["inputs"])
        for name in (
            "starts",
            "ends",
            "axes",
            "split",
            "shape",
            "indices",
            "min",
            "max",
        ):  # attributes that became inputs
            if name in attributes:
                key = f"{node['outputs'][0]}.{name}"
                kind = np.float32 if name in ("min", "max") else np.int64
                constants[key] = np.array(attributes.pop(name), kind)
                inputs.append(key)
        nodes.append(helper.make_node(node["op"], inputs, node["outputs"], **attributes))
    sizes = {"observation": policy.core.observation_size, "memory": policy.memory_size, "action": 14}
    sizes["memory_out"] = sizes["memory"]
    inputs, outputs = (
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [sizes[name]]) for name in group]
        for group in (INPUTS, OUTPUTS)
    )
    tensors = [numpy_helper.from_array(np.asarray(x), name) for name, x in constants.items()]
    graph = helper.make_graph(nodes, "policy", inputs, outputs, tensors)
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8, producer_name="tlq"
    )
    helper.set_model_props(model, {"metadata": json.dumps(policy.metadata)})
    onnx.checker.check_model(model)
    onnx.save(model, os.fspath(path))


# -- command line ----------------------------------------------------------------------------------------------------


def export_run(folder: str | os.PathLike[str], out: str | os.PathLike[str]) -> None:
    """Exports the newest checkpoint of a run folder; the name's ending chooses between .npz and .onnx."""
    from tlq.checkpoint import read_arrays
    from tlq.config import load_config

    folder, out = Path(folder), Path(out)
    if out.suffix not in (".npz", ".onnx"):
        raise ValueError(f"out={out} must end in .npz or .onnx")
    if not (folder / "config.yaml").is_file():
        raise ValueError(f"run={folder} holds no run: there is no {folder / 'config.yaml'}")
    arrays, config = read_arrays(folder / "checkpoints"), load_config(folder / "config.yaml")
    extra = {"env_steps": int(arrays["iteration"]) * config.num_envs * config.ppo.unroll}
    if out.suffix == ".npz":
        write(out, config, arrays, extra)
        return
    with tempfile.TemporaryDirectory() as temporary:
        npz = Path(temporary) / "policy.npz"
        write(npz, config, arrays, extra)
        write_onnx(out, npz)


def convert(policy: str, out: str | os.PathLike[str]) -> None:
    """Converts an exported policy, by its file or name, to ONNX; `out` is written whole or not at all."""
    out = Path(out)
    if out.suffix != ".onnx":
        raise ValueError(f"out={out} must end in .onnx: policy= is an npz file already")
    source = find_policy(policy)
    load_policy(source)  # refuses a bad file before anything is made
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole(out) as temporary:
        write_onnx(temporary, source)


@dataclasses.dataclass(frozen=True)
class Options:
    """What a user may set."""

    run: str = option("", "folder of a run, whose newest checkpoint is exported")
    policy: str = option("", "or an exported policy's file, run folder, or name, to convert to .onnx")
    out: str = option("", "file to write, .npz or .onnx", required=True)


def main(arguments: Sequence[str]) -> None:
    """Command line."""
    options = parse(Options, arguments, __doc__ or "")
    if bool(options.run) == bool(options.policy):
        raise UsageError(
            "give one of run= (a run's folder) and policy= (an exported policy), not both or none"
        )
    if options.run:
        export_run(options.run, options.out)
    else:
        convert(options.policy, options.out)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    run(main)
