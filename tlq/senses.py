"""What senses the ground, and how badly: settings that all programs share in which a policy walks in MuJoCo C.

perception=map|lidar|depth drift=0.02 latency=0.05 missing=0.05 range_noise=1

Needs NumPy alone: `tlq.perception` is what these are the settings of.
"""

import dataclasses
from typing import Any

from tlq.cli import option
from tlq.elevation import ElevationConfig

SENSORS = ("lidar", "depth")
KINDS = ("map", *SENSORS)
"""map: the terrain's true heights."""
MOST = {"drift": 1.0, "latency": 1.0, "missing": 1.0, "range_noise": 20.0}
"""Errors that range sensors alone have, and how large they may be."""


@dataclasses.dataclass(frozen=True)
class PerceptionConfig:
    """What senses the ground, and how badly."""

    kind: str = "lidar"
    """lidar or depth."""
    drift: float = 0.02
    """Standard deviation of the error that the pose estimate gains per metre walked, in x, in y and in z (m); a random
    walk, so it grows with the root of the way."""
    latency: float = 0.05
    """Time from a scan to its place in the map (s); scans carry the time at which they were taken."""
    missing: float = 0.05
    """Share of the returns that are lost, at random."""
    range_noise: float = 1.0
    """Standard deviation of ranges, in multiples of the sensor's own."""
    elevation: ElevationConfig = dataclasses.field(default_factory=ElevationConfig)
    """The map."""

    def check(self) -> None:
        """Raises ValueError where a number is out of range."""
        if self.kind not in SENSORS:
            raise ValueError(f"unknown perception '{self.kind}'; choose one of {', '.join(SENSORS)}")
        for name, most in MOST.items():
            if not 0 <= getattr(self, name) <= most:
                raise ValueError(f"{name}={getattr(self, name)} must be in [0, {most:g}]")


@dataclasses.dataclass(frozen=True)
class SensingOptions:
    """What a user may set of it; a program's own options class derives from this one."""

    perception: str = option(
        "map", "map: true heights; else simulated range sensors, in MuJoCo C only", choices=lambda: KINDS
    )
    drift: float = option(
        PerceptionConfig.drift, "error of the pose estimate gained per metre walked (m); lidar and depth only"
    )
    latency: float = option(PerceptionConfig.latency, "of scans (s); lidar and depth only")
    missing: float = option(PerceptionConfig.missing, "share of lost returns; lidar and depth only")
    range_noise: float = option(
        PerceptionConfig.range_noise, "multiple of the sensor's own noise; lidar and depth only"
    )

    def sensing(self) -> PerceptionConfig | None:
        """What senses the ground; None: nothing does, heights are the map's. Raises ValueError on contradictions."""
        errors = {name: getattr(self, name) for name in MOST}
        if self.perception != "map":
            config = PerceptionConfig(kind=self.perception, **errors)
            config.check()
            return config
        for name, value in errors.items():
            if value != getattr(PerceptionConfig, name):
                raise ValueError(f"{name}={value} needs perception=lidar or perception=depth")
        return None


def check_use(sensing: PerceptionConfig | None, policy: Any, name: object) -> None:
    """Raises ValueError where a policy (a `Controller` or a `Policy`) looks at no heights, so needs no sensors."""
    if sensing is not None and not policy.core.heights:
        raise ValueError(
            f"perception={sensing.kind} is of no use to policy={name}, which is blind; choose perception=map"
        )


def described(sensing: PerceptionConfig | None) -> dict[str, Any]:
    """For a report, in JSON."""
    return {"kind": "map"} if sensing is None else dataclasses.asdict(sensing)
