"""The runtime: the trained controller to 1e-5, without JAX, fast, and firm about files and inputs that aren't right."""

import io
import json
import subprocess
import sys
import time
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tg
from tests.tlq.policies import put, trained
from tlq.config import training_env
from tlq.runtime import Controller, PolicyFileError, load_policy

ABSENT = {"jax", "jaxlib", "flax", "brax", "mujoco", "hydra", "envs", "terrains", "rewards", "onnx"}
FORWARD = np.array([1.0, 0.0])


@pytest.fixture(scope="module")
def made():
    return trained()


@pytest.fixture(scope="module")
def file(made, tmp_path_factory):
    return made.export(tmp_path_factory.mktemp("runtime") / "policy.npz")


def walk(controller, rng, steps):
    """Sensors, heights and commands of something that moves: what a recording would hold."""
    pose = np.array(controller.core.default_pose, float)
    t = 0.02 * np.arange(steps)[:, None]
    joints = pose + 0.2 * np.sin(8.0 * t + rng.uniform(-3, 3, 12))
    tilt = 0.05 * np.sin(5.0 * t + rng.uniform(-3, 3, 2))
    for i in range(steps):
        orientation = np.array([1.0, *tilt[i], 0.4])
        sensors = {
            "orientation": orientation / np.linalg.norm(orientation),
            "angular_velocity": rng.normal(0, 0.3, 3),
            "joint_position": joints[i],
            "joint_velocity": rng.normal(0, 1.0, 12),
        }
        angle = 0.5 * np.pi * np.floor(i / 150)  # turns to every side
        command = np.array([np.cos(angle), np.sin(angle)]) if i % 300 > 20 else np.zeros(2)
        yield sensors, -0.3 + 0.05 * rng.normal(size=(4, 25)), command


class InJax:
    """The same controller as in training: `tg` and the trained networks under JAX."""

    def __init__(self, made, core):
        self.made, self.core = made, core
        self.observe, self.act = jax.jit(core.observe), jax.jit(core.act)
        self.state, self.memory = core.initial_state(jnp.float32(0.5 * np.pi)), np.zeros(128, np.float32)

    def step(self, sensors, heights, command):
        measured = tg.Sensors(**{k: jnp.asarray(v, jnp.float32) for k, v in sensors.items()})
        heights, command = jnp.asarray(heights, jnp.float32), jnp.asarray(command, jnp.float32)
        observation = self.observe(self.state, measured, heights, command)
        self.action, self.memory = self.made.step(observation, self.memory)
        self.state, desired = self.act(self.state, jnp.asarray(self.action), measured, command)
        return np.asarray(desired)


def test_a_step_is_the_trained_one(file, made):
    controller = Controller(file)
    truth = InJax(made, controller.core)
    for inputs in walk(controller, np.random.default_rng(0), 100):
        truth.state, truth.memory = tg.ControllerState(*map(jnp.asarray, controller.state)), controller.memory
        wanted = truth.step(*inputs)
        got = controller.step(*inputs)
        np.testing.assert_allclose(controller.action, truth.action, atol=1e-5)
        np.testing.assert_allclose(controller.memory, truth.memory, atol=1e-5)
        np.testing.assert_allclose(got, wanted, atol=1e-5)


def test_a_thousand_steps_stay_together(file, made):
    controller = Controller(file)
    truth = InJax(made, controller.core)
    worst = 0.0
    for inputs in walk(controller, np.random.default_rng(1), 1000):
        worst = max(worst, np.max(np.abs(controller.step(*inputs) - truth.step(*inputs))))
    assert worst < 1e-3


def test_reset_starts_anew(file):
    controller = Controller(file)
    runs = []
    for _ in range(2):
        controller.reset()
        runs.append([controller.step(*inputs) for inputs in walk(controller, np.random.default_rng(2), 20)])
    np.testing.assert_array_equal(*runs)


def test_example_sensors_stand(file):
    controller = Controller(file)
    sensors = controller.example_sensors()
    points = controller.sample_points(sensors)
    assert points.shape == (4, 25, 2)
    feet = controller.core.geometry.hip_position + controller.core.base_foot
    np.testing.assert_allclose(points[:, 0], feet[:, :2], atol=1e-5)
    q_des = controller.step(sensors, np.full((4, 25), -0.3), np.zeros(2))
    assert q_des.shape == (12,) and np.all(np.abs(q_des - controller.core.standing_target) < 0.31)


