"""What a robot in a simulation sees, wants and earns: sample points, paths of the feet, reward terms.

World frame, SI units. Letters: L = 4 legs (LF, RF, LR, RR), P = 25 sample points a foot.
"""

import jax
import numpy as np

import rewards
import tg
from tlq.simulation import Simulation


def sample_points(sim: Simulation) -> np.ndarray:
    """The terrain's points (L, P, 3) m that the policy sees, as high as it sees them."""
    points, heights = sim.points[:, : tg.samples.COUNT], sim.heights[:, : tg.samples.COUNT, None]
    flat = sim.data.qpos[:2] + tg.frames.turn(np.asarray(sim.yaw), points)
    return np.concatenate([flat, sim.data.qpos[2] + heights], axis=-1)


def measured_cells(sim: Simulation, reach: float) -> np.ndarray:
    """What the elevation map holds within `reach` (m) of the robot: centres and heights (C, 3) m of the cells that were
    measured, from the robot's true place; none where heights are the terrain's own.
    """
    return np.zeros((0, 3)) if sim.perception is None else sim.perception.measured(sim.data, reach)


def feet(sim: Simulation) -> np.ndarray:
    """Where the feet's centres (L, 3) m are."""
    geometry = sim.controller.core.geometry
    return _world(sim, tg.leg.forward(geometry, sim.exact_sensors().joint_position.reshape(4, 3)))


def desired_feet(sim: Simulation) -> np.ndarray:
    """Where the last step wanted the feet's centres (L, 3) m: trajectory generator and residual joint angles.

    The joints' share of the weight isn't in it: it is there so that a foot gets where it is wanted.
    """
    return _world(sim, sim.controller.state.targets[0].reshape(4, 3))


def foot_paths(sim: Simulation, count: int = 24) -> np.ndarray:
    """The closed paths (L, count, 3) m that the trajectory generator would lead the feet along, as it is set now."""
    core, state, sensors = sim.controller.core, sim.controller.state, sim.exact_sensors()
    lift = state.lift * state.gate
    phases = np.linspace(-np.pi, np.pi, count, dtype=np.float32)
    targets = [core.foot_targets(np.full(4, p), lift, state.stride, sensors) for p in phases]
    return _world(sim, np.stack(targets)).swapaxes(0, 1)


def _world(sim: Simulation, targets: np.ndarray) -> np.ndarray:
    """Points (..., L, 3) m from the abduction joints, trunk frame, in the world."""
    rotation = tg.frames.rotation(sim.data.qpos[3:7])
    return sim.data.qpos[:3] + (sim.controller.core.geometry.hip_position + targets) @ rotation.T


class RewardMeter:
    """The reward that training would give for each control step, term by term, weighted.

    Two differences from `QuadrupedEnv`: `energy` is the mean power over the step, not that of its last moment, and
    `aim` is left out, since it needs the state of a training episode.
    """

    def __init__(self, sim: Simulation):
        self.reset(sim)
        self(sim, np.zeros(2), 0.0)  # compiles, so that the first step isn't late

    def reset(self, sim: Simulation) -> None:
        """To be called when the robot starts anew."""
        self._lift_off = sim.moment().ground[:, 0]
        self._desired = sim.controller.state.desired
        self._heading = sim.yaw

    def __call__(self, sim: Simulation, command: np.ndarray, work: float) -> dict[str, float]:
        """What the last control step earned.

        Args:
          sim: after the step.
          command: (2,) unit vector in the world, or 0 to stand.
          work: sum of |torque x speed| over the step (J).
        """
        state, moment = sim.controller.state, sim.moment()
        self._lift_off = np.where(moment.phases > 0, self._lift_off, moment.ground[:, 0])
        config = sim.config.rewards
        below = moment.feet[:, None] - moment.ground
        step = rewards.Step(
            velocity=sim.data.qvel[:2],
            angular_velocity=sim.data.qvel[3:6],
            command=command,
            desired=state.desired,
            previous=self._desired,
            energy=-work / sim.controller.control_dt,
            swing=(moment.phases > 0) & sim.controller.core.stepping(state, command),
            near=below[:, tg.samples.within(config.terrain_ring, sim.controller.core.config.sample_radius)],
            highest=below.min(axis=1),
            lift=state.lift,
            rise=np.maximum(moment.ground.max(axis=1) - self._lift_off, 0.0),
            drift=sim.yaw - self._heading,
        )
        self._desired = state.desired
        return {name: float(value) for name, value in jax.device_get(_compiled(config, step)).items()}


def weighted_terms(config: rewards.RewardConfig, step: rewards.Step) -> dict[str, jax.Array]:
    """Each term () as it enters the reward, and their `total`."""
    total, weighted = rewards.total(config, rewards.step_terms(config, step))
    return weighted | {"total": total}


_compiled = jax.jit(weighted_terms, static_argnums=0)
"""Once for each configuration: op by op it would cost as much as the simulation."""
