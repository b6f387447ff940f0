"""Configuration of the trajectory generator (TG)."""

import dataclasses

BEFORE = {
    "look_ahead": False,
    "retraction": 0.0,
    "finish_step": False,
    "look_ahead_from": 0.0,
    "follow": False,
    "sample_radius": 0.1,
    "lead": 0.0,
    "refine": 0.0,
    "touch_down": 0.0,
    "stance_damping": 1.0,
    "swing_share": 0.5,
    "gait": "trot",
}
"""Settings of policies from before there was such a setting."""


@dataclasses.dataclass(frozen=True)
class TGConfig:
    """Sizes of the trajectory generator and scales of the action.

    The paper gives none of these numbers; the defaults follow public work by the same authors and were tuned by
    training (docs/experiments.md).
    """

    base_frequency: float = 2.0
    """f_base, gait cycles per second at action 0 (Hz)."""
    frequency_range: float = 0.5
    """δf at action ±1 (Hz)."""
    gait: str = "trot"
    """trot (the paper's: diagonal legs together) or walk (one after the other, three feet down; with a `swing_share` of
    at most 0.24)."""
    swing_share: float = 0.5
    """Share of the gait cycle that a leg is in swing. The paper's is 0.5; below it all feet are down for a while
    between the two pairs' swings, and the trunk can be brought back to level."""
    step_length: float = 0.16
    """L, the stride from lift-off to touch-down (m). 0 leaves only the vertical motion (the fixed-height baseline)."""
    retraction: float = 1.0
    """Share of swing-leg retraction: 1 lets feet come down and lift off with the ground's speed, 0 with the trunk's, as
    in the paper."""
    lift: float = 0.08
    """H, the predefined foot height (m)."""
    lift_range: float = 0.1
    """δh at action ±1 (m). 0 fixes the foot height."""
    lift_min: float = 0.02
    """Lower bound of H + δh (m)."""
    lift_max: float = 0.18
    """Upper bound of H + δh (m): higher than this the knee limit is reached, for a robot that stands 0.33 m high."""
    residual_range: float = 0.4
    """Residual joint angle at action ±1 (rad): a foot can be moved by 11 cm, half the distance between thin poles."""
    levelling: float = 1.0
    """Share of the trunk's roll and pitch that is taken out of the feet's base positions. 1 is the paper's horizontal
    frame: the feet stay straight below the hips, but the stance legs no longer turn the trunk back to level. The
    motion of the feet along their path is horizontal in any case."""
    weight_compensation: float = 1.0
    """Share of the joints' sag under the robot's weight that is added to the desired angles of the stance legs
    (torque / kp). The paper's PID controller has no gains; a plain PD at kp 50 sags by 4 cm on two legs, which also
    moves the feet 4 cm in front of the hips."""
    start_time: float = 0.2
    """Time in which the TG's motion is faded in from standing, and out to standing (s)."""
    mirror: bool = True
    """Let the policy see a command to the right as its mirror image to the left: halves what it has to learn."""
    mirror_hysteresis: float = 0.15
    """The mirror flips when the command's lateral part passes this far to the other side."""
    look_ahead: bool = True
    """Sample the terrain round the place where a foot in swing ends its step; false: round the foot, as the paper
    does, so that the policy sees a foothold only when the foot is nearly there."""
    look_ahead_from: float = -0.8
    """Phase (rad) of a leg from which on it looks ahead: a little before it lifts off, when the foot height is chosen
    that holds for the whole swing; 0: from lift-off on."""
    follow: bool = True
    """With `look_ahead`, sample the terrain round the place to which trajectory generator and residual joint angles
    together lead a foot, so that the policy sees the ground there closely; false: round the end of the trajectory
    generator's step."""
    sample_radius: float = 0.1
    """Radius of the outer circle of height samples (m). In the middle of a gap twice as wide all samples are low, and
    say nothing of where the ground is."""
    lead: float = 0.0
    """Time (s) by which feet are ahead on their way along the step, to make up for joints that follow late, at
    `base_frequency`. Their height isn't ahead: feet that come down early are nearer to where they were led."""
    refine: float = 0.0
    """Largest distance (m) along each axis by which the controller shifts where a foot in swing is led, off the gaps
    near there, by a dense patch of heights round the end of its step; 0: the policy alone says where. See
    `tg.footholds`."""
    touch_down: float = 0.0
    """Share of the trunk's rise, fall and tilt that is taken out of the height of feet in swing: 1 leads them to the
    height of the feet in stance, so that they come down when the step ends, whatever the trunk does; 0, as in the
    paper, to a height below their hips."""
    stance_damping: float = 3.0
    """Factor on the derivative gain of the joints of legs in stance. The trunk bounces on its two legs' springs at
    little more than the gait's frequency; more damping in stance calms it, and in swing feet would follow late. The
    walking itself isn't braked: what that takes is added to the desired angles."""
    finish_step: bool = True
    """When told to stand, let feet in swing come down at the end of their step, and all feet stay there; false: the
    gait fades out where it is, and the feet come down, or are drawn, to below the hips."""