def test_policies_from_before_look_ahead_sample_round_their_feet(file, tmp_path):
    with np.load(file) as old:
        arrays = {name: old[name] for name in old.files}
    metadata = json.loads(str(arrays["metadata"]))
    assert metadata["tg"].pop("look_ahead") and Controller(file).core.config.look_ahead
    metadata["training"]["env"]["tg"].pop("look_ahead")
    np.savez(tmp_path / "old.npz", **arrays | {"metadata": json.dumps(metadata)})
    assert not Controller(tmp_path / "old.npz").core.config.look_ahead
    assert not training_env(metadata).tg.look_ahead


def test_blind_policies_need_no_heights(tmp_path):
    controller = Controller(trained("blind").export(tmp_path / "policy.npz"))
    assert controller.step(controller.example_sensors(), None, FORWARD).shape == (12,)


def test_needs_neither_jax_nor_mujoco(file):
    code = (
        "import sys; from tlq.runtime import Controller; import numpy as np\n"
        f"c = Controller({str(file)!r})\n"
        "c.step(c.example_sensors(), np.full((4, 25), -0.3), [1.0, 0.0])\n"
        "roots = {m.partition('.')[0] for m in sys.modules}\n"
        f"print(sorted(roots & {ABSENT}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_step_costs_some_thousand_small_additions(file):
    """A ratio of two things run in turn, as machines differ and are busy: the bound is twice what was measured."""
    controller = Controller(file)
    inputs = next(walk(controller, np.random.default_rng(3), 1))
    numbers = np.ones(64, np.float32)
    ratios = []
    for _ in range(20):
        start = time.process_time()
        for _ in range(5000):
            numbers + numbers
        middle = time.process_time()
        for _ in range(20):
            controller.step(*inputs)
        ratios.append((time.process_time() - middle) / 20 / ((middle - start) / 5000))
    assert np.median(ratios) < 3500


# -- inputs ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("joint_position", put(np.nan, 3), r"sensors\['joint_position'\] holds values that are not finite"),
        (
            "joint_position",
            lambda x: x[:11],
            r"sensors\['joint_position'\] has shape \(11,\); expected \(12,\)",
        ),
        ("angular_velocity", put(np.inf, 0), "not finite"),
        ("orientation", lambda x: 0 * x, "length 0; expected a unit quaternion"),
        ("orientation", lambda x: "up", r"must be an array of \(4,\) numbers"),
        ("heights", put(np.nan, (2, 7)), "heights holds values that are not finite"),
        ("heights", lambda x: x.T, r"heights has shape \(25, 4\); expected \(4, 25\)"),
        ("heights", lambda x: None, "heights is None; this policy needs"),
        ("command", lambda x: 2 * x, "command has length 2; give a unit vector, or 0, 0 to stand"),
        ("command", lambda x: [1, 0, 0], r"command has shape \(3,\)"),
    ],
)
def test_wrong_inputs_are_refused_and_change_nothing(file, name, change, message):
    controller = Controller(file)
    inputs = {**controller.example_sensors(), "heights": np.full((4, 25), -0.3), "command": FORWARD}
    before = controller.state

    def step(values):
        sensors = {k: v for k, v in values.items() if k not in ("heights", "command")}
        return controller.step(sensors, values["heights"], values["command"])

    with pytest.raises(ValueError, match=message):
        step(inputs | {name: change(inputs[name])})
    assert controller.state is before and not controller.memory.any()
    step(inputs)


def test_missing_sensors_are_named(file):
    controller = Controller(file)
    with pytest.raises(
        ValueError, match="dict of orientation, angular_velocity, joint_position, joint_velocity"
    ):
        controller.sample_points({"orientation": np.array([1.0, 0, 0, 0])})


# -- files -----------------------------------------------------------------------------------------------------------


def altered(file, path, **changes):
    """The file with some arrays changed by functions; None: left out."""
    with np.load(file) as arrays:
        found = {name: arrays[name] for name in arrays.files}
    for name, change in changes.items():
        found[name] = change(found.get(name))
    np.savez(path, **{name: array for name, array in found.items() if array is not None})
    return path


