"""Aircraft types and the speed model (paper 2.3).

Steady flight at full power P with drag e·v². Cruise gives P = e·vh³, the vertical climb P = (m·g + e·vv²)·vv;
along a link of elevation φ the speed is the root v of e·v³ + m·g·sin φ·v = P.
"""

import math
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from planner.errors import AircraftProfileError

GRAVITY_MPS2 = 9.81  # as the paper uses it: its Inspire 2 has m·g·vv = 202.479 W
# Far outside any multirotor, and near enough that the model's cubes neither overflow nor vanish.
_SMALLEST, _LARGEST = 0.001, 1_000_000.0
LINK_KINDS = ("horizontal", "vertical", "alpha", "beta")


@dataclass(frozen=True)
class LinkSpeeds:
    """Full-power speeds in m/s along the four elevations of an AirMatrix's links.

    `alpha` is the tilt over a block's side (the steeper one), `beta` the tilt over its diagonal.
    """

    horizontal: float
    vertical: float
    alpha: float
    beta: float


@dataclass(frozen=True)
class AircraftType:
    """A multirotor's profile. `endurance_s` None means no limit; `link_speed_overrides` replace the model's."""

    id: str
    name: str
    mass_kg: float
    max_vertical_speed_mps: float
    max_horizontal_speed_mps: float
    speed_factor: float = 0.6
    endurance_s: float | None = None
    link_speed_overrides: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        numbers = {
            "mass_kg": self.mass_kg,
            "max_vertical_speed_mps": self.max_vertical_speed_mps,
            "max_horizontal_speed_mps": self.max_horizontal_speed_mps,
            "speed_factor": self.speed_factor,
            **({} if self.endurance_s is None else {"endurance_s": self.endurance_s}),
            **{f"link_speeds_mps.{kind}": speed for kind, speed in self.link_speed_overrides.items()},
        }
        for name, value in numbers.items():
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            if not is_number or not _SMALLEST <= value <= _LARGEST:
                raise AircraftProfileError(
                    f"aircraft {self.id!r}: {name} must be a number from {_SMALLEST} to {_LARGEST:.0f}, not {value!r}"
                )
        if self.speed_factor > 1:
            raise AircraftProfileError(f"aircraft {self.id!r}: speed_factor must be at most 1")
        if unknown := set(self.link_speed_overrides) - set(LINK_KINDS):
            raise AircraftProfileError(
                f"aircraft {self.id!r}: unknown link speeds {sorted(unknown)}; known: {LINK_KINDS}"
            )
        if self.max_vertical_speed_mps >= self.max_horizontal_speed_mps:
            raise AircraftProfileError(
                f"aircraft {self.id!r}: the speed model needs max_horizontal_speed_mps > max_vertical_speed_mps"
            )

    @property
    def drag_constant(self) -> float:
        """The model's e in kg/m."""
        vv, vh = self.max_vertical_speed_mps, self.max_horizontal_speed_mps
        return self.mass_kg * GRAVITY_MPS2 * vv / (vh**3 - vv**3)

    @property
    def max_power_w(self) -> float:
        """The model's P_max in watts."""
        return self.drag_constant * self.max_horizontal_speed_mps**3

    def full_power_speed(self, elevation_rad: float) -> float:
        """Return the speed in m/s along a climb of this elevation (0 to π/2) at full power.

        Newton's iteration from the cruise speed: the cubic is convex and rising for v > 0 and not negative
        there, so the iteration falls monotonically to the root.
        """
        e, power = self.drag_constant, self.max_power_w
        weight = self.mass_kg * GRAVITY_MPS2 * math.sin(elevation_rad)
        speed = self.max_horizontal_speed_mps
        while True:
            step = (e * speed**3 + weight * speed - power) / (3 * e * speed**2 + weight)
            speed -= step
            if step <= 1e-12 * speed:
                return speed

    def link_speeds(self, block_side_m: float, block_height_m: float) -> LinkSpeeds:
        """Return full-power speeds along the links of blocks of this shape; descents use the climb speed."""
        model = {
            "horizontal": self.max_horizontal_speed_mps,
            "vertical": self.max_vertical_speed_mps,
            "alpha": self.full_power_speed(math.atan2(block_height_m, block_side_m)),
            "beta": self.full_power_speed(math.atan2(block_height_m, math.sqrt(2) * block_side_m)),
        }
        return LinkSpeeds(**{**model, **self.link_speed_overrides})


def read_aircraft_types(path: Path) -> tuple[AircraftType, ...]:
    """Read profiles from a TOML file with one ``[[aircraft]]`` table a type.

    Raises
    ------
    AircraftProfileError
        The file is absent, not TOML, or a profile in it is malformed.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise AircraftProfileError(f"cannot read aircraft types from {path}: {error}") from error
    tables = document.get("aircraft")
    if not isinstance(tables, list) or not tables:
        raise AircraftProfileError(f"{path}: expected at least one [[aircraft]] table")
    return tuple(_profile(table, path) for table in tables)


def shipped_aircraft_types() -> tuple[AircraftType, ...]:
    """Return the paper's four aircraft and the Inspire 2."""
    return read_aircraft_types(Path(str(files("planner") / "aircraft_types.toml")))


def merged(*groups: Iterable[AircraftType]) -> dict[str, AircraftType]:
    """Index profiles by id; a later group's profile replaces an earlier one of the same id."""
    return {profile.id: profile for group in groups for profile in group}


def _profile(table: Any, path: Path) -> AircraftType:
    required = ("id", "name", "mass_kg", "max_vertical_speed_mps", "max_horizontal_speed_mps")
    optional = ("speed_factor", "endurance_s", "link_speeds_mps")
    if not isinstance(table, dict):
        raise AircraftProfileError(f"{path}: every [[aircraft]] must be a table")
    label = table.get("id", "without id")
    if missing := [key for key in required if key not in table]:
        raise AircraftProfileError(f"{path}: aircraft {label!r} lacks {', '.join(missing)}")
    if unknown := [key for key in table if key not in (*required, *optional)]:
        raise AircraftProfileError(f"{path}: aircraft {label!r} has unknown fields {', '.join(unknown)}")
    if not all(isinstance(table[key], str) and table[key] for key in ("id", "name")):
        raise AircraftProfileError(f"{path}: aircraft {label!r}: id and name must be non-empty strings")
    overrides = table.get("link_speeds_mps", {})
    if not isinstance(overrides, dict):
        raise AircraftProfileError(f"{path}: aircraft {label!r}: link_speeds_mps must be a table")
    fields = {key: value for key, value in table.items() if key != "link_speeds_mps"}
    return AircraftType(**fields, link_speed_overrides=overrides)
