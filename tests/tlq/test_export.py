"""The file: what is in it, that it is written whole, and that its graph is the trained network, also as ONNX."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import terrains
import tlq.export
from envs.robot import RobotConfig, make_robot
from tests.tlq.policies import trained
from tlq.cli import UsageError, find_policy
from tlq.config import training_env
from tlq.graph import OPERATORS, Graph, GraphError
from tlq.runtime import Controller, load_policy
from tlq.simulation import Simulation
from tlq.training import initialise


@pytest.fixture(scope="module")
def made():
    return trained()


@pytest.fixture(scope="module")
def file(made, tmp_path_factory):
    return made.export(tmp_path_factory.mktemp("export") / "policy.npz", {"env_steps": 7})


def read(path):
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def test_file_says_what_a_robot_needs(file, made):
    about, robot = json.loads(str(read(file)["metadata"])), make_robot(RobotConfig())
    assert (about["format"], about["version"], about["robot"]) == ("tlq-policy", 1, "max")
    assert about["joint_names"] == list(robot.joint_names)
    np.testing.assert_allclose(about["default_pose"], robot.default_pose, atol=1e-6)
    np.testing.assert_allclose(about["torque_limit"], robot.torque_limit)
    assert (about["kp"], about["kd"]) == (made.config.env.robot.kp, made.config.env.robot.kd)
    assert (about["control_dt"], about["terrain"], about["method"]) == (0.02, "poles", "ours")
    assert about["memory"] == {"kind": "mingru", "size": 128}
    assert about["training"]["env"]["tg"] == about["tg"]
    assert about["env_steps"] == 7 and isinstance(about["commit"], str)
    for parts in (about["observation"], about["action"]):
        ends = [part["offset"] + part["size"] for part in parts]
        assert [part["offset"] for part in parts] == [0, *ends[:-1]]
    assert ends[-1] == 14


def test_arrays_are_float32_and_all_used(file):
    arrays = read(file)
    nodes = json.loads(str(arrays.pop("graph")))
    del arrays["metadata"]
    assert all(array.dtype == np.float32 for array in arrays.values())
    assert {name for node in nodes for name in node["inputs"]} >= set(arrays)
    assert {node["op"] for node in nodes} <= set(OPERATORS)


@pytest.mark.parametrize("memory", ["mingru", "gru", "none"])
@pytest.mark.parametrize("method", ["ours", "blind"])
def test_graph_is_the_trained_network(method, memory, tmp_path):
    made = trained(method, memory, **{"policy.memory_layers": 1 if method == "blind" else 2})
    policy = load_policy(made.export(tmp_path / "policy.npz"))
    rng, after = np.random.default_rng(1), np.zeros(policy.memory_size, np.float32)
    for _ in range(30):
        observation, before = rng.normal(0, 2, policy.core.observation_size).astype(np.float32), after
        action, after = policy.graph(observation, before)
        wanted, memory_wanted = made.step(observation, before)
        np.testing.assert_allclose(action, wanted, atol=1e-5)
        np.testing.assert_allclose(after, memory_wanted, atol=1e-5)
        assert action.dtype == after.dtype == np.float32


def test_graph_runs_under_jax_in_batches(file):
    policy = load_policy(file)
    rng = np.random.default_rng(2)
    observation = rng.normal(size=(3, policy.core.observation_size)).astype(np.float32)
    memory = rng.uniform(-1, 1, (3, policy.memory_size)).astype(np.float32)
    got = jax.jit(jax.vmap(policy.graph))(jnp.asarray(observation), jnp.asarray(memory))
    wanted = [policy.graph(*row) for row in zip(observation, memory, strict=True)]
    for part, array in enumerate(got):
        np.testing.assert_allclose(array, [row[part] for row in wanted], atol=1e-5)


@pytest.mark.parametrize("memory", ["mingru", "gru", "none"])
def test_onnx_gives_the_same(memory, tmp_path):
    pytest.importorskip("onnx")
    onnxruntime = pytest.importorskip("onnxruntime")
    npz = trained(memory=memory).export(tmp_path / "policy.npz")
    tlq.export.write_onnx(tmp_path / "policy.onnx", npz)
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    policy, rng = load_policy(npz), np.random.default_rng(3)
    inputs = {
        "observation": rng.normal(size=policy.core.observation_size).astype(np.float32),
        "memory": rng.uniform(-1, 1, policy.memory_size).astype(np.float32),
    }
    for got, wanted in zip(
        session.run(["action", "memory_out"], inputs), policy.graph(**inputs), strict=True
    ):
        np.testing.assert_allclose(got, wanted, atol=1e-5)
    assert json.loads(session.get_modelmeta().custom_metadata_map["metadata"]) == policy.metadata


@pytest.mark.parametrize(("method", "memory"), [("ours", "mingru"), ("ours", "gru"), ("blind", "mingru")])
def test_onnx_stays_with_the_runtime_for_a_thousand_steps(method, memory, tmp_path):
    """Each carries its own memory along, so that differences could add up."""
    onnxruntime = pytest.importorskip("onnxruntime")
    npz = trained(method, memory).export(tmp_path / "policy.npz")
    tlq.export.main([f"policy={npz}", f"out={tmp_path / 'policy.onnx'}"])
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    policy, rng = load_policy(npz), np.random.default_rng(5)
    memories = [np.zeros(policy.memory_size, np.float32)] * 2
    observation = np.zeros(policy.core.observation_size, np.float32)
    for _ in range(1000):
        observation = (0.9 * observation + 0.4 * rng.normal(size=observation.size)).astype(np.float32)
        got = session.run(["action", "memory_out"], {"observation": observation, "memory": memories[0]})
        wanted = policy.graph(observation, memories[1])
        for one, other in zip(got, wanted, strict=True):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-5)
        memories = [got[1], wanted[1]]
    assert np.abs(memories[0]).max() > 0.01  # the memory was in use


def test_onnx_stays_with_a_shipped_policy_that_walks_over_poles(tmp_path):
    """A thousand steps, anew after each fall and short of the terrain's rim.

    Trained weights are larger than those of a fresh network.
    """
    onnxruntime = pytest.importorskip("onnxruntime")
    tlq.export.main(["policy=poles", f"out={tmp_path / 'policy.onnx'}"])
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    controller = Controller(find_policy("poles"))
    poles = terrains.make_terrain("poles", 0.5, seed=10_000)
    sim = Simulation(controller, poles, training_env(controller.metadata))
    memory = controller.memory
    for _ in range(1000):
        if sim.fell() or np.abs(sim.data.qpos[:2]).max() > 4.5:
            sim.reset()
            memory = controller.memory
        sim.step(np.array([1.0, 0.0]))
        action, memory = session.run(
            ["action", "memory_out"], {"observation": np.float32(controller.observation), "memory": memory}
        )
        np.testing.assert_allclose(action, controller.action, rtol=0, atol=1e-5)
        np.testing.assert_allclose(memory, controller.memory, rtol=0, atol=1e-5)


def test_training_starts_from_a_file(file, made, capsys):
    import flax

    @flax.struct.dataclass
    class Start:
        params: object
        average: object
        normaliser: object
        learning_rate: object

    @flax.struct.dataclass
    class Params:
        policy: object

    zeros = jax.tree.map(jnp.zeros_like, (made.params, made.normaliser))
    state = initialise(Start(Params(zeros[0]), zeros[0], zeros[1], jnp.float32(0.0)), str(file))
    for learnt in (state.params.policy, state.average):
        jax.tree.map(np.testing.assert_array_equal, learnt, made.params)
    np.testing.assert_array_equal(state.normaliser.std["state"], made.normaliser.std["state"])


def test_a_failed_write_leaves_the_old_file(file, made, tmp_path, monkeypatch):
    path = tmp_path / "policy.npz"
    path.write_bytes(b"old")

    def fail(*_, **__):
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez", fail)
    with pytest.raises(OSError, match="no space"):
        made.export(path)
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["policy.npz"]


def test_a_network_of_another_environment_is_refused(made, tmp_path):
    other = {"mean": {"state": jnp.zeros(9)}, "std": {"state": jnp.ones(9)}}
    with pytest.raises(ValueError, match="for 9 observed values, the environment shows"):
        tlq.export.export_policy(tmp_path / "policy.npz", made.config, made.params, other)
    assert not os.listdir(tmp_path)


def test_footholds_of_an_older_version_are_refused(made, tmp_path):
    parts = made.params["params"]
    older = {name: x for name, x in parts["footholds"].items() if name != "share"}
    params = {"params": dict(parts, footholds=older)}
    with pytest.raises(ValueError, match="footholds is of an older version"):
        tlq.export.export_policy(tmp_path / "policy.npz", made.config, params, made.normaliser)
    assert not os.listdir(tmp_path)


NODE = {"op": "Tanh", "inputs": ["observation"], "outputs": ["action"], "attributes": {}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"op": "Conv"}, "unknown operator 'Conv'; choose one of Add, "),
        ({"inputs": ["nothing"]}, "reads 'nothing', which nothing before it gives"),
        ({"inputs": ["observation", "memory"]}, "Tanh has 2 inputs"),
        ({"outputs": ["memory"]}, "gives 'memory', which exists already"),
        ({"outputs": ["x"]}, "no node gives 'action'"),
        ({"attributes": {"alpha": 1}}, "unknown attribute 'alpha'"),
        ({"op": "Concat", "attributes": {"axis": 0}}, "axis 0 isn't supported"),
        ({"op": "Slice", "attributes": {"axes": [-1]}}, "malformed"),
    ],
)
def test_graphs_that_make_no_sense_are_refused(change, message):
    with pytest.raises(GraphError, match=message):
        Graph([NODE | change, NODE | {"outputs": ["memory_out"]}], {})


def test_command_line(tmp_path):
    with pytest.raises(UsageError, match="unknown setting 'rum' .did you mean run.*; choose one of run, pol"):
        tlq.export.main(["rum=x"])
    with pytest.raises(UsageError, match="out= is missing"):
        tlq.export.main(["run=x"])
    with pytest.raises(ValueError, match="must end in .npz or .onnx"):
        tlq.export.main(["run=x", "out=y"])
    for arguments in (["out=y.onnx"], ["run=x", "policy=x", "out=y.onnx"]):
        with pytest.raises(UsageError, match="give one of run= .* and policy= "):
            tlq.export.main(arguments)
    with pytest.raises(ValueError, match="out=y.npz must end in .onnx: policy= is an npz file already"):
        tlq.export.main(["policy=x", "out=y.npz"])
    with pytest.raises(UsageError, match="policy=nobody: no such policy"):
        tlq.export.main(["policy=nobody", "out=y.onnx"])
    command = [sys.executable, "-m", "tlq.export", f"run={tmp_path}", "out=y.npz"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stderr.splitlines() == [
        f"error: run={tmp_path} holds no run: there is no {tmp_path / 'config.yaml'}"
    ]