def metadata(**changes):
    """A change of metadata; a key a__b stands for ["a"]["b"]."""

    def change(array):
        about = json.loads(str(array))
        for key, value in changes.items():
            *parents, last = key.split("__")
            place = about
            for parent in parents:
                place = place[parent]
            place[last] = value
        return np.array(json.dumps(about))

    return change


def graph(number, **changes):
    def change(array):
        nodes = json.loads(str(array))
        nodes[number] |= changes
        return np.array(json.dumps(nodes))

    return change


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"metadata": metadata(version=2)}, "format version 2; this program reads version 1"),
        ({"metadata": metadata(format="other")}, "not a policy file of this program"),
        ({"metadata": lambda x: None}, "not a policy file: it has no graph and metadata"),
        ({"metadata": lambda x: np.array("{")}, "damaged: its metadata isn't JSON"),
        ({"graph": lambda x: np.array("{}")}, "damaged: its graph is of the wrong type"),
        ({"metadata": metadata(default_pose=[0.0] * 11)}, r"default_pose must be \(12,\) finite numbers"),
        ({"metadata": metadata(kp=0.0)}, "kp must be above 0"),
        ({"metadata": metadata(kp=float("nan"))}, r"kp must be \(\) finite numbers"),
        ({"metadata": metadata(tg__lift="high")}, "metadata: something is missing or wrong"),
        ({"metadata": metadata(tg__gait="pace")}, "metadata: tg.gait must be one of trot, walk"),
        ({"metadata": metadata(tg__swing_share=0.6)}, "metadata: tg.swing_share is out of range"),
        ({"metadata": metadata(tg__wings=2)}, "metadata: something is missing or wrong .*wings"),
        ({"metadata": metadata(memory__size=3)}, "its graph doesn't fit its arrays"),
        ({"metadata": metadata(memory__size=-1)}, "memory.size"),
        ({"metadata": metadata(observation=[{"name": "heights", "size": 100}])}, "another layout"),
        ({"graph": graph(3, op="Loop")}, "its graph can't be run: node 3: unknown operator 'Loop'"),
        ({"normaliser.std.state": lambda x: x[:-1]}, "its graph doesn't fit its arrays"),
        ({"normaliser.std.state": lambda x: x.astype(float)}, "of type float64, not float32"),
        ({"normaliser.std.state": put(np.nan, 0)}, "of type float64|not finite"),
        (
            {"params.policy.params.action.bias": lambda x: x + np.float32(np.inf)},
            "holds values that are not finite",
        ),
        ({"params.policy.params.action.kernel": lambda x: np.array([object()])}, "damaged .*pickle"),
    ],
)
def test_files_that_are_not_right_are_refused(file, tmp_path, changes, message):
    path = altered(file, tmp_path / "policy.npz", **changes)
    with pytest.raises(PolicyFileError, match=message) as error:
        load_policy(path)
    assert (
        isinstance(error.value, ValueError) and str(path) in str(error.value) and "\n" not in str(error.value)
    )


def test_cut_and_flipped_files_are_refused(file, tmp_path):
    whole, path = file.read_bytes(), tmp_path / "policy.npz"
    rng = np.random.default_rng(4)
    for size in [0, 1, 100, len(whole) // 2, len(whole) - 1]:
        path.write_bytes(whole[:size])
        with pytest.raises(PolicyFileError):
            load_policy(path)
    with zipfile.ZipFile(file) as archive:
        spans = [(e.header_offset + 30 + len(e.filename), e.file_size) for e in archive.infolist()]
    for start, size in [spans[i] for i in rng.integers(0, len(spans), 10)]:
        flipped = bytearray(whole)
        flipped[start + int(rng.integers(30, size))] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        with pytest.raises(PolicyFileError, match="damaged"):
            load_policy(path)


def test_other_files_are_refused(tmp_path):
    text, array = tmp_path / "a.npz", tmp_path / "b.npz"
    text.write_text("import os")
    np.save(buffer := io.BytesIO(), np.zeros(3))
    array.write_bytes(buffer.getvalue())
    for path in (text, array):
        with pytest.raises(PolicyFileError, match="damaged, or not a policy file"):
            load_policy(path)
    for path in (tmp_path / "missing.npz", tmp_path):
        with pytest.raises(PolicyFileError, match="no policy file at"):
            load_policy(path)
