"""What the paper prints in its sections 2.3 and 4, to be shown beside what is measured here.

Dai, Pang, Low: Conflict-Free Four-Dimensional Path Planning for Urban Air Mobility Considering Airspace Occupations.
"""

import math
from dataclasses import dataclass

TITLE = "Conflict-Free Four-Dimensional Path Planning for Urban Air Mobility Considering Airspace Occupations"
AUTHORS = "Wei Dai, Bizhao Pang and Kin Huat Low"

BLOCK_SIDE_M = 20.0
BLOCK_HEIGHT_M = 40.0
BLOCKS_PER_LAYER = 10_000
OCCUPIED_PER_LAYER = (3925, 1286, 189)

FLIGHTS = 300
WINDOW_MIN = 5
WINDOWS_MIN = (3, 4, 5, 7, 10)
ASTAR_S = 634.05
CFA_STAR_S = 2246.63
CONFLICTS = 407
LONGEST_FLIGHT_S = 351
# The one inversion that its section 4.3 reports: less delay at 60 flights a minute than at 42.8.
INVERTED_WINDOWS_MIN = (5, 7)


@dataclass(frozen=True)
class PrintedSpeeds:
    """A row of the table of aircraft, m/s: the slower speed is the steeper link's, though the table's head says β."""

    steeper: float
    flatter: float


SPEEDS = {
    "dji-mavic-air": PrintedSpeeds(4.454, 4.860),
    "self-built-drone": PrintedSpeeds(4.295, 4.645),
    "dji-phantom-4": PrintedSpeeds(3.350, 3.664),
    "dji-matrice-600-pro": PrintedSpeeds(5.713, 6.258),
}

# Section 2.3: elevation in degrees -> speed in m/s, drag constant, power.
INSPIRE_2 = "dji-inspire-2"
INSPIRE_2_SPEEDS = {45.0: 7.973, 60.0: 6.682}
INSPIRE_2_DRAG = 0.0115
INSPIRE_2_POWER_W = 202.479

# The three simulations with one type of aircraft each, by their ratio of horizontal to vertical speed.
USE_BY_TYPE = ("dji-mavic-air", "self-built-drone", "dji-phantom-4")


def elevations_deg() -> tuple[float, float]:
    """Return α and β of the paper's blocks: the elevations of the links over a side and over a diagonal."""
    height, side = BLOCK_HEIGHT_M, BLOCK_SIDE_M
    return math.degrees(math.atan2(height, side)), math.degrees(math.atan2(height, math.sqrt(2) * side))
