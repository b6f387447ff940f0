"""Checkpoints: what was saved comes back, what was damaged is passed over."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tlq.checkpoint import Checkpoints, names, read_arrays


def state(x=1.0):
    return {
        "params": {"kernel": jnp.arange(6.0).reshape(2, 3) * x, "empty": jnp.zeros((4, 0))},
        "key": jax.random.PRNGKey(3),
        "typed": jax.random.key(7),
        "count": (jnp.int32(5), np.uint32(2**32 - 1)),
        "done": jnp.array([True, False]),
    }


def same(a, b):
    def check(x, y):
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)

    jax.tree.map(check, a, b)


@pytest.fixture
def saved(tmp_path):
    """Three checkpoints, 1 to 3, in a folder."""
    checkpoints = Checkpoints(tmp_path, keep=3)
    for step in (1, 2, 3):
        checkpoints.save(step, state(step), {"env_steps": 10 * step})
    checkpoints.close()
    return tmp_path


def test_round_trip(saved):
    restored, about = Checkpoints(saved).restore(state(0.0))
    same(restored, state(3))
    assert about["env_steps"] == 30


def test_only_the_newest_are_kept(tmp_path):
    checkpoints = Checkpoints(tmp_path, keep=2)
    for step in range(4):
        checkpoints.save(step, state(step), {})
    assert checkpoints.steps() == [2, 3]
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_dir()) == ["2", "3"]


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)


@pytest.mark.parametrize(
    "damage", [cut, flip, lambda path: path.unlink()], ids=["cut", "flipped bit", "missing"]
)
@pytest.mark.parametrize("which", ["state/**/d/*", "about/metadata"])
def test_a_damaged_newest_is_named_and_passed_over(saved, damage, which, capsys):
    for path in (saved / "3").glob(which):
        damage(path)
    checkpoints = Checkpoints(saved)
    restored, _ = checkpoints.restore(state(0.0))
    same(restored, state(2))
    assert f"{saved / '3'} is damaged; skipped" in capsys.readouterr().out
    checkpoints.save(3, state(9), {})  # its number is free again
    same(checkpoints.restore(state(0.0))[0], state(9))


def test_nothing_readable_is_one_clear_error(saved):
    for path in saved.glob("*/state/**/d/*"):
        cut(path)
    with pytest.raises(ValueError, match=f"no readable checkpoint in {saved}"):
        Checkpoints(saved).restore(state())


def test_other_settings_are_not_taken_for_damage(saved):
    other = state() | {"params": {"kernel": jnp.zeros((2, 4)), "empty": jnp.zeros((4, 0))}}
    with pytest.raises(
        ValueError, match=r"other settings: params.kernel is \(\(2, 3\), 'float32'\) there and \(\(2, 4\)"
    ):
        Checkpoints(saved).restore(other)
    assert Checkpoints(saved).steps() == [1, 2, 3]


def test_arrays_can_be_read_by_name_without_knowing_the_layout(saved):
    arrays = read_arrays(saved)
    np.testing.assert_array_equal(arrays["params.kernel"], 3 * np.arange(6.0).reshape(2, 3))
    assert set(arrays) == set(names(state())) - {"params.empty"}
