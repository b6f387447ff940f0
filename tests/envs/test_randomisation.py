"""What is drawn for an episode, what noise there is, and that each parameter acts on the physics."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
import tg
from envs.env import exact_sensors
from tests.envs.subjects import change, change_episode, standing

KEYS = 4000


def draw(subject, function, count=KEYS, seed=0):
    return jax.jit(jax.vmap(function))(jax.random.split(jax.random.key(seed), count))


def variant(subject, **changes):
    """The environment with another randomisation; compiles nothing."""
    randomisation = dataclasses.replace(subject.config.randomisation, **changes)
    return envs.QuadrupedEnv(
        dataclasses.replace(subject.config, randomisation=randomisation), subject.env.bank
    )


def test_parameters_fill_their_ranges(noisy):
    r = noisy.config.randomisation
    found = draw(noisy, noisy.env._randomise)
    for name, (low, high) in {
        "friction": r.friction,
        "payload": r.payload,
        "kp_factor": r.gain,
        "kd_factor": r.gain,
    }.items():
        values = np.asarray(getattr(found, name))
        assert low <= values.min() < low + 0.01 * (high - low)
        assert high >= values.max() > high - 0.01 * (high - low)
    steps = round(r.latency[1] / noisy.config.physics_dt)
    assert set(np.asarray(found.latency)) == set(range(steps + 1))
    offset = np.abs(np.asarray(found.map_offset)).max(axis=0)
    np.testing.assert_allclose(offset, [r.map_drift, r.map_drift, r.height_drift], rtol=0.01)
    together = np.corrcoef(np.stack([found.friction, found.payload, found.kp_factor, found.kd_factor]))
    assert np.abs(together - np.eye(4)).max() < 0.06


def test_a_range_of_no_width_switches_a_part_off(noisy):
    env = variant(noisy, friction=(0.9, 0.9), payload=(0.0, 0.0), latency=(0.005, 0.005), map_drift=0.0)
    found = draw(noisy, env._randomise, 50)
    np.testing.assert_allclose(found.friction, 0.9)
    np.testing.assert_array_equal(found.payload, 0.0)
    np.testing.assert_array_equal(found.latency, 1)
    np.testing.assert_array_equal(found.map_offset[:, :2], 0.0)


@pytest.mark.slow
def test_disabled_nothing_is_random(exact):
    found = draw(exact, exact.env._randomise, 50)
    np.testing.assert_allclose(found.friction, exact.config.robot.foot_friction)
    for name, value in {"payload": 0, "kp_factor": 1, "kd_factor": 1, "latency": 0, "map_offset": 0}.items():
        np.testing.assert_array_equal(getattr(found, name), value)
    assert not np.asarray(draw(exact, exact.env._push, 2000)).any()
    state = change(exact.state, qpos=standing(exact.env))
    runs = []
    for seed in (0, 1):
        episode = state.pipeline_state.replace(key=jax.random.key(seed))
        runs.append(exact.rollout(state.replace(pipeline_state=episode), 5)[-1])
    np.testing.assert_array_equal(runs[0].pipeline_state.qpos, runs[1].pipeline_state.qpos)
    np.testing.assert_array_equal(runs[0].obs["state"], runs[1].obs["state"])


# Senses -----------------------------------------------------------------------------------------------------------


def test_noise_is_as_large_as_it_says(noisy):
    r = noisy.config.randomisation
    episode = change_episode(noisy.state.pipeline_state, qpos=standing(noisy.env, yaw=0.7))
    found = draw(noisy, lambda key: noisy.env.sense(episode.replace(key=key)))
    clean = exact_sensors(episode)
    for name, deviation in {
        "angular_velocity": r.angular_velocity_noise,
        "joint_position": r.joint_position_noise,
        "joint_velocity": r.joint_velocity_noise,
    }.items():
        error = np.asarray(getattr(found, name) - getattr(clean, name))
        np.testing.assert_allclose(error.std(axis=0), deviation, rtol=0.06)
        np.testing.assert_allclose(error.mean(axis=0), 0, atol=0.06 * deviation)
    # For a level trunk, up = (-pitch, roll, 1): both have the tilt's deviation, and the yaw stays.
    x, y, z, w = (np.asarray(found.orientation)[:, i] for i in (1, 2, 3, 0))
    np.testing.assert_allclose(np.std(2 * (x * z - w * y)), r.tilt_noise, rtol=0.06)
    np.testing.assert_allclose(np.std(2 * (y * z + w * x)), r.tilt_noise, rtol=0.06)
    np.testing.assert_allclose(np.linalg.norm(found.orientation, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(2 * np.arctan2(z, w), 0.7, atol=5e-4)


def test_a_state_is_sensed_once(noisy):
    """The policy's observation and the controller that acts on it have the same noise; the next step's is another."""
    episode = noisy.state.pipeline_state
    once, again = noisy.env.sense(episode), noisy.env.sense(episode)
    np.testing.assert_array_equal(once.joint_position, again.joint_position)
    following = noisy.env.sense(episode.replace(key=jax.random.fold_in(episode.key, 0)))
    assert (np.asarray(once.joint_position) != np.asarray(following.joint_position)).all()


def test_heights_drift_with_the_episode_and_shake_with_the_step(noisy):
    """On level ground, 1 m above: heights below the feet are off by the episode's drift and by noise."""
    r, env = noisy.config.randomisation, noisy.env
    base = change_episode(
        noisy.state.pipeline_state, qpos=standing(env), terrain=0, command=np.array([1.0, 0.0])
    )
    randomised = base.randomised.replace(map_offset=jnp.array([0.0, 0.0, 0.008]))
    episode = base.replace(randomised=randomised)
    seen = draw(noisy, lambda key: env.observe(episode.replace(key=key))["state"][-100:], 500)
    feet = draw(noisy, lambda key: env.core.feet(env.sense(episode.replace(key=key)))[:, 2], 500)
    ground = np.asarray(feet)[:, :, None] - np.asarray(seen).reshape(500, 4, 25) / 5 + episode.qpos[2]
    assert ground.mean() == pytest.approx(0.008, abs=2e-4)
    np.testing.assert_allclose(ground.std(), r.height_noise, rtol=0.03)


