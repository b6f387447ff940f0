"""Configuration of the reward."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class RewardConfig:
    """Weights and thresholds of the reward terms; the paper gives none of them."""

    speed_low: float = 0.35
    """v_l, the lowest speed along the command that earns the full reward (m/s)."""
    speed_high: float = 0.7
    """v_h, the highest (m/s)."""
    along: float = 1.0
    """Weight of r_v."""
    across: float = 0.5
    """Weight of r_vo."""
    smooth: float = 0.2
    """Weight of r_smooth."""
    energy: float = 0.0005
    """Weight of r_tau (1/W)."""
    terrain: float = 3.0
    """Weight of r_terrain (mean over the feet)."""
    aim: float = 3.0
    """Weight of r_terrain for the feet in swing, where they will come down (mean over the feet). Not in the paper: a
    foot in stance can't be moved any more, this pays for moving it while it can."""
    height: float = 1.0
    """Weight of r_height (1/m, mean over the feet)."""
    yaw: float = 0.1
    """Weight of the squared yaw rate (s²/rad²). The paper commands a yaw rate of 0 but has no term for it."""
    heading: float = 1.0
    """Weight of 1 - cos(drift of the heading since the start). The paper commands no turning; a penalty on the yaw rate
    alone leaves a slow drift, which adds up to radians over 5 m."""
    tilt: float = 0.2
    """Weight of the squared roll and pitch rates (s²/rad²), scaled by 0.1; not in the paper."""
    heave: float = 0.0
    """Weight of the trunk's squared vertical velocity (s²/m²); not in the paper. 0 leaves the term away."""
    knee: float = 0.0
    """Weight of knees that come near the terrain (mean over the legs), -1 where one hits it; not in the paper. 0 leaves
    the term away. On high stairs most falls are knees that hit the edge of the next step."""
    knee_margin: float = 0.06
    """Clearance of a knee below which that costs (m)."""
    literal: bool = False
    """The paper's own forms: r_v exponential, r_tau signed, all terms added. False: r_v linear below v_l, so that it
    pays for every bit of motion, and r_vo and r_smooth multiplied with it, so that standing earns nothing."""
    gap_threshold: float = 0.25
    """H_thre: terrain this far below the foot is a gap (m). Above the rise of a stair, below the depth of a gap."""
    terrain_ring: float = 0.03
    """Radius of the largest circle of samples that r_terrain looks at (m)."""
    terrain_graded: bool = True
    """r_terrain by the share of low sample points; False: -1 as soon as one of them is low (the paper)."""
    lift_threshold: float = 0.01
    """F_thre: the height a foot may be lifted beyond what the terrain asks for (m)."""
