"""The guide against a slow loop on true terrain, and what its action does to the feet."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
import terrains
import tg
from envs import guide
from tests.envs.subjects import cell_centres, change_episode, standing

LEFT, RIGHT = np.array([0.0, 1.0]), np.array([0.0, -1.0])


def walking(subject, k, xy, command):
    """A robot in mid-step on terrain k."""
    qpos = standing(subject.env, xy=xy, yaw=0.4)
    episode = subject.begin(jax.random.key(3), jnp.int32(9))
    return change_episode(episode, qpos=qpos, terrain=k, command=command, floor=-0.5)


@pytest.mark.parametrize("command", [LEFT, RIGHT])
def test_feet_are_sent_to_the_best_ground_near(exact, command):
    env, k = exact.env, exact.find("poles", 9)
    terrain, threshold = exact.terrain(k), exact.config.rewards.gap_threshold
    ways = jax.jit(lambda episode: guide.ways(env, episode))
    sent = 0
    for xy in np.random.default_rng(0).uniform(-1.2, 1.2, (20, 2)):
        episode = walking(exact, k, xy, command)
        found = np.asarray(ways(episode))
        swing = tg.path.leg_phases(np.asarray(episode.controller.phase)) > guide.LIFTING
        np.testing.assert_array_equal(found[~swing], 0)
        landing, moved = (
            np.asarray(env.landing_points(episode)),
            np.asarray(env.core.residual_displacement(episode.controller, envs.env.exact_sensors(episode))),
        )
        for leg in np.flatnonzero(swing):

            def height(way, landing=landing[leg], xy=xy):
                at = np.asarray(xy) + tg.frames.turn(np.array(0.4), landing + way)
                return float(terrains.exact_height(terrain, cell_centres(env.bank, at)))

            cells = [guide.CELL * np.array([i, j]) for i in range(-6, 7) for j in range(-6, 7)]
            heights = [height(way) for way in cells]
            low = {
                (round(w[0], 3), round(w[1], 3)): max(heights) - h > threshold
                for w, h in zip(cells, heights, strict=True)
            }
            costs = []
            for way in guide.places():
                near = [
                    low[round(way[0] + dx, 3), round(way[1] + dy, 3)]
                    for dx in (-0.02, 0, 0.02)
                    for dy in (-0.02, 0, 0.02)
                ]
                there = moved[leg, :2] + way
                beyond = max(np.abs(there).max() - guide.LIMIT, 0)
                costs.append(np.mean(near) + np.linalg.norm(way) + 0.3 * np.linalg.norm(there) + 10 * beyond)
            if not any(low.values()):
                np.testing.assert_array_equal(found[leg], 0)
                continue
            chosen = int(np.argmin(np.linalg.norm(guide.places() - found[leg], axis=1)))
            assert costs[chosen] == pytest.approx(min(costs), abs=1e-4)
            sent += np.linalg.norm(found[leg]) > 0
    assert sent > 5


@pytest.mark.parametrize("command", [LEFT, RIGHT])
def test_the_action_moves_the_feet_that_way(exact, command):
    """Own residuals after undoing the mirror, through the leg's kinematics."""
    env, k = exact.env, exact.find("poles", 9)
    core = env.core
    both = jax.jit(lambda episode: (guide.guide(env, episode), guide.ways(env, episode)))
    asked = 0
    for xy in np.random.default_rng(1).uniform(-1.2, 1.2, (8, 2)):
        episode = walking(exact, k, xy, command)
        action, ways = both(episode)
        np.testing.assert_array_equal(action[:2], 0)
        mirror = core.update_mirror(episode.controller.mirror, env.heading_command(episode))
        residual = np.asarray(core.mirror_action(mirror, action)[2:]).reshape(4, 3)
        target = episode.controller.targets[0].reshape(4, 3)
        angles = tg.leg.inverse(core.geometry, target) + core.config.residual_range * residual
        moved = np.asarray(
            tg.leg.forward(core.geometry, angles) - target
        )  # level: trunk's is the heading frame
        wanted = guide.GAIN * np.asarray(ways)
        np.testing.assert_allclose(moved[:, :2], wanted, atol=1e-4)
        np.testing.assert_allclose(moved[:, 2], 0, atol=1e-4)
        asked += np.abs(wanted).max() > 0
    assert asked > 2


def test_only_terrain_with_gaps_has_pits(exact):
    assert exact.env.has_pits
    flat = terrains.TerrainConfig(kind="flat", num_terrains=12, half_extent=2.0)
    assert not envs.make(envs.EnvConfig(terrain=flat)).has_pits


def test_a_guided_environment_adds_what_the_guide_asks_for(exact):
    env = envs.Guided(exact.auto)
    state = jax.jit(env.reset)(jax.random.key(0))
    after = jax.jit(env.step)(state, jnp.zeros(14))
    alone = jax.jit(lambda episode: guide.guide(exact.env, episode))
    np.testing.assert_allclose(after.info["guide"], alone(after.pipeline_state), atol=1e-6)
    standing_still = change_episode(after.pipeline_state, command=np.zeros(2))
    np.testing.assert_array_equal(alone(standing_still), 0)
