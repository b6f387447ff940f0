"""Nonsense on the command line and in files: one line that says what is wrong, never a traceback, nothing lost."""

import dataclasses
import io
import json
import os
import random

import hypothesis
import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import strategies as st

import envs
from envs.limits import LIMITS, leaves
from tests.tlq.policies import trained
from tlq import config as settings
from tlq.cli import UsageError
from tlq.runtime import PolicyFileError, load_policy

MANY = int(os.environ.get("TLQ_EXAMPLES", "10000"))


def thorough(examples=MANY):
    return hypothesis.settings(
        max_examples=examples,
        deadline=None,
        database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )


@pytest.fixture(scope="module", autouse=True)
def registered():
    settings.register()


def is_number(value):
    return isinstance(value, int | float) and not isinstance(value, bool)


def test_every_number_of_an_environment_has_limits_and_keeps_them():
    found = dict(leaves(envs.EnvConfig()))
    numbers = {
        n for n, x in found.items() if is_number(x) or (isinstance(x, tuple) and all(map(is_number, x)))
    }
    assert numbers | {"terrain.stairs.fixed_rise"} == set(LIMITS)
    own = {n: x for n, x in leaves(settings.TrainConfig()) if not n.startswith("env")}
    numbers = {n for n, x in own.items() if is_number(x) or (isinstance(x, tuple) and all(map(is_number, x)))}
    assert numbers == set(settings.LIMITS)


# Command lines ----------------------------------------------------------------------------------------------------

KEYS = [n for n, _ in leaves(settings.default_config())]
CHOICES = [
    "terrain=poles",
    "terrain=mixed",
    "terrain=stair",
    "method=blind",
    "method=",
    "resume=true",
    "init=x",
]
ODD = [
    *(
        "",
        "null",
        "None",
        "nan",
        "-inf",
        "1e999",
        "1e-400",
        "[",
        "[]",
        "[1",
        "[[1]]",
        "{a: 1}",
        "${x}",
        "${env}",
    ),
    *(
        "'",
        '"',
        "true",
        "a,b",
        "1,2",
        "0x10",
        "1_0",
        "٣",
        "a=b",
        "\\",
        "\n",
        "\x00",
        "*",
        "~",
        "+1",
        "--",
        "é",
    ),
]
numbers = st.one_of(
    st.integers(-3, 3),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.floats(0, 2),
    st.sampled_from([0.02, 8, 1024]),
)
values = st.one_of(
    numbers.map(str),
    numbers.map(str),
    st.lists(numbers, max_size=4).map(lambda x: f"[{','.join(map(str, x))}]"),
    st.sampled_from(ODD),
    st.text(max_size=6),
)
keys = st.one_of(
    st.sampled_from(KEYS),
    st.sampled_from(KEYS),
    st.sampled_from(KEYS).map(lambda k: k.rpartition(".")[0] or k),
    st.sampled_from(KEYS).map(lambda k: k[:-1]),
    st.text(max_size=8),
    st.sampled_from(["+new", "~seed", "++seed", "hydra.job.name", "hydra/launcher", "env.terrain", "-m"]),
)
arguments = st.one_of(
    st.tuples(keys, values).map("=".join),
    st.sampled_from(CHOICES),
    st.text(max_size=8).filter(lambda t: "=" not in t),
)


def parse(line):
    cleaned = settings.clean(line)
    return settings.from_hydra(settings._try(cleaned), cleaned)


@pytest.mark.slow
def test_command_lines():
    accepted = []

    @thorough()
    @given(st.lists(arguments, min_size=1, max_size=3))
    def run(line):
        line = [a for a in line if not a.startswith("-")]  # those are Hydra's own
        try:
            config = parse(line)
        except UsageError as error:
            assert str(error).strip()  # printed as one line, whatever is in it (tlq.cli.fail)
        else:
            accepted.append(config)

    run()
    assert len(accepted) > MANY // 100


numeric = {n: x for n, x in LIMITS.items() if n not in ("terrain.num_terrains", "episode_time")}


@pytest.mark.slow
def test_what_is_within_the_limits_runs():
    """Environments with a few random settings: a bank is built, and a step traced."""
    built = []
    lengths = {n: len(x) for n, x in leaves(envs.EnvConfig()) if isinstance(x, tuple)}

    @thorough(25)
    @given(st.integers(0, 2**32 - 1))
    def run(seed):
        rng = random.Random(seed)
        config = envs.EnvConfig()
        small = {
            "terrain.num_terrains": 12,
            "terrain.half_extent": 2.0,
            "terrain.kind": rng.choice(["poles", "mixed"]),
        }
        for name in rng.sample(sorted(numeric), 3):
            low, high = numeric[name]

            def draw(low=low, high=high, whole=isinstance(low, int) and isinstance(high, int)):
                value = rng.choice([low, high, rng.uniform(low, high)])
                return round(value) if whole else value

            small[name] = tuple(sorted(draw() for _ in range(lengths[name]))) if name in lengths else draw()
        for name, value in small.items():
            config = settings.replace(config, name, value)
        try:
            env = envs.make(config)
        except ValueError as error:
            assert "\n" not in str(error)
            return
        state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
        jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((14,), np.float32))
        built.append(small)

    run()
    assert len(built) > 5


