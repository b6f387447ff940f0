"""The environment: a quadruped on a bank of terrains, one instance an environment, pure functions throughout.

Letters: L = 4 legs (LF, RF, LR, RR), J = 12 joints, P = 25 sample points a foot.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from mujoco import mjx

import rewards
import terrains
import tg
from envs import physics
from envs.config import DYNAMICS, METHODS, EnvConfig
from envs.dynamics import TreeDynamics, not_covered
from envs.limits import check_limits
from envs.robot import ROBOTS, Robot
from envs.types import Episode, Randomised

GOAL = 5.0
"""Distance (m) at which the paper stops counting."""


class QuadrupedEnv(Env):
    """`reset` and `step` of one environment; `jax.vmap` for batches. `step` never resets, see `AutoReset`.

    Observation: `state` (S,), what the robot can know, and `privileged_state` (V,), for the critic.
    Action: (14,) in [-1, 1]: δf, δh, residual joint angles.
    """

    def __init__(self, config: EnvConfig, bank: terrains.Bank | None = None):
        check(config)
        self.config = config
        self.bank = make_bank(config) if bank is None else bank
        knees = config.knee_radius if config.knee_contact else 0.0
        self.mj_model, self.robot = physics.physics_model(
            config.robot, config.physics_dt, config.num_planes, knees
        )
        self.core = make_core(config, self.robot)
        self.standing = physics.settle(self.mj_model, self.robot, self.core.standing_target)
        self.substeps = round(config.control_dt / config.physics_dt)
        self.episode_steps = round(config.episode_time / config.control_dt)
        self.levels = len(config.curriculum.difficulty)
        self._model = mjx.put_model(self.mj_model)
        self._data = mjx.make_data(self._model)
        self._planes = physics.plane_ids(self.mj_model, config.num_planes)
        self._spheres = physics.sphere_ids(self.mj_model)
        self._tree = self._make_tree()
        self._near = tg.samples.within(config.rewards.terrain_ring, config.tg.sample_radius)
        self._instances, self._counts = self._by_kind()

    # -- Brax's interface

    @property
    def observation_size(self) -> dict[str, int]:
        """Sizes of the parts of the observation."""
        return {"state": self.core.observation_size, "privileged_state": self.privileged_size}

    @property
    def action_size(self) -> int:
        """14."""
        return tg.ACTION_SIZE

    @property
    def backend(self) -> str:
        """Physics engine."""
        return "mjx"

    @property
    def dt(self) -> float:
        """Control period (s)."""
        return self.config.control_dt

    @property
    def privileged_size(self) -> int:
        """V: the observation, 100 true heights where the policy is blind, and 44 more (see `_privileged`)."""
        return self.core.observation_size + (0 if self.core.heights else 100) + 44

    @property
    def has_pits(self) -> bool:
        """Whether some of its terrain has gaps that a foot must not step into."""
        return bool(np.any(np.asarray(self.bank.floor) < -self.config.rewards.gap_threshold))

    def reset(self, key: jax.Array) -> State:
        """A robot standing on the start platform of a random terrain, with a random command.

        Args:
          key: random key.
        """
        key, key_level = jax.random.split(key)
        top = self.config.curriculum.start + 1 if self.config.curriculum.enabled else self.levels
        level = jax.random.randint(key_level, (), 0, min(top, self.levels))
        episode = self.begin(key, level)
        zero = jnp.zeros(())
        metrics = dict.fromkeys(self.metric_names, zero) | {"level": self._share(level)}
        info = {"truncation": zero, "level": level}
        return State(episode, self.observe(episode), zero, zero, metrics, info)

    def step(self, state: State, action: jax.Array) -> State:
        """One control step (`control_dt`).

        Args:
          state: of `reset` or `step`.
          action: (14,) in [-1, 1].
        """
        state = self.advance(state, action)
        return state.replace(obs=self.observe(state.pipeline_state))

    # -- the parts of a step, which `AutoReset` puts together in another way

    @property
    def metric_names(self) -> tuple[str, ...]:
        """Names in `state.metrics`."""
        terms = (
            "along",
            "across",
            "smooth",
            "energy",
            "terrain",
            "aim",
            "height",
            "yaw",
            "heading",
            "tilt",
            *(name for name in ("heave", "knee") if getattr(self.config.rewards, name)),
        )
        ends = ("ended", "distance", "length", "fell", "level", "exploded")
        kinds = (f"{part}/{kind}" for kind in self.mixture for part in ("share", "level"))
        return (
            *(f"reward/{t}" for t in terms),
            *(f"episode/{e}" for e in ends),
            *kinds,
            "speed",
            "lift",
            "level",
        )

    @functools.cached_property
    def mixture(self) -> dict[str, int]:
        """Kinds of terrain in its bank, with their `Bank.kind_id`; empty where there is but one."""
        ids = sorted({int(i) for i in np.asarray(self.bank.kind_id)})
        return {self.bank.kinds[i]: i for i in ids} if len(ids) > 1 else {}

    def begin(self, key: jax.Array, level: jax.Array, terrain: jax.Array | None = None) -> Episode:
        """A new episode on a level () int32 of the ladder.

        Args:
          key: random key.
          level: of the ladder, () int32.
          terrain: () int32, an instance of the bank whose kind the new one is to be of, too. A level says little about
            another kind: a robot that climbs high blocks may fall on the easiest stones. None: any kind.
        """
        c = self.config
        keys = iter(jax.random.split(key, 11))
        level, place, practice = self._draw_terrain([next(keys) for _ in range(5)], level, terrain)
        xy = jax.random.uniform(next(keys), (2,), minval=-1.0, maxval=1.0) * c.spawn_offset
        yaw, angle = jax.random.uniform(next(keys), (2,), minval=-1.0, maxval=1.0) * jnp.array(
            [c.spawn_yaw, jnp.pi]
        )
        # At ±π/2 every foot is in the middle of its step: fading in the stride pushes the robot neither way.
        phase = jnp.where(jax.random.bernoulli(next(keys)), 0.5, -0.5) * jnp.float32(jnp.pi)
        walk = jax.random.uniform(next(keys)) >= c.stand_share
        if c.straight_share:
            angle = self._draw_straight(jax.random.fold_in(key, 13), yaw, angle)
        command = jnp.where(walk, jnp.stack([jnp.cos(angle), jnp.sin(angle)]), 0.0)
        ground = terrains.height(self.bank, place, xy)
        qpos = jnp.asarray(self.standing, jnp.float32)
        # Yaw times the settled pitch.
        (w, _, y, _), cos, sin = self.standing[3:7], jnp.cos(yaw / 2), jnp.sin(yaw / 2)
        turned = jnp.stack([cos * w, -sin * y, cos * y, sin * w])
        qpos = qpos.at[:2].set(xy).at[2].add(ground).at[3:7].set(turned)
        depth = jnp.asarray(c.curriculum.depth, jnp.float32)[level]
        depth = jnp.where(practice, c.curriculum.practice_depth, depth)
        return Episode(
            qpos=qpos,
            qvel=jnp.zeros(18),
            warmstart=jnp.zeros(18),
            torque=jnp.zeros(12),
            controller=self.core.initial_state(phase),
            terrain=place,
            level=level,
            practice=practice,
            floor=jnp.maximum(self.bank.floor[place], -depth),
            command=command,
            stop=self._draw_stop(jax.random.fold_in(key, 12)),
            origin=xy,
            heading=yaw,
            progress=jnp.zeros(()),
            lift_off=jnp.zeros(4) + ground,
            step=jnp.int32(0),
            randomised=self._randomise(next(keys)),
            key=next(keys),
        )

    def _draw_straight(self, key: jax.Array, yaw: jax.Array, angle: jax.Array) -> jax.Array:
        """A direction () rad, or in `straight_share` of the episodes that of the nose or against it, yaw () rad."""
        straight, back = jax.random.uniform(key, (2,))
        ahead = yaw + jnp.where(back < 0.5, 0.0, jnp.float32(jnp.pi))
        return jnp.where(straight < self.config.straight_share, ahead, angle)

    def _draw_stop(self, key: jax.Array) -> jax.Array:
        """`Episode.stop`: (0, 0) in most episodes."""
        c = self.config
        stops, start, time = jax.random.uniform(key, (3,))
        first = start * c.episode_time
        last = first + c.stop_time[0] + (c.stop_time[1] - c.stop_time[0]) * time
        steps = jnp.int32(jnp.clip(jnp.stack([first, last]) / c.control_dt, 0.0, 1e9))
        return jnp.where(stops < c.stop_share, steps, 0)

    def _by_kind(self) -> tuple[np.ndarray, np.ndarray]:
        """Instances (N + 1, levels, M) int32 of the bank by kind id and level of the ladder; how many (N + 1, levels).

        Last those of any kind, which also stand in where there is none of a kind on a level.
        """
        instance, kind = np.arange(self.bank.num_terrains), np.asarray(self.bank.kind_id)

        def fitting(k: int, level: int) -> np.ndarray:
            same = instance % self.levels == level
            # The last choice is for a bank of fewer terrains than levels.
            choices = (same & (kind == k), same, instance == level % self.bank.num_terrains)
            return next(np.flatnonzero(choice) for choice in choices if choice.any())

        kinds = range(len(self.bank.kinds) + 1)  # no terrain's kind is the last number
        lists = [[fitting(k, level) for level in range(self.levels)] for k in kinds]
        counts = np.array([[len(found) for found in row] for row in lists], np.int32)
        return np.array(
            [[np.resize(found, counts.max()) for found in row] for row in lists], np.int32
        ), counts

    def _draw_terrain(
        self, keys: list[jax.Array], level: jax.Array, like: jax.Array | None
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Level, instance in the bank and whether footholds are practised, from the level of the ladder; each ()."""
        c = self.config.curriculum
        lower = jax.random.randint(keys[0], (), 0, jnp.maximum(level, 1))
        level = jnp.where(jax.random.uniform(keys[1]) < c.revisit, lower, level)
        practised = jax.random.randint(keys[2], (), 0, self.levels)
        kind = len(self.bank.kinds) if like is None else self.bank.kind_id[like]

        def place(level: jax.Array) -> jax.Array:
            row = jax.random.randint(keys[3], (), 0, jnp.asarray(self._counts)[kind, level])
            return jnp.asarray(self._instances)[kind, level, row]

        pit = self.bank.floor[place(practised)] < -self.config.rewards.gap_threshold
        practice = c.enabled & pit & (jax.random.uniform(keys[4]) < c.practice)
        level = jnp.where(practice, practised, level)
        return level, place(level), practice

    def advance(self, state: State, action: jax.Array) -> State:
        """`step` without the observation."""
        before: Episode = state.pipeline_state
        sensors, command = self.sense(before), self.heading_command(before)
        patch = self._patch(before, sensors) if self.core.config.refine else None
        controller, desired = self.core.act(before.controller, action, sensors, command, patch)
        after = self._simulate(before, controller)
        after = after.replace(controller=controller, step=before.step + 1)
        below, around = self._terrain_at_feet(after)
        after = after.replace(
            # fmax: where the physics exploded, what was reached before stays.
            progress=jnp.fmax(before.progress, (after.qpos[:2] - after.origin) @ after.command),
            lift_off=jnp.where(self.core.phases(controller.phase) > 0, before.lift_off, around[:, 0]),
        )
        terms = self._reward_terms(before, after, below, around)
        reward, weighted = rewards.total(self.config.rewards, terms)

        finite = jnp.all(jnp.isfinite(after.qpos)) & jnp.all(jnp.isfinite(after.qvel))
        exploded = ~finite | (jnp.max(jnp.abs(after.qvel)) > 200.0)
        fell = self._fell(after, below, around) | exploded
        over = (after.step >= self.episode_steps) | (after.progress >= GOAL) | self._off_map(after)
        truncated = over & ~fell
        done = over | fell
        reward = jnp.where(exploded, 0.0, reward)
        ends = {
            "ended": 1.0,
            "distance": jnp.clip(after.progress, 0.0, GOAL),
            "length": after.step,
            "fell": fell,
            "level": self._share(state.info["level"]),
            "exploded": exploded,
        }
        metrics = {f"reward/{name}": jnp.where(exploded, 0.0, value) for name, value in weighted.items()}
        metrics |= {
            f"episode/{name}": jnp.where(done & ~before.practice, jnp.float32(value), 0.0)
            for name, value in ends.items()
        }
        metrics |= {
            "speed": jnp.where(exploded, 0.0, after.qvel[:2] @ after.command),
            "lift": jnp.mean(controller.lift),
            "level": self._share(state.info["level"]),
        }
        for name, number in self.mixture.items():
            share = jnp.float32(self.bank.kind_id[after.terrain] == number)
            metrics |= {f"share/{name}": share, f"level/{name}": share * metrics["level"]}
        return state.replace(
            pipeline_state=after,
            reward=reward,
            done=done.astype(jnp.float32),
            metrics=state.metrics | metrics,
            info=state.info | {"truncation": truncated.astype(jnp.float32)},
        )

    def next_level(self, episode: Episode, level: jax.Array, fell: jax.Array) -> jax.Array:
        """The ladder's level () after an ended episode: up when the robot got far, down when it didn't."""
        c = self.config.curriculum
        if not c.enabled:
            return level
        reachable = min(self.config.rewards.speed_low * self.config.episode_time, GOAL)
        walked = jnp.sum(jnp.square(episode.command)) > 0.5
        counts = walked & ~episode.practice & (episode.level == level)  # not what was revisited
        up = counts & ~fell & (episode.progress > c.up * reachable)
        down = counts & (episode.progress < c.down * reachable)
        return jnp.clip(level + c.leap * up.astype(jnp.int32) - down.astype(jnp.int32), 0, self.levels - 1)

    # -- senses

    def heading_command(self, episode: Episode) -> jax.Array:
        """The command (2,) in the heading frame, 0 while the robot is told to stand."""
        return tg.frames.turn(-tg.frames.yaw(episode.qpos[3:7]), self.told(episode))

    def told(self, episode: Episode) -> jax.Array:
        """The command (2,) in the world, 0 while the robot is told to stand."""
        first, last = episode.stop
        return jnp.where((episode.step >= first) & (episode.step < last), 0.0, episode.command)

    def stepping(self, episode: Episode) -> jax.Array:
        """Whether feet in swing move, () bool: `Core`'s."""
        return self.core.stepping(episode.controller, self.told(episode))

    def sense(self, episode: Episode) -> tg.Sensors:
        """What the robot measures, with noise; the same at every call on the same episode."""
        r = self.config.randomisation
        clean = exact_sensors(episode)
        if not r.enabled:
            return clean
        noise = jax.random.normal(jax.random.fold_in(episode.key, 1), (30,))
        # Half angles about x and y turn the quaternion by the tilt error.
        roll, pitch = 0.5 * r.tilt_noise * noise[0], 0.5 * r.tilt_noise * noise[1]
        w, x, y, z = clean.orientation
        turned = jnp.stack(
            [
                w - x * roll - y * pitch,
                x + w * roll - z * pitch,
                y + w * pitch + z * roll,
                z + x * pitch - y * roll,
            ]
        )
        return tg.Sensors(
            turned / jnp.linalg.norm(turned),
            clean.angular_velocity + r.angular_velocity_noise * noise[2:5],
            clean.joint_position + r.joint_position_noise * noise[5:17],
            clean.joint_velocity + r.joint_velocity_noise * noise[17:29],
        )

    def observe(self, episode: Episode) -> dict[str, jax.Array]:
        """The observations of policy and critic."""
        sensors, command = self.sense(episode), self.heading_command(episode)
        points = self.core.around(self.core.centres(episode.controller, sensors))
        true = seen = self._heights(episode, points)
        if self.config.randomisation.enabled and self.core.heights:
            offset = episode.randomised.map_offset
            noise = jax.random.normal(jax.random.fold_in(episode.key, 2), seen.shape)
            seen = self._heights(episode, points + offset[:2]) + offset[2]
            seen = seen + self.config.randomisation.height_noise * noise
        state = self.core.observe(episode.controller, sensors, seen if self.core.heights else None, command)
        return {"state": state, "privileged_state": self._privileged(episode, state, true, command)}

    def _patch(self, episode: Episode, sensors: tg.Sensors) -> jax.Array:
        """Heights (L, N) m of the patches of `tg.footholds` as the robot perceives them.

        Drifted like the samples. The noise of single heights is left out: what counts is which are in a gap.
        """
        points = self.core.patch(self.core.centres(episode.controller, sensors))
        if self.config.randomisation.enabled:
            points = points + episode.randomised.map_offset[:2]
        return self._heights(episode, points)

    def _heights(self, episode: Episode, points: jax.Array) -> jax.Array:
        """Terrain heights (...) m from the trunk's centre, at points (..., 2) m of the heading frame."""
        world = episode.qpos[:2] + tg.frames.turn(tg.frames.yaw(episode.qpos[3:7]), points)
        return terrains.height(self.bank, episode.terrain, world) - episode.qpos[2]

    def _privileged(
        self, episode: Episode, state: jax.Array, true: jax.Array, command: jax.Array
    ) -> jax.Array:
        """The critic's observation: the policy's, 100 heights where it has none, and 44 values it can't know."""
        r, mirror = episode.randomised, self.core.update_mirror(episode.controller.mirror, command)
        side = jnp.stack([jnp.ones_like(mirror), mirror])
        velocity = self.velocity(episode)
        below = self.core.feet(exact_sensors(episode))[:, 2] - true[:, 0]
        order = jnp.where(mirror > 0, jnp.arange(4), jnp.array([1, 0, 3, 2]))
        # How much of each circle round a foot is a gap: what the foot is about to earn, put plainly.
        low = jnp.max(true, axis=1, keepdims=True) - true > self.config.rewards.gap_threshold
        gaps = jnp.stack(
            [
                *(jnp.mean(low[:, r], axis=1) for r in tg.samples.circles()),
                self._aim(episode, true + episode.qpos[2], self._terrain_ahead(episode)),
            ],
            axis=1,
        )
        rest = jnp.concatenate(
            [
                velocity * side,
                episode.qvel[2:3],
                10.0 * jnp.clip(below[order] - self.robot.foot_radius, -0.1, 0.1),
                episode.controller.lift[order] * 10.0,
                episode.qpos[2:3] - jnp.mean(true[:, 0] + episode.qpos[2]),
                jnp.stack(
                    [
                        r.friction,
                        r.payload,
                        10.0 * (r.kp_factor - 1.0),
                        10.0 * (r.kd_factor - 1.0),
                        r.latency.astype(jnp.float32),
                        10.0 * jnp.maximum(episode.floor, -0.2),
                        self._share(episode.level),
                        episode.progress,
                        episode.step / self.episode_steps,
                        episode.controller.gate,
                    ]
                ),
                episode.controller.stride * side,
                gaps[order].reshape(-1),
            ]
        )
        parts = [state, rest]
        if not self.core.heights:
            seen = 5.0 * jnp.clip(below[:, None] + true[:, :1] - true, -0.25, 0.25)
            mirrored = seen[order][:, jnp.array(tg.samples.mirrored_points())]
            parts.append(jnp.where(mirror > 0, seen, mirrored).reshape(-1))
        return jnp.concatenate(parts)

    # -- physics

    def _simulate(self, episode: Episode, controller: tg.ControllerState) -> Episode:
        """Physics over one control period, joints under PD control by the controller's new state."""
        c, r = self.config, episode.randomised
        contact = functools.partial(
            terrains.contact, self.bank, episode.terrain, floor=episode.floor, num_planes=c.num_planes
        )
        # Not `split`: its second key is fold_in(key, 1), which is the sensors' noise.
        key, key_push = jax.random.fold_in(episode.key, 0), jax.random.fold_in(episode.key, 4)
        substep = self._substep(r, contact)
        kp, kd = c.robot.kp * r.kp_factor, c.robot.kd * r.kd_factor
        damping, damped_before = (kd * self.core.damping(x) for x in (controller, episode.controller))
        limit = self.robot.torque_limit

        def one(carry, i):
            qpos, qvel, warmstart, _ = carry
            late = i < r.latency
            followed = jnp.where(late, episode.controller.desired, controller.desired)
            damped = jnp.where(late, damped_before, damping)
            torque = jnp.clip(kp * (followed - qpos[7:]) - damped * qvel[6:], -limit, limit)
            force = jnp.concatenate([jnp.zeros(6), torque])
            return (*substep(qpos, qvel, warmstart, force), torque), None

        start = (episode.qpos, episode.qvel + self._push(key_push), episode.warmstart, episode.torque)
        (qpos, qvel, warmstart, torque), _ = jax.lax.scan(one, start, jnp.arange(self.substeps))
        return episode.replace(qpos=qpos, qvel=qvel, warmstart=warmstart, torque=torque, key=key)

    def _make_tree(self) -> TreeDynamics | None:
        """The substep for this robot alone, None where MJX is wanted or has to do."""
        if self.config.dynamics == "mjx" or not_covered(self.mj_model, self._planes, self._spheres):
            return None
        return TreeDynamics(self.mj_model, self._planes, self._spheres)

    def _substep(self, r: Randomised, contact: physics.Contact) -> Callable[..., tuple[jax.Array, ...]]:
        """A timestep as a function of qpos, qvel, warmstart and generalised force that returns the first three."""
        iterations, model = self.config.solver_iterations, self._model
        drawn = self.config.randomisation.enabled
        if self._tree is not None:
            payload, friction = (r.payload, r.friction) if drawn else (0.0, None)
            return functools.partial(
                self._tree.substep, contact=contact, iterations=iterations, payload=payload, friction=friction
            )
        if drawn:
            model = model.replace(
                body_mass=model.body_mass.at[self.robot.trunk_id].add(r.payload),
                pair_friction=model.pair_friction.at[:, :2].set(r.friction),
            )

        def substep(
            qpos: jax.Array, qvel: jax.Array, warmstart: jax.Array, qfrc: jax.Array
        ) -> tuple[jax.Array, ...]:
            data = self._data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
            data = physics.substep(model, data, self._planes, self._spheres, contact, qfrc, iterations)
            return data.qpos, data.qvel, data.qacc_warmstart

        return substep

    def _push(self, key: jax.Array) -> jax.Array:
        """A change of velocity (18,), zero at most steps."""
        r = self.config.randomisation
        if not r.enabled or r.push_speed == 0.0:
            return jnp.zeros(18)
        draw = jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0)
        pushed = jnp.abs(draw[2]) < self.config.control_dt / r.push_interval
        return jnp.zeros(18).at[:2].set(jnp.where(pushed, r.push_speed * draw[:2], 0.0))

    def _randomise(self, key: jax.Array) -> Randomised:
        r = self.config.randomisation
        u = jax.random.uniform(key, (8,))

        def between(limits: tuple[float, float], u: jax.Array, default: float) -> jax.Array:
            return limits[0] + (limits[1] - limits[0]) * u if r.enabled else jnp.float32(default)

        drift = jnp.array([r.map_drift, r.map_drift, r.height_drift]) * float(r.enabled)
        return Randomised(
            friction=between(r.friction, u[0], self.config.robot.foot_friction),
            payload=between(r.payload, u[1], 0.0),
            kp_factor=between(r.gain, u[2], 1.0),
            kd_factor=between(r.gain, u[3], 1.0),
            latency=jnp.round(between(r.latency, u[4], 0.0) / self.config.physics_dt).astype(jnp.int32),
            map_offset=drift * (2.0 * u[5:8] - 1.0),
        )

    # -- judgement

    def _terrain_at_feet(self, episode: Episode) -> tuple[jax.Array, jax.Array]:
        """z_ij (L, P) m, foot height minus terrain height; terrain heights (L, P) m in the world."""
        feet = self.core.feet(exact_sensors(episode))
        heights = self._heights(episode, self.core.around(feet))
        return feet[:, 2:] - heights, heights + episode.qpos[2]

    def _reward_terms(
        self, before: Episode, after: Episode, below: jax.Array, around: jax.Array
    ) -> dict[str, jax.Array]:
        c = self.config.rewards
        there = self._terrain_ahead(after)
        step = rewards.Step(
            velocity=after.qvel[:2],
            angular_velocity=after.qvel[3:6],
            command=self.told(before),
            desired=after.controller.desired,
            previous=before.controller.desired,
            energy=rewards.energy(after.torque, after.qvel[6:], literal=c.literal),
            swing=(self.core.phases(after.controller.phase) > 0)
            & self.core.stepping(after.controller, self.told(before)),
            near=below[:, self._near],
            highest=jnp.min(below, axis=1),
            lift=after.controller.lift,
            rise=jnp.maximum(
                jnp.maximum(jnp.max(around, axis=1), jnp.max(there, axis=1)) - after.lift_off, 0.0
            ),
            drift=tg.frames.yaw(after.qpos[3:7]) - after.heading,
        )
        terms = rewards.step_terms(c, step) | {"aim": jnp.mean(self._aim(after, around, there))}
        if c.knee:
            _, knees = self._clearance(after)
            terms["knee"] = jnp.mean(rewards.knee(knees, c.knee_margin))
        if c.heave:
            terms["heave"] = -jnp.square(after.qvel[2])
        return terms

    def landing_points(self, episode: Episode) -> jax.Array:
        """Where the feet (L, 2) m in swing will come down, from the trunk's centre, heading frame: `Core`'s, exact."""
        return self.core.landing_points(episode.controller, exact_sensors(episode), self.velocity(episode))

    def step_ends(self, episode: Episode) -> jax.Array:
        """Where the trajectory generator leads the feet (L, 2) m in swing, in the same frame: `Core`'s, exact."""
        return self.core.step_ends(episode.controller, exact_sensors(episode), self.velocity(episode))

    def velocity(self, episode: Episode) -> jax.Array:
        """The trunk's (2,) m/s, heading frame."""
        return tg.frames.turn(-tg.frames.yaw(episode.qpos[3:7]), episode.qvel[:2])

    def _terrain_ahead(self, episode: Episode) -> jax.Array:
        """Terrain heights (L, P) m in the world, round the places where feet in swing will come down."""
        return self._heights(episode, self.core.around(self.landing_points(episode))) + episode.qpos[2]

    def _aim(self, episode: Episode, around: jax.Array, there: jax.Array) -> jax.Array:
        """Minus the share (L,) of low points where a foot in swing will come down; 0 in stance.

        Args:
          episode: what is judged.
          around: (L, P) m, terrain heights round the feet, world.
          there: (L, P) m, and where those in swing will come down.
        """
        there = there[:, self._near]
        highest = jnp.maximum(jnp.max(around, axis=1), jnp.max(there, axis=1))
        swing = self.core.phases(episode.controller.phase) > 0
        swing &= self.stepping(episode)
        return rewards.terrain(swing, -there, -highest, self.config.rewards.gap_threshold, graded=True)

    def _fell(self, episode: Episode, below: jax.Array, around: jax.Array) -> jax.Array:
        """Whether trunk or (unless those push it) a knee hits the terrain, the trunk tilts too far, or a foot is in a
        gap.
        """
        c = self.config
        trunk, knees = self._clearance(episode)
        hit = jnp.any(trunk < 0)
        if not c.knee_contact:
            hit |= jnp.any(knees < 0)
        fell = hit | (tg.frames.rotation(episode.qpos[3:7])[2, 2] < c.min_up)
        if c.end_in_gap:
            top = jnp.max(around, axis=1)
            over_gap = top - around[:, 0] > c.rewards.gap_threshold
            low = below[:, 0] + around[:, 0] - self.robot.foot_radius < top - c.gap_depth
            fell |= jnp.any(over_gap & low)
        return fell

    def _clearance(self, episode: Episode) -> tuple[jax.Array, jax.Array]:
        """Heights (m) over the terrain of the trunk's points (N,), and of the knees (L,) less their radius."""
        rotation = tg.frames.rotation(episode.qpos[3:7])
        trunk = self.robot.trunk_points @ rotation.T
        knees = self._knees(episode) @ rotation.T
        points = jnp.concatenate([trunk, knees]) + episode.qpos[:3]
        ground = jnp.maximum(terrains.height(self.bank, episode.terrain, points[:, :2]), episode.floor)
        above = points[:, 2] - ground
        return above[:-4], above[-4:] - self.config.knee_radius

    def _knees(self, episode: Episode) -> jax.Array:
        """Knees (L, 3) m in the trunk's frame."""
        thigh_only = self.core.geometry._replace(shank=np.zeros(4, np.float32))
        return self.core.geometry.hip_position + tg.leg.forward(thigh_only, episode.qpos[7:].reshape(4, 3))

    def _off_map(self, episode: Episode) -> jax.Array:
        return jnp.max(jnp.abs(episode.qpos[:2])) > self.bank.half_extent - 0.15

    def _share(self, level: jax.Array) -> jax.Array:
        return level / max(self.levels - 1, 1)


