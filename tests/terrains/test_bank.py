"""Banks: instances in order, equal to single terrains, and their size."""

import jax
import numpy as np
import pytest
from omegaconf import OmegaConf

import terrains


def test_instances_are_the_single_terrains_in_order_of_difficulty():
    bank = terrains.make_bank("mixed", 9, seed=3, difficulties=[0.2, "paper", 1.0, 0.0])
    np.testing.assert_allclose(bank.difficulty, [0.2, 0.8, 1.0, 0.0, 0.2, 0.8, 1.0, 0.0, 0.2])
    assert len(set(bank.kind_id.tolist())) > 1
    for k in range(9):
        terrain = terrains.make_terrain("mixed", float(bank.difficulty[k]), 3, index=k)
        assert bank.kinds[bank.kind_id[k]] == terrain.kind
        assert float(bank.floor[k]) == terrain.floor
        np.testing.assert_array_equal(bank.heights[k], terrains.rasterise(terrain))
        rows = np.asarray(bank.primitives[k, 1 : 1 + len(terrain.primitives)]) * 0.00025
        np.testing.assert_allclose(rows, terrain.primitives, atol=1e-6)


def test_levels_default_to_the_configuration():
    bank = terrains.make_bank("flat", 5, 0, config=terrains.TerrainConfig(levels=3))
    np.testing.assert_allclose(bank.difficulty, [0.0, 0.5, 1.0, 0.0, 0.5])
    assert bank.num_terrains == 5


def test_same_seed_same_bank_and_another_seed_another():
    a, b, c = (terrains.make_bank("stepping_stones", 4, seed) for seed in (0, 0, 1))
    same = jax.tree.map(lambda x, y: bool((x == y).all()), a, b)
    assert all(jax.tree.leaves(same))
    assert not (a.heights[3] == c.heights[3]).all()


@pytest.mark.parametrize(
    "kind, bound", [("flat", 0.66e6), ("poles", 0.80e6), ("stairs", 0.74e6), ("blocks", 0.76e6)]
)
def test_bytes_a_terrain(kind, bound):
    bank = terrains.make_bank(kind, 11, 0)
    most = bank.primitives.shape[1]
    # heights 560 x 560 x 2, table 112 x 112 x M x 2, primitives N x 6 x 2, and three scalars of 4 bytes
    assert bank.nbytes == 11 * (627200 + 25088 * bank.table.shape[-1] + 12 * most + 12)
    assert bank.nbytes / 11 < bound


def test_a_bank_is_a_pytree_that_jit_takes():
    bank = terrains.make_bank("gaps", 2, 0)
    leaves, structure = jax.tree.flatten(bank)
    assert len(leaves) == 6
    again = jax.tree.unflatten(structure, leaves)
    assert again.cell == 0.02 and again.kinds == terrains.kinds()
    assert float(jax.jit(lambda b: b.floor[0])(bank)) == -0.5


def test_errors_name_the_choices():
    with pytest.raises(ValueError, match=r"choose one of flat"):
        terrains.make_bank("stones", 2, 0)
    with pytest.raises(ValueError, match=r"at least one"):
        terrains.make_bank("flat", 0, 0)
    with pytest.raises(ValueError, match=r"at most 32766"):
        thin = terrains.PolesConfig((0.02,) * 3, (0.02,) * 3, (0.02,) * 3, (0.03,) * 3, sweeps=0)
        terrains.make_bank("poles", 1, 0, [1.0], terrains.TerrainConfig(poles=thin))


def test_the_configuration_is_one_omegaconf_understands():
    default = terrains.TerrainConfig()
    back = OmegaConf.to_object(OmegaConf.structured(default))
    assert back == default and hash(back) == hash(default)
