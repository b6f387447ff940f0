"""The environment's protocol: episodes, ends, observation and metrics."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
import rewards
import terrains
import tg
from envs.env import make_core
from tests.envs.subjects import Subject, cell_centres, change, change_episode, config, standing
from tests.tg.mirror import mirror_joints, mirror_state

ZERO = jnp.zeros(14)
LEFT = np.array([np.cos(0.7), np.sin(0.7)], np.float32)


def leaves(tree):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(without_keys(tree))]


def without_keys(tree):
    """Typed random keys as plain numbers."""

    def plain(leaf):
        typed = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return jax.random.key_data(leaf) if typed else leaf

    return jax.tree.map(plain, tree)


def assert_equal(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(leaves(one), leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


# Protocol -----------------------------------------------------------------------------------------------------


def test_sizes_are_those_announced(exact):
    obs = exact.state.obs
    assert {name: value.shape for name, value in obs.items()} == {
        name: (size,) for name, size in exact.env.observation_size.items()
    }
    assert exact.env.action_size == 14 and exact.env.dt == 0.02
    assert exact.env.observation_size == {"state": 188, "privileged_state": 232}


def test_reset_and_step_agree_on_structure_and_types(noisy):
    before = noisy.state
    after = noisy.step(before, ZERO)
    assert jax.tree.structure(before) == jax.tree.structure(after)
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        assert jax.typeof(a) == jax.typeof(b)
    assert set(before.metrics) == set(after.metrics) == set(noisy.env.metric_names)


def test_a_long_run_is_finite_and_compiled_once(noisy):
    states = noisy.rollout(noisy.state, 250, scale=0.6)
    for state in states:
        assert all(np.isfinite(leaf).all() for leaf in leaves(state))
    ended = [state for state in states if state.done]
    assert ended and all(state.pipeline_state.step == 0 for state in ended)
    assert noisy.step._cache_size() == noisy.reset._cache_size() == 1


@pytest.mark.slow
def test_step_is_a_function(noisy):
    state, action = noisy.rollout(noisy.state, 3)[-1], jnp.full(14, 0.2)
    copy = jax.tree.map(np.copy, without_keys(state))
    first, second = noisy.step(state, action), noisy.step(state, action)
    assert_equal(first, second)
    assert_equal(without_keys(state), copy)
    assert_equal(noisy.reset(jax.random.key(5)), noisy.reset(jax.random.key(5)))


def test_another_key_is_another_episode(noisy):
    one, other = (noisy.reset(jax.random.key(i)).pipeline_state for i in (1, 2))
    for name in ("qpos", "command", "origin"):
        assert (np.asarray(getattr(one, name)) != np.asarray(getattr(other, name))).any()
    assert one.randomised.friction != other.randomised.friction


def test_batches_are_the_single_instances(noisy):
    keys = jax.random.split(jax.random.key(0), 3)
    together = jax.jit(jax.vmap(noisy.auto.reset))(keys)
    for i in range(3):
        for a, b in zip(leaves(together), leaves(noisy.reset(keys[i])), strict=True):
            np.testing.assert_allclose(a[i], b, atol=1e-5)


def test_unknown_settings_name_the_choices():
    with pytest.raises(ValueError, match="unknown method 'deaf'; choose one of ours, fixed_height, blind"):
        envs.make(config(method="deaf"))
    with pytest.raises(ValueError, match="whole multiple"):
        envs.make(config(physics_dt=0.006))
    with pytest.raises(ValueError, match="same number of levels"):
        envs.make(config(curriculum=envs.CurriculumConfig(depth=(0.1,))))


# A new episode --------------------------------------------------------------------------------------------------


def last_step(subject, state, **changes):
    """A state whose next step is the episode's last."""
    return change(state, step=subject.env.episode_steps - 1, **changes)


def test_nothing_of_an_episode_outlives_it(noisy):
    """Episodes that have only their key and the level in common, one of them exploded: the next is the same."""
    key, level = jax.random.key(99), 3
    fresh = noisy.reset(jax.random.key(2))
    walked = noisy.rollout(noisy.state, 15)[-1]
    exploded = change(walked, qvel=walked.pipeline_state.qvel.at[4].set(jnp.nan))
    ends = []
    for i, state in enumerate((fresh, walked, exploded)):
        # An episode on another level than the environment's was revisited: it doesn't count for the ladder.
        state = last_step(noisy, state, level=1 if i else 2).replace(
            info={**state.info, "level": jnp.int32(level)}
        )
        # The next terrain is of the same kind as the last.
        terrain = walked.pipeline_state.terrain
        state = state.replace(pipeline_state=state.pipeline_state.replace(key=key, terrain=terrain))
        ends.append(noisy.step(state, jnp.full(14, 0.5 * i)))
    for end in ends[1:]:
        assert end.done == 1.0
        assert_equal(end.pipeline_state, ends[0].pipeline_state)
        assert_equal(end.obs, ends[0].obs)
    assert int(ends[0].info["level"]) == level


