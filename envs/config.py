"""Configuration of the environment."""

import dataclasses

from envs.robot import RobotConfig
from rewards import RewardConfig
from terrains import TerrainConfig
from tg import TGConfig

EVALUATION_ITERATIONS = 4
"""Newton iterations with which the solver has converged on this robot."""

METHODS = ("ours", "fixed_height", "blind")
"""The paper's method and its two baselines."""

DYNAMICS = ("tree", "mjx")
"""Implementations of the physics substep."""


@dataclasses.dataclass(frozen=True)
class RandomisationConfig:
    """What differs from episode to episode; a range of zero width switches a part off."""

    enabled: bool = True
    """False switches everything here off."""
    friction: tuple[float, float] = (0.5, 1.2)
    """Friction between foot and terrain."""
    payload: tuple[float, float] = (-0.5, 1.0)
    """Mass added to the trunk (kg)."""
    gain: tuple[float, float] = (0.9, 1.1)
    """Factor on kp, and another on kd."""
    latency: tuple[float, float] = (0.0, 0.010)
    """Age of the desired joint angles when the motors follow them (s), in whole physics substeps."""
    push_speed: float = 0.3
    """Largest change of the trunk's horizontal speed by a push (m/s)."""
    push_interval: float = 4.0
    """Mean time between pushes (s)."""
    joint_position_noise: float = 0.01
    """Standard deviation (rad)."""
    joint_velocity_noise: float = 0.3
    """Standard deviation (rad/s)."""
    tilt_noise: float = 0.01
    """Standard deviation of roll and pitch (rad)."""
    angular_velocity_noise: float = 0.1
    """Standard deviation (rad/s)."""
    height_noise: float = 0.005
    """Standard deviation of each height sample (m)."""
    height_drift: float = 0.01
    """Largest offset of all heights in an episode, in z (m)."""
    map_drift: float = 0.01
    """Largest offset of the map in an episode, in x and in y (m)."""


@dataclasses.dataclass(frozen=True)
class CurriculumConfig:
    """The ladder an environment climbs: how hard the terrain is, and how deep a foot can fall, at each level."""

    enabled: bool = True
    """False: levels are drawn evenly from the whole ladder."""
    difficulty: tuple[float, ...] = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    """Difficulty of the terrain at each level."""
    depth: tuple[float, ...] = (0.02, 0.04, 0.08, 0.15, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5)
    """Depth of the pits for the feet at each level (m); what is seen and what is rewarded is always the true map."""
    start: int = 2
    """Environments start at levels 0..start."""
    up: float = 0.7
    """A level up when the robot got this share of the distance that v_l and the episode's length allow."""
    down: float = 0.35
    """A level down below this share."""
    leap: int = 1
    """How many levels up at once. Only one episode in three counts, and one that succeeds is the longest: with
    thousands of environments a ladder climbed rung by rung takes most of a run."""
    practice: float = 0.5
    """Share of the episodes that practise footholds: on terrain of any difficulty whose pits are `practice_depth` deep.
    A misstep there costs the foot-terrain reward but no fall, so there is much to learn from each episode. They don't
    count for the ladder nor for the figures of training. None where the terrain has no pits."""
    practice_depth: float = 0.02
    """Depth of the pits in those episodes (m)."""
    revisit: float = 0.2
    """Share of the episodes on a level drawn from those below, so that nothing is forgotten."""


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """The environment: robot, terrain, controller, rewards, and how an episode runs."""

    method: str = "ours"
    """ours, fixed_height (TG with vertical motion of one height only) or blind (no height samples)."""
    robot: RobotConfig = dataclasses.field(default_factory=RobotConfig)
    """The robot."""
    terrain: TerrainConfig = dataclasses.field(default_factory=TerrainConfig)
    """The terrain."""
    tg: TGConfig = dataclasses.field(default_factory=TGConfig)
    """The trajectory generator."""
    rewards: RewardConfig = dataclasses.field(default_factory=RewardConfig)
    """The reward."""
    randomisation: RandomisationConfig = dataclasses.field(default_factory=RandomisationConfig)
    """Domain randomisation."""
    curriculum: CurriculumConfig = dataclasses.field(default_factory=CurriculumConfig)
    """The terrain curriculum."""
    control_dt: float = 0.02
    """Control period (s): the policy runs at 50 Hz."""
    physics_dt: float = 0.005
    """Physics timestep (s)."""
    dynamics: str = "tree"
    """tree (the substep written for a trunk with four legs) or mjx (the same by MJX, which also computes what the
    former doesn't cover, such as `robot.joint_friction`)."""
    solver_iterations: int = 2
    """Newton iterations of the constraint solver. With one, a robot on blocks falls where it would not
    (docs/physics.md); evaluation takes `EVALUATION_ITERATIONS`."""
    num_planes: int = 1
    """Terrain surfaces a foot can touch at once: 1, or 2 (tread and riser)."""
    episode_time: float = 10.0
    """Longest episode (s)."""
    stand_share: float = 0.05
    """Share of the episodes that command standing."""
    straight_share: float = 0.0
    """Share of the episodes that command walking straight ahead or straight back; the others any direction."""
    stop_share: float = 0.2
    """Share of the others in which the robot is told once, at a random time, to stand for a while."""
    stop_time: tuple[float, float] = (1.0, 3.0)
    """For how long (s)."""
    spawn_yaw: float = 3.1416
    """Heading at the start, uniform in ± this (rad)."""
    spawn_offset: float = 0.1
    """Position on the start platform, uniform in ± this in x and in y (m)."""
    end_in_gap: bool = True
    """End the episode when a foot is `gap_depth` deep in a gap, before the fall that would follow."""
    gap_depth: float = 0.05
    """Depth of a foot's lowest point below the terrain around it at which that happens (m)."""
    min_up: float = 0.5
    """A fall: the cosine of the trunk's tilt goes below this."""
    knee_radius: float = 0.02
    """The knees hit the terrain when they come this near (m)."""
    knee_contact: bool = False
    """A knee that hits the terrain pushes against it, as a foot does, and the robot goes on; else that ends the episode
    as a fall does. In MuJoCo C thighs and shanks touch it, too."""
