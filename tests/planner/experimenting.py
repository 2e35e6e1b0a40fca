"""Small studies for the tests of the experiments."""

import functools

from planner.airspace import Airspace, OccupancyRule
from planner.experiments.study import Design, Study, conduct
from tests.planner.drawing import drawn

# A district with a street across, crowded enough for conflicts, near misses, delays and refusals.
DISTRICT = (
    "..##....  ..##..#.  ........  .#..##..  .#..##..  ........  ..#...#.  ..#.....",
    "........  ....#...  ........  .#......  ....#...  ........  ..#.....  ........",
)
DESIGN = Design(flights=90, seeds=(1, 2), sizes=(30, 90), timings=1, windows_min=(5, 7))


def district(rule: OccupancyRule = OccupancyRule.CONTAINMENT, terminal_dwell_ms: int = 0) -> Airspace:
    """Return the district."""
    return drawn(*DISTRICT, rule=rule, terminal_dwell_ms=terminal_dwell_ms).airspace


@functools.cache
def district_study() -> Study:
    """Return the study of the district, conducted once."""
    return conduct(district(), DESIGN)