# Files -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "policy.npz"
    small = {"policy.encoder": 8, "policy.head": 8, "policy.memory_width": 4, "policy.leg_head": 4}
    return trained(**small).export(path).read_bytes()


def torn(data, rng):
    """Bytes cut off, flipped, overwritten, put in or left out."""
    data, kind = bytearray(data), rng.randrange(6)
    at = rng.randrange(len(data))
    if kind == 0:
        return bytes(data[:at])
    if kind == 1:
        for _ in range(rng.choice([1, 2, 20])):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif kind == 2:
        data[at : at + rng.randrange(1, 64)] = rng.randbytes(rng.randrange(64))
    elif kind == 3:
        del data[at : at + rng.randrange(1, 5000)]
    elif kind == 4:
        return rng.randbytes(rng.randrange(300))
    else:  # the archive's directory, at its end
        at = len(data) - 1 - rng.randrange(min(len(data), 3000))
        data[at] = rng.randrange(256)
    return bytes(data)


JUNK = [
    None,
    True,
    0,
    -1,
    1.5,
    1e300,
    2**80,
    "",
    "x",
    [],
    [[]],
    {},
    {"a": 1},
    [1, 2],
    float("nan"),
    ["heights"],
]


def spoil(tree, rng):
    """A JSON value with one part replaced, removed or doubled."""
    if isinstance(tree, dict | list) and tree and rng.random() < 0.85:
        key = rng.choice(list(tree)) if isinstance(tree, dict) else rng.randrange(len(tree))
        copy = tree.copy()
        how = rng.randrange(8)
        if how == 0:
            del copy[key]
        elif how == 1 and isinstance(tree, list):
            copy.insert(key, tree[key])
        elif how == 2 and isinstance(tree, dict):
            copy[rng.choice(["x", "name", "op"])] = rng.choice(JUNK)
        else:
            copy[key] = spoil(tree[key], rng)
        return copy
    return rng.choice(JUNK)


def foreign(data, rng):
    """A file that is whole, with wrong contents."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {k: file[k] for k in file.files}
    name = rng.choice(["graph", "metadata", "metadata", rng.choice(list(arrays))])
    if name in ("graph", "metadata"):
        arrays[name] = np.array(json.dumps(spoil(json.loads(str(arrays[name])), rng)))
    else:
        x = arrays[name]
        changed = [
            x[:-1] if x.ndim else x,
            x.astype(rng.choice(["f8", "i4", "U3", "c8"])),
            x[None],
            x.T,
            x * np.nan,
        ]
        arrays[name] = rng.choice([*changed, np.float32(1), np.zeros((0, 3), np.float32)])
        if rng.random() < 0.2:
            del arrays[name]
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


@pytest.mark.slow
def test_policy_files(whole, tmp_path):
    path, loaded = tmp_path / "policy.npz", []

    @thorough()
    @given(st.integers(0, 2**64 - 1))
    def run(seed):
        rng = random.Random(seed)
        data = torn(whole, rng) if rng.random() < 0.4 else foreign(whole, rng)
        path.write_bytes(data)
        try:
            loaded.append(load_policy(path))
        except PolicyFileError as error:
            assert "\n" not in str(error) and str(path) in str(error)
        assert path.read_bytes() == data

    run()
    assert len(loaded) > 10  # what doesn't matter may differ


def test_a_policy_file_never_runs_code(tmp_path):
    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    np.savez(tmp_path / "evil.npz", metadata=np.array([Evil()]), graph=np.array("[]"))
    with pytest.raises(PolicyFileError, match="damaged"):
        load_policy(tmp_path / "evil.npz")
    assert not (tmp_path / "ran").exists()


@pytest.mark.slow
def test_configuration_files(tmp_path):
    """config.yaml of a run to be resumed."""
    path = tmp_path / "config.yaml"
    settings.save_config(dataclasses.replace(settings.default_config(), run=str(tmp_path)), path)
    text, kept = path.read_bytes(), []

    @thorough(MANY // 10)
    @given(st.integers(0, 2**64 - 1))
    def run(seed):
        rng = random.Random(seed)
        lines = text.decode().splitlines(keepends=True)
        if rng.random() < 0.5:
            data = torn(text, rng)
        else:
            i = rng.randrange(len(lines))
            key, colon, _ = lines[i].partition(":")
            lines[i] = rng.choice(["", f"{key}{colon} {rng.choice(JUNK)}\n", lines[i] * 2, f"{key}x: 1\n"])
            data = "".join(lines).encode()
        path.write_bytes(data)
        try:
            kept.append(parse([f"run={tmp_path}", "resume=true"]))
        except UsageError as error:
            assert str(error).strip()
        assert path.read_bytes() == data

    run()
    assert kept