def test_the_new_episode_is_one_that_begins_with_the_same_key(noisy):
    walked = noisy.rollout(noisy.state, 15)[-1]
    end = noisy.step(last_step(noisy, walked), ZERO)
    # The key that follows the last step's, and the branch of it that resets use.
    key = jax.random.fold_in(jax.random.fold_in(walked.pipeline_state.key, 0), 3)
    begun = noisy.begin(key, end.info["level"], walked.pipeline_state.terrain)
    for a, b in zip(leaves(end.pipeline_state), leaves(begun), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    seen = noisy.observe(begun)
    for name in seen:
        np.testing.assert_allclose(end.obs[name], seen[name], atol=1e-5)
    assert end.pipeline_state.step == 0 and end.pipeline_state.progress == 0
    assert not np.asarray(end.pipeline_state.controller.actions).any()


def test_episodes_begin_on_the_platform_at_rest(exact):
    for seed in range(20):
        episode = exact.begin(jax.random.key(seed), jnp.int32(7))
        c = exact.config
        assert np.abs(episode.qpos[:2]).max() <= c.spawn_offset
        np.testing.assert_array_equal(episode.origin, episode.qpos[:2])
        assert episode.heading == pytest.approx(float(tg.frames.yaw(episode.qpos[3:7])), abs=1e-5)
        assert np.linalg.norm(episode.command) == pytest.approx(1.0)
        assert not np.asarray(episode.qvel).any()
        level, practice = int(episode.level), bool(episode.practice)
        assert (level <= 7 or practice) and int(episode.terrain) % exact.env.levels == level
        depth = c.curriculum.practice_depth if practice else c.curriculum.depth[level]
        assert episode.floor == pytest.approx(max(float(exact.env.bank.floor[episode.terrain]), -depth))
        lowest = exact.kinematics(episode.qpos).geom_xpos[exact.env.robot.foot_geom_ids, 2].min()
        assert lowest == pytest.approx(exact.env.robot.foot_radius, abs=0.002)


def test_some_are_told_once_to_stand_for_a_while(exact):
    env = exact.env
    asked = dataclasses.replace(exact.config, stop_share=0.3, stop_time=(1.0, 3.0))
    other = object.__new__(type(env))
    other.__dict__.update(env.__dict__ | {"config": asked})
    stops = np.asarray(jax.vmap(other._draw_stop)(jax.random.split(jax.random.key(0), 4000)))
    told = stops[:, 1] > stops[:, 0]
    assert told.mean() == pytest.approx(0.3, abs=0.03) and not stops[~told].any()
    first, steps = stops[told, 0], np.diff(stops[told])[:, 0]
    assert first.min() >= 0 and first.max() < env.episode_steps
    assert np.quantile(first, [0.25, 0.5, 0.75]) == pytest.approx([125, 250, 375], abs=20)
    assert steps.min() >= 49 and steps.max() <= 151 and steps.mean() == pytest.approx(100, abs=3)
    assert not np.asarray(jax.vmap(env._draw_stop)(jax.random.split(jax.random.key(0), 100))).any()


def test_some_are_told_to_walk_straight_ahead_or_back(exact):
    other = object.__new__(type(exact.env))
    other.__dict__.update(
        exact.env.__dict__ | {"config": dataclasses.replace(exact.config, straight_share=0.4)}
    )
    keys = jax.random.split(jax.random.key(0), 4000)
    angles = np.asarray(
        jax.vmap(lambda key: other._draw_straight(key, jnp.float32(0.5), jnp.float32(2)))(keys)
    )
    ahead, back = (np.isclose(angles, 0.5 + turn, atol=1e-6) for turn in (0.0, np.pi))
    assert ahead.mean() == pytest.approx(0.2, abs=0.03) and back.mean() == pytest.approx(0.2, abs=0.03)
    assert np.all(angles[~ahead & ~back] == 2)


def test_told_to_stand_it_is_seen_and_rewarded(exact):
    state = change(exact.state, command=LEFT, stop=np.array([3, 6]), qpos=standing(exact.env))
    shown, paid = [], []
    for _ in range(8):
        shown.append(float(np.linalg.norm(state.obs["state"][:2])))
        state = exact.step(state, ZERO)
        v = np.asarray(state.pipeline_state.qvel[:2])
        standing_pay = 1.0 - min(np.linalg.norm(v) / exact.config.rewards.speed_low, 1.0)
        walking_pay = np.clip(v @ LEFT / exact.config.rewards.speed_low, -0.5, 1.0)
        weight = exact.config.rewards.along
        paid.append([float(state.metrics["reward/along"]) / weight - p for p in (walking_pay, standing_pay)])
    # The first observation is of the state as it was made, before the command was changed.
    np.testing.assert_allclose(shown[1:], [1, 1, 0, 0, 0, 1, 1], atol=1e-6)
    for k, (as_walking, as_standing) in enumerate(paid):
        assert (as_standing if 3 <= k < 6 else as_walking) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.slow
def test_it_stands_as_high_as_it_should(exact):
    """A command to stand: a second later the weight's compensation holds the trunk where it was meant to be."""
    state = change(exact.state, command=np.zeros(2), qpos=standing(exact.env))
    for _ in range(50):
        state = exact.step(state, ZERO)
    episode = state.pipeline_state
    assert episode.qpos[2] == pytest.approx(exact.env.robot.standing_height, abs=0.005)
    assert np.abs(episode.qvel[:6]).max() < 0.06 and np.abs(episode.qpos[:2]).max() < 0.01
    assert state.metrics["reward/along"] == pytest.approx(1.0, abs=0.05)


# Ends -----------------------------------------------------------------------------------------------------------


def end_of(subject, state):
    after = subject.step(state, ZERO)
    figures = {name.removeprefix("episode/"): float(after.metrics[name]) for name in after.metrics}
    return float(after.done), float(after.info["truncation"]), figures


def test_time_is_up(exact):
    state = change(exact.state, qpos=standing(exact.env))
    done, truncated, figures = end_of(exact, change(state, step=exact.env.episode_steps - 2))
    assert (done, truncated, figures["ended"], figures["length"]) == (0, 0, 0, 0)
    done, truncated, figures = end_of(exact, change(state, step=exact.env.episode_steps - 1, progress=1.25))
    assert (done, truncated, figures["ended"], figures["fell"]) == (1, 1, 1, 0)
    assert figures["length"] == exact.env.episode_steps == 500
    assert figures["distance"] == pytest.approx(1.25)


def test_goal_reached(exact):
    state = change(exact.state, qpos=standing(exact.env))
    assert end_of(exact, change(state, progress=4.99))[:2] == (0, 0)
    done, truncated, figures = end_of(exact, change(state, progress=5.4))
    assert (done, truncated, figures["distance"]) == (1, 1, 5.0)


def test_off_the_map(exact):
    border = exact.env.bank.half_extent - 0.15
    for x, expected in [(border - 0.02, 0), (border + 0.02, 1)]:
        qpos = standing(exact.env, xy=(0.0, -x), z=1.0)
        assert end_of(exact, change(exact.state, qpos=qpos))[:2] == (expected, expected)


def test_a_fall_is_no_truncation(exact):
    state = change(exact.state, qpos=standing(exact.env, z=-0.2), step=exact.env.episode_steps - 1)
    done, truncated, figures = end_of(exact, state)
    assert (done, truncated, figures["fell"], figures["exploded"]) == (1, 0, 1, 0)


@pytest.mark.parametrize("value", [np.nan, 1e6])
def test_an_explosion_leaves_no_trace_in_reward_and_metrics(exact, value):
    walked = exact.rollout(exact.state, 3)[-1]
    state = change(walked, qvel=np.where(np.arange(18) == 7, value, walked.pipeline_state.qvel), progress=0.7)
    after = exact.step(state, ZERO)
    assert after.done == 1 and after.info["truncation"] == 0 and after.reward == 0
    assert after.metrics["episode/exploded"] == after.metrics["episode/fell"] == 1
    assert all(np.isfinite(value) for value in after.metrics.values())
    if np.isnan(value):
        assert after.metrics["episode/distance"] == pytest.approx(0.7)


def judged(subject, terrain=None, env=None, **changes):
    """Whether a pose counts as a fall."""
    env = subject.env if env is None else env
    episode = change_episode(subject.begin(jax.random.key(0), jnp.int32(9)), **changes)
    if terrain is not None:
        floor = env.bank.floor[terrain]
        episode = change_episode(episode, terrain=terrain, floor=floor)
    return bool(env._fell(episode, *env._terrain_at_feet(episode)))


def test_trunk_touches_the_ground(exact):
    """Legs folded away: the bottom of the trunk's box, half an edge below its centre, is what hits."""
    joints = np.tile([0.0, -1.5, 2.4], 4)
    half = exact.env.robot.trunk_half_size[2]
    for z, expected in [(half + 0.002, False), (half - 0.002, True)]:
        qpos = standing(exact.env, joints=joints)
        qpos[2] = z
        assert exact.kinematics(qpos).xpos[exact.env.robot.knee_ids, 2].min() > 0.03
        assert judged(exact, qpos=qpos) == expected


def test_knees_touch_the_ground(exact):
    qpos = standing(exact.env)
    knee = exact.kinematics(qpos).xpos[exact.env.robot.knee_ids, 2].min()
    for height, expected in [(0.022, False), (0.018, True)]:
        lowered = qpos.copy()
        lowered[2] += height - knee
        assert lowered[2] > exact.env.robot.trunk_half_size[2] + 0.02
        assert judged(exact, qpos=lowered) == expected
    # Where knees push the ground, that is no fall.
    touching = with_config(exact, dataclasses.replace(exact.config, knee_contact=True))
    assert not judged(exact, env=touching, qpos=lowered)


def test_tilt(exact):
    for degrees, expected in [(59, False), (61, True)]:
        qpos = standing(exact.env, z=1.0)
        half = np.deg2rad(degrees) / 2
        qpos[3:7] = np.cos(half), 0.6 * np.sin(half), 0.8 * np.sin(half), 0
        assert judged(exact, qpos=qpos) == expected


def test_collisions_are_those_of_all_points_with_the_true_terrain(exact):
    env, rng = exact.env, np.random.default_rng(0)
    robot, found = env.robot, []
    for i in range(60):
        k = int(rng.integers(env.bank.num_terrains))
        terrain = exact.terrain(k)
        xy = rng.uniform(-1.4, 1.4, 2)
        qpos = standing(
            env, xy=xy, yaw=rng.uniform(-3, 3), joints=env.robot.default_pose + rng.normal(0, 0.3, 12)
        )
        qpos[2] = terrains.exact_height(terrain, xy) + rng.uniform(0.1, 0.4)
        data = exact.kinematics(qpos)
        trunk = data.xpos[robot.trunk_id] + robot.trunk_points @ data.xmat[robot.trunk_id].reshape(3, 3).T
        points = np.concatenate([trunk, data.xpos[robot.knee_ids] - [0, 0, exact.config.knee_radius]])
        clear = points[:, 2] - terrains.exact_height(terrain, cell_centres(env.bank, points[:, :2]))
        if np.abs(clear).min() < 1e-3:
            continue
        found.append(bool((clear < 0).any()))
        plain = dataclasses.replace(exact.config, end_in_gap=False)
        assert judged(exact, k, env=with_config(exact, plain), qpos=qpos) == found[-1], i
    assert 10 < sum(found) < len(found) - 10


def test_knee_term_looks_at_the_knees_clearance(exact):
    """By MuJoCo's knees over the true stairs; without a weight there is no such term."""
    env, k, rng = exact.env, exact.find("stairs", 9), np.random.default_rng(0)
    terrain, found = exact.terrain(k), []
    c = dataclasses.replace(exact.config.rewards, knee=2.0)
    paid = with_config(exact, dataclasses.replace(exact.config, rewards=c))
    assert set(paid.metric_names) - set(env.metric_names) == {"reward/knee"}
    for _ in range(6):
        xy = rng.uniform(-1.4, 1.4, 2)
        qpos = standing(env, xy=xy, joints=env.robot.default_pose + rng.normal(0, 0.3, 12))
        qpos[2] = terrains.exact_height(terrain, xy) + rng.uniform(0.2, 0.3)
        knees = exact.kinematics(qpos).xpos[env.robot.knee_ids]
        ground = terrains.exact_height(terrain, cell_centres(env.bank, knees[:, :2]))
        clear = knees[:, 2] - ground - exact.config.knee_radius
        episode = episode_at(exact, k, qpos)
        terms = paid._reward_terms(episode, episode, *paid._terrain_at_feet(episode))
        found.append(np.mean(np.clip(1.0 - clear / c.knee_margin, 0.0, 1.0)))
        assert terms["knee"] == pytest.approx(-found[-1], abs=0.02)  # heights are whole millimetres
        assert rewards.total(c, terms)[1]["knee"] == pytest.approx(2.0 * terms["knee"])
    assert np.std(found) > 0.1


def test_heave_term_is_the_vertical_speed_squared(exact):
    c = dataclasses.replace(exact.config.rewards, heave=2.0)
    paid = with_config(exact, dataclasses.replace(exact.config, rewards=c))
    assert set(paid.metric_names) - set(exact.env.metric_names) == {"reward/heave"}
    episode = episode_at(exact, exact.find("stairs", 9), standing(exact.env))
    moving = change_episode(episode, qvel=np.concatenate([[0.3, -0.2, -0.25], np.ones(15)]))
    terms = paid._reward_terms(episode, moving, *paid._terrain_at_feet(moving))
    assert terms["heave"] == pytest.approx(-0.0625)
    assert rewards.total(c, terms)[1]["heave"] == pytest.approx(-0.125)


def with_config(subject, changed):
    return envs.QuadrupedEnv(changed, subject.env.bank)


def test_a_foot_in_a_gap_ends_the_episode(exact):
    """LF's centre over a pit with a stone within 10 cm: its lowest point 4 and then 6 cm below the stone's top."""
    k = exact.find("stepping_stones", 8)
    terrain, robot = exact.terrain(k), exact.env.robot
    feet = exact.kinematics(standing(exact.env)).geom_xpos[robot.foot_geom_ids]
    rng = np.random.default_rng(0)
    while True:
        xy = rng.uniform(-1.2, 1.2, 2)
        lf = cell_centres(exact.env.bank, xy + feet[0, :2])
        ring = lf + 0.06 * np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
        others = terrains.exact_height(terrain, (xy + feet[1:, :2])[:, None] + ring[None] - lf)
        if terrains.exact_height(terrain, lf) < -0.3 and (terrains.exact_height(terrain, ring) == 0).any():
            if (others > -0.3).all():
                break
    qpos = standing(exact.env, xy=lf - feet[0, :2])
    lowest = feet[0, 2] - robot.foot_radius
    without = with_config(exact, dataclasses.replace(exact.config, end_in_gap=False))
    for depth, expected in [(0.04, False), (0.06, True)]:
        lowered = qpos.copy()
        lowered[2] -= lowest + depth
        assert judged(exact, k, qpos=lowered) == expected
        assert not judged(exact, k, env=without, qpos=lowered)


# Curriculum -------------------------------------------------------------------------------------------------------


def test_ladder(exact):
    """0.35 m/s for 10 s is 3.5 m: up beyond 2.45 m, down below 1.225 m."""
    env = exact.env
    assert (env.config.rewards.speed_low, env.config.episode_time) == (0.35, 10.0)
    episode = exact.begin(jax.random.key(0), jnp.int32(4))

    def after(progress, *, fell=False, level=4, own=None, practice=False, command=(1.0, 0.0), env=env):
        changed = change_episode(
            episode,
            progress=progress,
            level=level if own is None else own,
            practice=practice,
            command=np.array(command),
        )
        return int(env.next_level(changed, jnp.int32(level), jnp.asarray(fell)))

    assert after(2.46) == 5 and after(2.44) == 4
    assert after(2.46, fell=True) == 4  # far, but not to the end
    assert after(1.23) == 4 and after(1.22) == 3 and after(1.22, fell=True) == 3
    assert after(5.0, own=2) == 4 and after(0.0, own=2) == 4  # what was revisited doesn't count
    assert after(5.0, practice=True) == 4 and after(0.0, practice=True) == 4  # nor what was practised
    assert after(0.0, command=(0.0, 0.0)) == 4  # nor does standing
    top = env.levels - 1
    assert after(5.0, level=top) == top and after(0.0, level=0) == 0
    fixed = with_config(
        exact, dataclasses.replace(exact.config, curriculum=envs.CurriculumConfig(enabled=False))
    )
    assert after(5.0, env=fixed) == 4
    fast = with_config(exact, dataclasses.replace(exact.config, curriculum=envs.CurriculumConfig(leap=3)))
    assert (
        after(2.46, env=fast) == 7
        and after(1.22, env=fast) == 3
        and after(5.0, level=top - 1, env=fast) == top
    )


def test_auto_reset_climbs_and_descends(noisy):
    level = jnp.int32(4)
    command = np.array([1.0, 0.0])
    for progress, expected in [(3.0, 5), (2.0, 4), (0.5, 3)]:
        state = last_step(noisy, noisy.state, practice=False, level=4, progress=progress, command=command)
        after = noisy.step(state.replace(info={**state.info, "level": level}), ZERO)
        assert after.done == 1 and int(after.info["level"]) == expected
        episode = after.pipeline_state
        assert int(episode.level) <= expected or bool(episode.practice)
        assert after.metrics["episode/level"] == pytest.approx(4 / 11)
        kinds = np.asarray(noisy.env.bank.kind_id)
        was = state.pipeline_state.terrain
        name = noisy.env.bank.kinds[kinds[was]]
        assert after.metrics[f"share/{name}"] == 1.0
        assert after.metrics[f"level/{name}"] == pytest.approx(4 / 11)
        fitting = (kinds == kinds[was]) & (np.arange(len(kinds)) % noisy.env.levels == int(episode.level))
        assert fitting[int(episode.terrain)] or not fitting.any()


def test_levels_at_the_start_and_revisits(exact):
    c = exact.config.curriculum
    keys = jax.random.split(jax.random.key(0), 2000)
    begun = jax.jit(jax.vmap(lambda key: exact.env.begin(key, jnp.int32(5))))(keys)
    levels, practice, floor = map(np.asarray, (begun.level, begun.practice, begun.floor))
    own = levels[~practice]
    assert own.max() == 5 and own.min() == 0
    assert (own < 5).mean() == pytest.approx(c.revisit, abs=0.04)
    # Footholds are practised on every level, where there are pits at all, and in shallow ones.
    deep = np.asarray(exact.env.bank.floor)[np.asarray(begun.terrain)] < -0.1
    pits = np.flatnonzero(np.asarray(exact.env.bank.floor) < -0.1)
    assert deep[practice].all() and set(levels[practice]) == set(pits % exact.env.levels)
    np.testing.assert_allclose(floor[practice], -c.practice_depth)
    share = np.mean(np.asarray(exact.env.bank.floor) < -0.1)
    assert practice.mean() == pytest.approx(c.practice * share, abs=0.05)
    starts = np.asarray(jax.jit(jax.vmap(lambda key: exact.env.reset(key).info["level"]))(keys))
    assert set(starts) == set(range(c.start + 1))


def test_the_next_terrain_is_of_the_same_kind(exact):
    """A ladder of its own for every kind: of the instances of that kind and level each one is drawn as often."""
    env = exact.env
    kind, levels = np.asarray(env.bank.kind_id), np.arange(env.bank.num_terrains) % env.levels
    keys = jax.random.split(jax.random.key(1), 300)
    begin = jax.jit(jax.vmap(env.begin, in_axes=(0, None, None)))
    missing = 0
    for before in range(8):
        begun = begin(keys, jnp.int32(6), jnp.int32(before))
        drawn = np.asarray(begun.terrain)
        np.testing.assert_array_equal(levels[drawn], begun.level)
        for level in range(env.levels):
            fitting = np.flatnonzero((levels == level) & (kind == kind[before]))
            missing += len(fitting) == 0
            here = drawn[np.asarray(begun.level) == level]
            allowed = fitting if len(fitting) else np.flatnonzero(levels == level)
            assert np.isin(here, allowed).all()
            if level == 6:
                counts = [np.sum(here == k) for k in allowed]
                assert np.min(counts) > 0.3 * np.max(counts)
    assert missing  # a small bank doesn't have every kind on every level
    several = {env.bank.kinds[i] for i in kind}
    assert set(env.mixture) == several and {f"level/{name}" for name in several} < set(env.metric_names)


# Observation ------------------------------------------------------------------------------------------------------


def episode_at(subject, k, qpos, **changes):
    yaw = tg.frames.yaw(np.asarray(qpos[3:7]))
    episode = subject.begin(jax.random.key(0), jnp.int32(9))
    return change_episode(
        episode, qpos=qpos, terrain=k, command=tg.frames.turn(yaw, LEFT.astype(float)), **changes
    )


def test_heights_are_the_true_terrains_round_the_feet(exact):
    """MuJoCo's feet, rings turned by the heading, true primitives: 100 heights at 24 places on all terrains."""
    env, rng = exact.env, np.random.default_rng(0)
    rings = np.array(tg.samples.ring_offsets())
    same = []
    for k in range(env.bank.num_terrains):
        yaw = rng.uniform(-3, 3)
        qpos = standing(
            env,
            xy=rng.uniform(-1.3, 1.3, 2),
            z=0.1,
            yaw=yaw,
            joints=env.robot.default_pose + rng.normal(0, 0.2, 12),
        )
        tilt = np.array([1.0, *rng.normal(0, 0.05, 3)])
        mujoco.mju_mulQuat(qpos[3:7], qpos[3:7].copy(), tilt / np.linalg.norm(tilt))
        feet = exact.kinematics(qpos).site_xpos[env.robot.foot_site_ids]
        heading = tg.frames.yaw(qpos[3:7])
        points = feet[:, None, :2] + tg.frames.turn(np.asarray(heading), rings)
        seen = np.asarray(exact.observe(episode_at(exact, k, qpos))["state"][-100:]).reshape(4, 25)
        for where, tolerance in [(cell_centres(env.bank, points), 0.001), (points, None)]:
            below = feet[:, 2:] - terrains.exact_height(exact.terrain(k), where)
            right = np.abs(seen - 5 * np.clip(below, -0.25, 0.25)) < 5 * 0.001
            if tolerance:
                # But points that single precision puts into the next cell.
                assert right.mean() > 0.98
            else:
                same.append(right.mean())
    assert np.mean(same) > 0.9  # within a centimetre of an edge the cell may show the other side


@pytest.fixture(scope="module")
def blind(exact):
    return Subject(dataclasses.replace(exact.config, method="blind"))


def test_blind_sees_no_heights_but_its_critic_does(exact, blind):
    assert blind.env.observation_size == {"state": 88, "privileged_state": 232}
    assert make_core(blind.config, blind.env.robot).heights is False
    k = exact.find("stairs", 9)
    qpos = standing(exact.env, xy=(0.3, 0.2), z=0.05)
    seeing = exact.observe(episode_at(exact, k, qpos))
    unseeing = blind.observe(episode_at(blind, k, qpos))
    np.testing.assert_allclose(unseeing["state"], seeing["state"][:-100], atol=1e-6)
    critic = unseeing["privileged_state"]
    np.testing.assert_allclose(critic[-100:], seeing["state"][-100:], atol=1e-5)
    np.testing.assert_allclose(critic[88:-100], seeing["privileged_state"][188:], atol=1e-5)
    # The ground it can't see doesn't show.
    flat = blind.observe(episode_at(blind, k, standing(exact.env, z=0.05)))
    np.testing.assert_array_equal(flat["state"], unseeing["state"])


def test_fixed_height_has_the_same_senses_but_no_stride(exact):
    env = envs.QuadrupedEnv(dataclasses.replace(exact.config, method="fixed_height"), exact.env.bank)
    assert env.observation_size == exact.env.observation_size
    assert env.core.config.step_length == env.core.config.lift_range == 0.0
    assert env.core.config.lift == exact.env.core.config.lift


def mirror_episode(episode):
    """The mirror image in the x-z plane of an episode on level ground."""
    qpos, qvel = np.asarray(episode.qpos), np.asarray(episode.qvel)
    w, x, y, z = qpos[3:7]
    position, twist = qpos[:3] * [1, -1, 1], qvel[:6] * [1, -1, 1, -1, 1, -1]
    controller = mirror_state(jax.tree.map(np.asarray, episode.controller))
    return change_episode(
        episode,
        qpos=np.concatenate([position, [w, -x, y, -z], mirror_joints(qpos[7:])]),
        qvel=np.concatenate([twist, mirror_joints(qvel[6:])]),
        command=np.asarray(episode.command) * [1, -1],
        controller=controller,
    )


def walked(subject, steps=12):
    """A robot on its way to the front left, still on the platform."""
    state = change(
        subject.state, qpos=standing(subject.env), command=LEFT, terrain=0, floor=subject.env.bank.floor[0]
    )
    return subject.rollout(state, steps)[-1].pipeline_state


def test_critic_and_policy_see_the_same_in_the_mirror(exact):
    episode = walked(exact)
    one, other = exact.observe(episode), exact.observe(mirror_episode(episode))
    for name in one:
        np.testing.assert_allclose(one[name], other[name], atol=1e-4, err_msg=name)


def test_the_blind_policys_critic_sees_the_same_in_the_mirror(exact, blind):
    episode = walked(exact)
    one, other = blind.observe(episode), blind.observe(mirror_episode(episode))
    for name in one:
        np.testing.assert_allclose(one[name], other[name], atol=1e-4, err_msg=name)


# Rewards and metrics ------------------------------------------------------------------------------------------------


def test_each_term_is_logged_by_itself(exact):
    """All terms once more in NumPy, from the states before and after a step."""
    c = exact.config.rewards
    states = exact.rollout(change(exact.state, qpos=standing(exact.env), command=LEFT), 14)
    before, state = states[-2].pipeline_state, states[-1]
    after = state.pipeline_state
    logged = {name[7:]: float(value) for name, value in state.metrics.items() if name.startswith("reward/")}
    v, command = np.asarray(after.qvel[:2]), LEFT
    speed = v @ command
    along = np.clip(speed / c.speed_low, -0.5, 1.0) * np.exp(-2 * max(speed - c.speed_high, 0) ** 2)
    paid = np.clip(along, 0, 1)
    q, previous = np.asarray(after.controller.desired), np.asarray(before.controller.desired)
    swing = tg.path.leg_phases(np.asarray(after.controller.phase)) > 0
    # On the platform nothing rises: F_thre is all that is granted.
    high = np.maximum(np.asarray(after.controller.lift) - c.lift_threshold, 0)
    expected = {
        "along": c.along * along,
        "across": c.across * paid * np.exp(-1.5 * (v @ v - speed**2)),
        "smooth": c.smooth * paid * np.exp(-0.5 * ((q - previous) ** 2).sum()),
        "energy": -c.energy * np.abs(np.asarray(after.torque) * np.asarray(after.qvel[6:])).sum(),
        "terrain": 0.0,
        "aim": 0.0,
        "height": -c.height * (high * swing).mean(),
        "yaw": -c.yaw * float(after.qvel[5]) ** 2,
        "heading": -c.heading * (1 - np.cos(float(tg.frames.yaw(after.qpos[3:7]) - after.heading))),
        "tilt": -c.tilt * 0.1 * float((after.qvel[3:5] ** 2).sum()),
    }
    assert logged == pytest.approx(expected, abs=1e-5)
    assert float(state.reward) == pytest.approx(sum(expected.values()), abs=1e-5)
    assert state.metrics["speed"] == pytest.approx(speed, abs=1e-5)
    assert state.metrics["lift"] == pytest.approx(float(after.controller.lift.mean()), abs=1e-6)
    assert after.progress == pytest.approx(
        max(float(before.progress), float((after.qpos[:2] - after.origin) @ command)), abs=1e-6
    )


def test_terrain_term_looks_at_the_feet_in_stance(exact):
    """A pole's edge within 3 cm of LF: the mean over the feet of the share of low points within 3 cm."""
    env, k = exact.env, exact.find("poles", 9)
    terrain = exact.terrain(k)
    row = terrain.primitives[np.argmin(np.abs(terrain.primitives[:, :2] - [0.9, 0.6]).sum(axis=1))]
    feet = exact.kinematics(standing(env)).geom_xpos[env.robot.foot_geom_ids]
    centre = row[:2] + [row[4] + 0.015, 0]  # LF 1.5 cm beside the pole
    episode = episode_at(exact, k, standing(env, xy=centre - feet[0, :2]), floor=-0.5)
    below, around = env._terrain_at_feet(episode)
    terms = env._reward_terms(episode, episode, below, around)
    phases = tg.path.leg_phases(np.asarray(episode.controller.phase))
    rings = np.array(tg.samples.ring_offsets())
    heights = terrains.exact_height(
        terrain, cell_centres(env.bank, feet[:, None, :2] + rings + centre - feet[0, :2])
    )
    deep = heights.max(axis=1, keepdims=True) - heights > exact.config.rewards.gap_threshold
    low = deep[:, :7].mean(axis=1)
    assert 0 < low[0] < 1
    np.testing.assert_allclose(terms["terrain"], -(low * (phases <= 0)).mean(), atol=1e-6)
    still = change_episode(episode, command=np.zeros(2))
    standing_terms = env._reward_terms(still, still, below, around)
    np.testing.assert_allclose(standing_terms["terrain"], -low.mean(), atol=1e-6)  # all feet stand
    assert standing_terms["height"] == 0


def test_feet_come_down_where_they_were_said_to(exact):
    """While the trajectory generator alone stays up: near MuJoCo's feet at touch-down, and nearer the later it is."""
    env = exact.env
    landing = jax.jit(env.landing_points)

    def said(episode, leg):
        return np.asarray(
            episode.qpos[:2] + tg.frames.turn(tg.frames.yaw(episode.qpos[3:7]), landing(episode)[leg])
        )

    state = change(exact.state, qpos=standing(env), command=LEFT, terrain=exact.find("blocks", 0))
    states = [s.pipeline_state for s in exact.rollout(state, 40, scale=0.0)]
    errors = []
    for leg in range(4):
        phases = [float(tg.path.leg_phases(e.controller.phase)[leg]) for e in states]
        for t in range(12, len(states) - 1):
            if phases[t] > 0 >= phases[t + 1]:  # comes down at t + 1
                place = (
                    exact.kinematics(states[t + 1].qpos).site_xpos[env.robot.foot_site_ids[leg], :2].copy()
                )
                swing = [u for u in range(t - 12, t + 1) if phases[u] > 0]
                errors += [(phases[u], np.linalg.norm(said(states[u], leg) - place)) for u in swing]
    assert len(errors) > 40
    early, late = ([e for p, e in errors if low <= p < high] for low, high in ((0.9, 1.7), (2.4, np.pi)))
    assert np.median(late) < 0.06
    assert np.median(late) < np.median(early) < 0.12


def test_aim_term_looks_where_the_feet_will_come_down(exact):
    """As r_terrain, but for feet in swing, on the ground at their landing points."""
    env, k = exact.env, exact.find("poles", 9)
    terrain, c = exact.terrain(k), exact.config.rewards
    episode = episode_at(exact, k, standing(env, xy=(1.5, 0.3)), floor=-0.5)
    _, around = env._terrain_at_feet(episode)
    rings = np.array(tg.samples.ring_offsets())[:7]
    where = np.asarray(env.landing_points(episode))[:, None] + rings + np.array([1.5, 0.3])
    heights = terrains.exact_height(terrain, cell_centres(env.bank, where))
    highest = np.maximum(np.asarray(around).max(axis=1), heights.max(axis=1))
    low = (highest[:, None] - heights > c.gap_threshold).mean(axis=1)
    swing = tg.path.leg_phases(np.asarray(episode.controller.phase)) > 0
    assert swing.sum() == 2 and 0 < low[swing].mean()
    there = env._terrain_ahead(episode)
    np.testing.assert_allclose(env._aim(episode, around, there), -low * swing, atol=1e-6)
    stands = change_episode(episode, command=np.zeros(2))
    np.testing.assert_array_equal(env._aim(stands, around, there), 0)


def test_height_term_grants_what_the_terrain_rises(exact):
    """Round the feet, and round the places where they will come down."""
    env, k = exact.env, exact.find("stairs", 9)
    more = 0
    for x in (0.1, 0.15, 0.2):
        episode = episode_at(exact, k, standing(env, xy=(x, 0.0), z=0.2))
        forward = episode.controller._replace(stride=jnp.array([1.0, 0.0]))
        episode = change_episode(episode, controller=forward)
        below, around = env._terrain_at_feet(episode)
        where = (
            np.asarray(env.landing_points(episode))[:, None] + np.array(tg.samples.ring_offsets()) + [x, 0.0]
        )
        ahead = terrains.exact_height(exact.terrain(k), cell_centres(env.bank, where)).max(axis=1)
        here = np.asarray(around).max(axis=1)
        rise = np.maximum(np.maximum(here, ahead), 0)
        assert rise.min() == 0
        swing = tg.path.leg_phases(np.asarray(episode.controller.phase)) > 0
        more += (ahead > here + 0.05)[swing].sum()
        lift = np.asarray(episode.controller.lift)
        expected = -(np.maximum(lift - rise - exact.config.rewards.lift_threshold, 0) * swing).mean()
        terms = env._reward_terms(episode, change_episode(episode, lift_off=np.zeros(4)), below, around)
        np.testing.assert_allclose(terms["height"], expected, atol=1e-6)
    assert more and rise.max() > 0.05


def test_metrics_name_every_term(exact):
    names = {name[7:] for name in exact.env.metric_names if name.startswith("reward/")}
    weights = {field.name for field in dataclasses.fields(rewards.RewardConfig)}
    assert names <= weights


# Another robot ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_go1_size_stands_and_walks_with_two_planes_a_foot():
    """One compiled program for both: the second robot, and contact with tread and riser at once."""
    robot = envs.RobotConfig(name="go1_size")
    subject = Subject(config(randomised=False, robot=robot, num_planes=2))
    assert subject.env.observation_size == {"state": 188, "privileged_state": 232}
    floor = subject.env.bank.floor[0]
    state = change(subject.state, qpos=standing(subject.env), command=np.zeros(2), terrain=0, floor=floor)
    for _ in range(40):
        state = subject.step(state, ZERO)
    episode = state.pipeline_state
    assert tg.frames.up_in_trunk(episode.qpos[3:7])[2] > 0.99
    assert episode.qpos[2] == pytest.approx(subject.env.robot.standing_height, abs=0.01)
    state = change(state, command=np.array([1.0, 0.0]))
    along = []
    for _ in range(40):
        state = subject.step(state, ZERO)
        assert state.done == 0
        along.append(float(state.pipeline_state.qpos[0]))
    assert along[39] - along[23] > 0.02  # once it has swung back with the first step
    assert all(np.isfinite(leaf).all() for leaf in leaves(state))