def exact_sensors(episode: Episode) -> tg.Sensors:
    """What the robot would measure without noise."""
    return tg.Sensors(episode.qpos[3:7], episode.qvel[3:6], episode.qpos[7:], episode.qvel[6:])


def check(config: EnvConfig) -> None:
    """Raises ValueError on a configuration that makes no sense."""
    if config.method not in METHODS:
        raise ValueError(f"unknown method '{config.method}'; choose one of {', '.join(METHODS)}")
    gait, share = config.tg.gait, config.tg.swing_share
    if gait not in tg.path.GAITS:
        raise ValueError(f"unknown gait '{gait}'; choose one of {', '.join(tg.path.GAITS)}")
    if share > tg.path.LONGEST_SWING[gait]:
        longest = tg.path.LONGEST_SWING[gait]
        raise ValueError(f"tg.swing_share={share} must be at most {longest} with tg.gait={gait}")
    if config.dynamics not in DYNAMICS:
        raise ValueError(f"unknown dynamics '{config.dynamics}'; choose one of {', '.join(DYNAMICS)}")
    check_limits(config)
    ratio = config.control_dt / config.physics_dt
    if abs(ratio - round(ratio)) > 1e-6 or ratio < 1:
        raise ValueError(
            f"control_dt={config.control_dt} must be a whole multiple of physics_dt={config.physics_dt}"
        )
    if config.tg.refine:
        if config.method == "blind":
            raise ValueError(f"tg.refine={config.tg.refine} needs heights; set it to 0 with method=blind")
        if config.tg.follow or not config.tg.look_ahead:
            raise ValueError(f"tg.refine={config.tg.refine} needs tg.look_ahead=true and tg.follow=false")
    if config.knee_contact and config.knee_radius == 0:
        raise ValueError("knee_radius=0 must be above 0 with knee_contact=true")
    if len(config.curriculum.difficulty) != len(config.curriculum.depth) or not config.curriculum.depth:
        raise ValueError(
            "curriculum.difficulty and curriculum.depth must have the same number of levels, at least 1"
        )
    if config.terrain.kind not in terrains.kinds():
        raise ValueError(
            f"unknown terrain '{config.terrain.kind}'; choose one of {', '.join(terrains.kinds())}"
        )
    if not config.robot.file.path and config.robot.name not in ROBOTS:
        raise ValueError(f"unknown robot '{config.robot.name}'; choose one of {', '.join(sorted(ROBOTS))}")