def test_a_patch_of_heights_drifts_as_the_map_does(noisy):
    """A robot whose map is off by some centimetres reads what one that stands there reads of a true map."""
    env, yaw, off = noisy.env, 0.7, np.array([0.03, -0.05])
    turned = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ off
    terrain = int(
        np.flatnonzero(np.asarray(env.bank.heights).reshape(env.bank.heights.shape[0], -1).std(axis=1))[0]
    )

    def patch(xy, drift):
        episode = change_episode(
            noisy.state.pipeline_state, qpos=standing(env, xy=xy, yaw=yaw), terrain=terrain
        )
        randomised = episode.randomised.replace(map_offset=jnp.array([*drift, 0.0], jnp.float32))
        episode = episode.replace(randomised=randomised)
        return np.asarray(env._patch(episode, exact_sensors(episode)))

    here, there = (np.array([1.0, 0.8]) + move for move in (0, turned))
    drifted = patch(here, off)
    assert drifted.shape == (4, tg.footholds.COUNT) and drifted.std() > 0.001
    np.testing.assert_allclose(drifted, patch(there, (0.0, 0.0)), atol=2e-3)
    assert np.abs(drifted - patch(here, (0.0, 0.0))).max() > 0.01


# Physics ----------------------------------------------------------------------------------------------------------


def test_pushes_come_as_often_and_as_hard_as_they_should(noisy):
    r = noisy.config.randomisation
    found = np.asarray(draw(noisy, noisy.env._push, 40_000))
    pushed = found.any(axis=1)
    # Every 4 s on average, at 50 steps a second: one step in 200.
    assert pushed.mean() == pytest.approx(0.02 / r.push_interval, rel=0.2)
    assert not found[:, 2:].any()
    assert 0.9 * r.push_speed < np.abs(found).max() <= r.push_speed


def test_a_push_doesnt_show_in_the_noise(noisy, monkeypatch):
    """Push and noise of a step come from different keys: the noise mustn't tell where the push goes."""
    episode = change_episode(noisy.state.pipeline_state, qpos=standing(noisy.env), qvel=np.zeros(18))
    env = variant(noisy, push_interval=0.02)  # at every step
    monkeypatch.setattr(env._tree, "substep", lambda qpos, qvel, warmstart, *_, **__: (qpos, qvel, warmstart))

    def both(key):
        now = episode.replace(key=key)
        return env._simulate(now, now.controller).qvel[:2], env.sense(now).orientation[1:3]

    pushes, tilts = (np.asarray(part) for part in draw(noisy, both, 1000))
    assert np.abs(pushes).max() > 0.29
    together = np.corrcoef(np.concatenate([pushes, tilts], axis=1).T)
    assert np.abs(together - np.eye(4)).max() < 0.12


