"""Which room may import what, and that the controller on the robot needs NumPy alone."""

import ast
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("terrains", "tg", "rewards", "envs", "tlq")
MAY_IMPORT = {
    "terrains": {"jax", "numpy", "mujoco"},
    "tg": set(),
    "rewards": {"jax"},
    "envs": {"terrains", "tg", "rewards", "mujoco", "brax.envs.base", "jax", "flax", "numpy"},
    "train.py": {"tlq", "hydra", "omegaconf"},
}
"""Besides themselves and the standard library. `tlq` may import everything, but see below."""
ON_THE_ROBOT = (
    "tlq/__init__.py",
    "tlq/runtime.py",
    "tlq/calibration.py",
    "tlq/graph.py",
    "tlq/messages.py",
    "tlq/monitor.py",
    "tlq/supervisor.py",
    "tlq/faults.py",
    "tlq/cli.py",
    "tlq/deploy.py",
    "tlq/judge.py",
    "tlq/elevation.py",
    "tlq/senses.py",
)
"""What a robot needs of `tlq`: NumPy and `tg` alone, as soon as it is imported."""


def files(room):
    path = ROOT / room
    return [path] if path.is_file() else sorted(path.rglob("*.py"))


def imports(path, *, lazy=True):
    """Full names of the modules that a file imports; without `lazy`, only those that importing it imports."""
    tree = ast.parse(path.read_text())
    inside = {
        id(node)
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for node in ast.walk(function)
    }
    for node in ast.walk(tree):
        if not lazy and id(node) in inside:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write the room's name"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def foreign(path, room, allowed, **how):
    """Imports of a file that its room isn't allowed."""
    allowed = {*allowed, room.removesuffix(".py"), *sys.stdlib_module_names}
    return [name for name in imports(path, **how) if not any(f"{name}.".startswith(f"{a}.") for a in allowed)]


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_rooms_import_only_what_they_may(room):
    found = {str(path.relative_to(ROOT)): foreign(path, room, MAY_IMPORT[room]) for path in files(room)}
    assert len(found) > 0 and {path: names for path, names in found.items() if names} == {}


def test_only_envs_and_tlq_use_mjx():
    users = {room for room in ROOMS for path in files(room) for name in imports(path) if "mjx" in name}
    assert users <= {"envs", "tlq"}


@pytest.mark.parametrize("file", ON_THE_ROBOT)
def test_the_runtime_imports_numpy_and_tg(file):
    allowed = {"numpy", "tg", *(f"tlq.{Path(own).stem}" for own in ON_THE_ROBOT[1:])}
    assert foreign(ROOT / file, "tg", allowed, lazy=False) == []


def test_the_runtime_can_be_imported_where_there_is_numpy_alone():
    program = """
        import sys
        banned = {"jax", "jaxlib", "mujoco", "brax", "flax", "optax", "orbax", "hydra", "omegaconf", "matplotlib",
                  "tensorboardX", "av", "onnx", "scipy"}
        class Ban:
            def find_spec(self, name, path=None, target=None):
                if name.partition(".")[0] in banned:
                    raise ImportError(f"{name} isn't on the robot")
        sys.meta_path.insert(0, Ban())
        from tlq import deploy, elevation
        from tlq.runtime import Controller
        assert not banned & set(sys.modules)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_the_entry_stays_short():
    assert len((ROOT / "train.py").read_text().splitlines()) < 50


def test_no_two_rooms_import_each_other():
    """The order of the rooms is the flow of the data: none imports one that comes later."""
    order = {"terrains": 0, "tg": 0, "rewards": 0, "envs": 1, "tlq": 2}
    for room in ROOMS:
        for path in files(room):
            used = {name.partition(".")[0] for name in imports(path)} & set(order) - {room}
            assert all(order[other] < order[room] for other in used), path
