"""Checkpoints by Orbax: the whole training state, so that a resumed run goes on bit for bit.

Orbax writes a checkpoint beside its place and renames it, so that one is whole or absent. A digest of every array
finds what went wrong on disk later.
"""

import hashlib
import json
import logging
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from jax.experimental import multihost_utils

# What Orbax logs of a failed save comes as an exception, too, and is answered in one line.
logging.getLogger("absl").setLevel(logging.CRITICAL)


class Checkpoints:
    """The newest checkpoints of a run folder; all but `keep` are removed."""

    def __init__(self, folder: Path, keep: int = 3):
        self.folder = Path(folder).absolute()
        options = ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=False)
        self._manager = ocp.CheckpointManager(self.folder, options=options)

    def save(self, step: int, state: Any, extra: dict[str, Any]) -> None:
        """Saves `state` (a pytree of arrays) and `extra` (JSON) under the number `step`."""
        leaves = _leaves(state)
        about = dict(extra, layout=_layout(leaves), digest=_digest(leaves))
        about["checksum"] = _checksum(about)
        args = ocp.args.Composite(state=ocp.args.StandardSave(leaves), about=ocp.args.JsonSave(about))
        self._manager.save(step, args=args, force=True)
        self._manager.wait_until_finished()

    def steps(self) -> list[int]:
        """Numbers of the checkpoints on disk, oldest first."""
        return sorted(self._manager.all_steps(read=True))

    def restore(self, like: Any) -> tuple[Any, dict[str, Any]]:
        """Newest readable checkpoint as (state placed like `like`, extra); damaged ones are named and skipped.

        like: pytree of arrays with the shapes, types and shardings that the state has.
        """
        target = _leaves(like)
        for step in reversed(self.steps()):
            about = self._about(step)
            if about is not None:
                if about["layout"] != _layout(target):
                    raise ValueError(_difference(self.folder / str(step), about["layout"], _layout(target)))
                leaves = self._read(step, jax.tree.map(_abstract, target))
                if leaves is not None and _same(about["digest"], _digest(leaves)):
                    return _unflatten(like, leaves), about
            aside = self.folder / f"damaged-{step}"
            if jax.process_index() == 0:
                print(
                    f"checkpoint {self.folder / str(step)} is damaged; skipped, and renamed to {aside.name}",
                    flush=True,
                )
                (self.folder / str(step)).rename(aside)
            if jax.process_count() > 1:
                multihost_utils.sync_global_devices(f"renamed {step}")
            self._manager.reload()
        raise ValueError(f"no readable checkpoint in {self.folder}")

    def _about(self, step: int) -> dict[str, Any] | None:
        try:
            about = self._manager.restore(step, args=ocp.args.Composite(about=ocp.args.JsonRestore()))[
                "about"
            ]
            checksum = about.pop("checksum", "")
            return about if checksum in ("", _checksum(about)) else None
        except Exception:  # whatever a damaged file leads a reader to raise
            return None

    def _read(self, step: int, target: dict[str, Any]) -> dict[str, Any] | None:
        try:
            return self._manager.restore(
                step, args=ocp.args.Composite(state=ocp.args.StandardRestore(target))
            )["state"]
        except Exception:
            return None

    def close(self) -> None:
        """Frees what Orbax holds."""
        self._manager.close()


def read_arrays(folder: Path) -> dict[str, np.ndarray]:
    """All arrays of the newest checkpoint in `folder`, by the name of their place, e.g. 'normaliser.mean.state'."""
    checkpoints = Checkpoints(folder)
    for step in reversed(checkpoints.steps()):
        about = checkpoints._about(step)
        if about is None:
            continue
        target = {n: jax.ShapeDtypeStruct(shape, dtype) for n, shape, dtype in about["layout"]}
        target = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), target)
        leaves = checkpoints._read(step, target)
        if leaves is not None:
            return jax.tree.map(np.asarray, leaves)
    raise ValueError(f"no readable checkpoint in {folder}")


def _plain(x: Any) -> Any:
    """Typed random keys as the integers they hold."""
    return jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x


def names(tree: Any) -> list[str]:
    """Name of each leaf of a pytree, e.g. 'params.policy.params.proprio.kernel'."""
    return [
        jax.tree_util.keystr(p, simple=True, separator=".")
        for p, _ in jax.tree_util.tree_leaves_with_path(tree)
    ]


def _leaves(tree: Any) -> dict[str, Any]:
    """Arrays by name; empty ones are left out, as the file format has no place for them."""
    found = dict(zip(names(tree), jax.tree.leaves(tree), strict=True))
    return {name: _plain(jax.numpy.asarray(x)) for name, x in found.items() if np.size(x)}


def _unflatten(like: Any, leaves: dict[str, Any]) -> Any:
    def place(name: str, x: Any) -> Any:
        if name not in leaves:
            return x
        typed = jax.dtypes.issubdtype(jax.numpy.asarray(x).dtype, jax.dtypes.prng_key)
        return jax.random.wrap_key_data(leaves[name]) if typed else leaves[name]

    filled = [place(n, x) for n, x in zip(names(like), jax.tree.leaves(like), strict=True)]
    return jax.tree.unflatten(jax.tree.structure(like), filled)


def _abstract(x: jax.Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding)


def _layout(leaves: dict[str, Any]) -> list[list[Any]]:
    return [[name, list(x.shape), str(x.dtype)] for name, x in sorted(leaves.items())]


def _digest(leaves: dict[str, Any]) -> str:
    """SHA-256 of all arrays; '' where other hosts hold a part of them."""
    digest = hashlib.sha256()
    for name, x in sorted(leaves.items()):
        if not getattr(x, "is_fully_addressable", True):
            return ""
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(x).tobytes())
    return digest.hexdigest()


def _same(saved: str, found: str) -> bool:
    return saved == found or "" in (saved, found)


def _checksum(about: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()


def _difference(path: Path, saved: list[list[Any]], wanted: list[list[Any]]) -> str:
    have, want = ({name: (tuple(shape), dtype) for name, shape, dtype in x} for x in (saved, wanted))
    name = next(n for n in sorted(have | want) if have.get(n) != want.get(n))
    return f"{path} was made with other settings: {name} is {have.get(name)} there and {want.get(name)} here"
