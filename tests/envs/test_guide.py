"""The guide against a slow loop on true terrain, and what its action does to the feet."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
import terrains
import tg
from envs import guide
from envs.env import exact_sensors
from tests.envs.subjects import cell_centres, change_episode, standing

LEFT, RIGHT = np.array([0.0, 1.0]), np.array([0.0, -1.0])


def walking(subject, k, xy, command, phase=np.pi / 2, mirror=1.0):
    """A robot in a step on terrain k, its feet led a little aside."""
    qpos = standing(subject.env, xy=xy, yaw=0.4)
    episode = subject.begin(jax.random.key(3), jnp.int32(9))
    controller = episode.controller
    random = np.random.default_rng(round(1000 * abs(phase)))
    controller = controller._replace(
        phase=jnp.float32(phase),
        gate=jnp.float32(1.0),
        stride=jnp.asarray(tg.frames.turn(np.array(-0.4), command), jnp.float32),
        mirror=jnp.float32(mirror),
        targets=controller.targets + jnp.asarray(random.normal(scale=0.03, size=(2, 12)), jnp.float32),
    )
    episode = episode.replace(controller=controller)
    return change_episode(episode, qpos=qpos, terrain=k, command=command, floor=-0.5)


def ground(terrain, env, xy, way):
    """Height (m) of the terrain at a place (2,) m from a robot at xy, its heading 0.4 rad."""
    at = np.asarray(xy) + tg.frames.turn(np.array(0.4), way)
    return float(terrains.exact_height(terrain, cell_centres(env.bank, at)))


def gap_shares(height, rewards):
    """How much gap a foot meets at each of the guide's places, if it lands near it."""
    n, near = guide.REACH + guide.NEAR, range(-guide.NEAR, guide.NEAR + 1)
    cells = [(i, j) for i in range(-n, n + 1) for j in range(-n, n + 1)]
    heights = {cell: height(guide.CELL * np.array(cell)) for cell in cells}
    top = max(heights.values())
    weight = {
        (a, b): np.exp(-0.5 * (a * a + b * b) * (guide.CELL / guide.ERROR) ** 2) for a in near for b in near
    }
    shares = []
    for i, j in np.round(guide.places() / guide.CELL).astype(int):
        low = [w for (a, b), w in weight.items() if top - heights[i + a, j + b] > rewards.gap_threshold]
        shares.append(sum(low) / sum(weight.values()))
    return np.array(shares)