def in_the_air(subject, **randomised):
    """A robot high up, its joints in motion, with given parameters."""
    rng = np.random.default_rng(4)
    env = subject.env
    qpos = standing(env, z=1.0, joints=env.robot.default_pose + rng.normal(0, 0.2, 12))
    state = change(subject.state, qpos=qpos, qvel=rng.normal(0, 1.0, 18), terrain=0, floor=env.bank.floor[0])
    drawn = {"friction": 0.8, "payload": 0, "kp_factor": 1, "kd_factor": 1, "latency": 0} | randomised
    old = state.pipeline_state.randomised
    new = old.replace(**{k: jnp.asarray(v, getattr(old, k).dtype) for k, v in drawn.items()})
    return change(state, randomised=new)


def stance_share(controller):
    """How much of its damping in stance each joint (12,) has: in a trot LF and RR swing while the phase is positive."""
    phase, gate = float(controller.phase), float(controller.gate)
    up = np.minimum(2 * abs(phase) / np.pi, 2 - 2 * abs(phase) / np.pi)
    height = up**2 * (3 - 2 * up)
    swings = np.array([phase > 0, phase <= 0, phase <= 0, phase > 0])
    return np.repeat(1 - gate * np.minimum(1, 4 * height) * swings, 3)


@pytest.mark.parametrize(
    "randomised",
    [
        {},
        {"payload": 1.0},
        {"payload": -0.5},
        {"kp_factor": 0.9},
        {"kd_factor": 1.1},
        {"latency": 1},
        {"latency": 2},
    ],
    ids=str,
)
def test_a_step_in_the_air_is_mujocos(noisy, randomised):
    """PD law, gains, age of the targets and mass, each substep once more on the host; no contact, no solver."""
    state = in_the_air(noisy, **randomised)
    before = state.pipeline_state
    after = noisy.step(state, jnp.linspace(-1, 1, 14)).pipeline_state
    env, drawn = noisy.env, before.randomised
    model = noisy.env.mj_model
    mass = model.body_mass[env.robot.trunk_id]
    model.body_mass[env.robot.trunk_id] = mass + float(drawn.payload)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = before.qpos, before.qvel
    old, new = np.asarray(before.controller.desired), np.asarray(after.controller.desired)
    damping = [1.0 + stance_share(x.controller) for x in (before, after)]
    for i in range(4):
        late = i < int(drawn.latency)
        wanted = old if late else new
        torque = env.config.robot.kp * float(drawn.kp_factor) * (wanted - data.qpos[7:])
        damped = float(drawn.kd_factor) * damping[0 if late else 1]
        torque -= env.config.robot.kd * damped * data.qvel[6:]
        torque = np.clip(torque, -env.robot.torque_limit, env.robot.torque_limit)
        data.qfrc_applied[6:] = torque
        mujoco.mj_step(model, data)
    model.body_mass[env.robot.trunk_id] = mass
    assert np.abs(old - new).max() > 0.1
    np.testing.assert_allclose(after.qpos, data.qpos, atol=2e-5)
    np.testing.assert_allclose(after.qvel, data.qvel, atol=3e-3)
    np.testing.assert_allclose(after.torque, torque, atol=3e-3)


def test_friction_acts_on_the_feet(noisy):
    """A robot that slides at 1 m/s is slowed down the more the rougher its feet are."""
    speeds = []
    for friction in (0.1, 0.5, 1.2):
        state = in_the_air(noisy, friction=friction)
        qvel = np.zeros(18)
        qvel[0] = 1.0
        state = change(state, qpos=standing(noisy.env), qvel=qvel, command=np.zeros(2))
        for _ in range(5):
            state = noisy.step(state, jnp.zeros(14))
            assert not state.done
        speeds.append(float(state.pipeline_state.qvel[0]))
    # μ g t: at least so much is lost by sliding for 0.1 s at 0.1.
    assert speeds[0] < 1.0 - 0.5 * 0.1 * 9.81 * 0.1
    assert speeds[0] > speeds[1] + 0.05 > speeds[2] + 0.05


def test_payload_presses_the_trunk_down(noisy):
    heights = []
    for payload in (-0.5, 1.0):
        state = in_the_air(noisy, payload=payload)
        state = change(state, qpos=standing(noisy.env), qvel=np.zeros(18), command=np.zeros(2))
        for _ in range(30):
            state = noisy.step(state, jnp.zeros(14))
        heights.append(float(state.pipeline_state.qpos[2]))
    assert heights[0] > heights[1] + 0.001