def make_bank(config: EnvConfig) -> terrains.Bank:
    """The bank of the configured terrain, instance k at level k % levels of the curriculum's ladder."""
    t = config.terrain
    return terrains.make_bank(t.kind, t.num_terrains, t.seed, config.curriculum.difficulty, t)


def make_core(config: EnvConfig, robot: Robot) -> tg.Core:
    """The controller core of a robot; the method decides what the TG may do and what the policy sees."""
    settings = config.tg
    if config.method == "fixed_height":
        # Lee et al. 2020: the TG moves the feet up and down by a fixed height, the residuals do the rest.
        settings = dataclasses.replace(settings, step_length=0.0, lift_range=0.0)
    f32 = functools.partial(np.asarray, dtype=np.float32)
    shape = (robot.hip_position, robot.hip_offset, robot.thigh, robot.shank, robot.joint_sign[0])
    geometry = tg.LegGeometry(*map(f32, shape))
    return tg.Core(
        settings,
        geometry,
        base_foot=f32(robot.base_foot),
        default_pose=f32(robot.default_pose),
        lower=f32(robot.joint_lower),
        upper=f32(robot.joint_upper),
        dt=config.control_dt,
        sag=float(robot.mass * 9.81 / config.robot.kp),
        slack=config.robot.kd / config.robot.kp,
        heights=config.method != "blind",
    )