@pytest.mark.parametrize("command", [LEFT, RIGHT])
def test_feet_are_led_to_the_best_ground_near(exact, command):
    env, k, random = exact.env, exact.find("poles", 9), np.random.default_rng(0)
    terrain, c = exact.terrain(k), env.config
    displacements = jax.jit(lambda episode: guide.displacements(env, episode))
    led = 0
    for xy in random.uniform(-1.2, 1.2, (20, 2)):
        episode = walking(exact, k, xy, command, phase=random.uniform(0.0, np.pi))
        found, asked = map(np.asarray, displacements(episode))
        phases = tg.path.leg_phases(np.asarray(episode.controller.phase))
        assert not asked[phases <= guide.LIFTING].any()
        speed = 2 * episode.controller.frequency * c.tg.step_length
        excess = env.velocity(episode) - speed * episode.controller.stride
        balance = np.clip(guide.BALANCE * np.asarray(excess), -guide.AWAY, guide.AWAY)
        residual = env.core.residual_displacement(episode.controller, envs.env.exact_sensors(episode))
        legs = np.flatnonzero(phases > 0)
        ends = np.asarray(env.step_ends(episode))[legs]
        across = np.array([-1, 1]) * (ends[0] - ends[1])[::-1] / np.linalg.norm(ends[0] - ends[1])
        costs, shares = [], []
        for leg, end in zip(legs, ends, strict=True):
            share = np.clip((phases[leg] - guide.LIFTING) / (guide.ARRIVED - guide.LIFTING), 0.0, 1.0)
            shares.append(3 * share**2 - 2 * share**3)
            now = np.clip(np.asarray(residual)[leg, :2] / max(shares[-1], 0.3), -0.125, 0.125)
            gaps = gap_shares(lambda way, end=end, xy=xy: ground(terrain, env, xy, end + way), c.rewards)
            away = np.linalg.norm(now - guide.places(), axis=1)
            far = np.linalg.norm(balance - guide.places(), axis=1)
            costs.append(gaps + guide.FARTHER * far + guide.ANOTHER * away)
            danger = max(gaps[len(gaps) // 2], gaps[int(np.argmin(away))])
            if abs(danger - guide.SAFE) > 1e-4:
                assert asked[leg] == (danger > guide.SAFE and phases[leg] > guide.LIFTING)
        if shares[0] < 0.01:
            continue
        chosen = [
            int(np.argmin(np.linalg.norm(share * guide.places() - found[leg], axis=1)))
            for leg, share in zip(legs, shares, strict=True)
        ]
        np.testing.assert_allclose(np.array(shares)[:, None] * guide.places()[chosen], found[legs], atol=1e-5)

        def together(first, second, costs=costs, across=across, balance=balance):
            middle = (guide.places()[first] + guide.places()[second]) / 2 - balance
            return costs[0][first] + costs[1][second] + guide.ACROSS * abs(middle @ across)

        best = [np.argsort(cost)[: guide.CANDIDATES] for cost in costs]
        least = min(together(i, j) for i in best[0] for j in best[1])
        assert together(*chosen) <= least + 1e-3
        led += asked.sum()
    assert led > 5


@pytest.mark.parametrize("command", [LEFT, RIGHT])
@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_the_wish_is_about_the_policys_own_actions(exact, command, mirror):
    """Residuals that lead MuJoCo's feet there fulfil it, mirrored if the policy is; stance legs are free."""
    env, k, random = exact.env, exact.find("poles", 9), np.random.default_rng(1)
    core = env.core

    @jax.jit
    def all_of_it(episode):
        led, wanted = guide.displacements(env, episode)
        return guide.guide(env, episode), led, wanted, guide.residuals(env, episode, led)

    asked = 0
    for xy in random.uniform(-1.2, 1.2, (6, 2)):
        episode = walking(exact, k, xy, command, phase=random.uniform(0.0, np.pi), mirror=mirror)
        wish, led, wanted, own = map(np.asarray, all_of_it(episode))
        mirrored = core.update_mirror(episode.controller.mirror, env.heading_command(episode))
        action = np.asarray(core.mirror_action(mirrored, np.concatenate([np.zeros(2), own.ravel()])))
        away = np.einsum("lij,lj->li", wish[..., :3], action[2:].reshape(4, 3)) - wish[..., 3]
        order = [0, 1, 2, 3] if mirrored > 0 else [1, 0, 3, 2]
        np.testing.assert_allclose(away[wanted[order]], 0, atol=0.01)
        np.testing.assert_array_equal(np.abs(wish).sum(axis=(1, 2)) > 0, wanted[order])
        residual = core.config.residual_range * own
        phases = tg.path.leg_phases(
            tg.path.advance(
                np.asarray(episode.controller.phase), np.float32(core.config.base_frequency), 0.02
            )
        )
        target = core.foot_targets(
            phases,
            np.asarray(episode.controller.lift),
            np.asarray(episode.controller.stride),
            exact_sensors(episode),
        )
        angles = np.asarray(tg.leg.inverse(core.geometry, target))
        feet = []
        for q in (angles, angles + residual):
            qpos = np.array(episode.qpos)
            qpos[7:] = q.ravel()
            feet.append(exact.kinematics(qpos).site_xpos[env.robot.foot_site_ids, :2].copy())
        moved = tg.frames.turn(-tg.frames.yaw(np.asarray(episode.qpos[3:7])), feet[1] - feet[0])
        np.testing.assert_allclose(moved, led, atol=1e-4)
        asked += wanted.sum()
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
