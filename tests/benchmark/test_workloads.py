"""The benchmark's own ground: a city whose tiles fit, requests that repeat, figures that are what they say."""

from itertools import islice

import numpy as np
import pytest

from planner.airspace import OccupancyRule
from planner.cfa_star import Planner
from planner.experiments.traffic import Od
from tests.benchmark import bench, measuring, workloads
from tests.benchmark.graph_libraries import network_of
from tests.benchmark.measuring import Run
from tests.planner.drawing import drawn
from tests.planner.traffic import TIMES


def test_the_citys_tiles_are_the_shipped_airspace_and_meet_their_own_mirror_image() -> None:
    tile, city = workloads.astana(), workloads.city()
    assert city.grid.dimensions == (1200, 1200, 3)
    assert (city.grid.block_side_m, city.grid.block_height_m) == (20.0, 40.0)
    one = tile.occupied.reshape(3, 100, 100)
    tiles = city.occupied.reshape(3, 12, 100, 12, 100)
    for row in range(12):
        for column in range(12):
            rows, columns = slice(None, None, 1 - 2 * (row % 2)), slice(None, None, 1 - 2 * (column % 2))
            assert np.array_equal(tiles[:, row, :, column], one[:, rows, columns])


@pytest.mark.parametrize("od", Od)
def test_random_requests_are_the_same_again_and_can_all_be_planned(od: Od) -> None:
    planner = Planner(workloads.astana())

    def first(seed: int) -> list[tuple[int, int, int, int]]:
        requests = islice(workloads.random_requests(planner, od, 300.0, seed), 1100)
        return [(one.origin, one.destination, one.earliest_departure_ms, one.performance.times[1]) for one in requests]

    assert first(1) == first(1)
    assert first(1) != first(2)
    assert len(set(first(1))) == 1100
    for origin, destination, _, _ in first(1):
        planner.check(origin, destination)


def test_files_hold_as_many_requests_as_they_are_called_after_and_the_papers_blocked_blocks() -> None:
    for name in workloads.FILES:
        workload = workloads.from_file(name)
        assert len(workload.requests) == int(name.partition("_")[2])
        assert workload.airspace.occupied_per_layer == [3925, 1286, 189]


def test_figures_are_the_medians_of_what_each_run_has_by_itself() -> None:
    runs = [Run(seconds=[0.001, 0.002, 0.003]), Run(seconds=[0.004, 0.004, 0.010]), Run(seconds=[0.0, 0.005, 1.0])]
    assert measuring.percentiles_ms(runs, 50, 100) == pytest.approx([4.0, 10.0])
    assert measuring.sum_s(runs) == pytest.approx(0.018)


def test_a_network_has_the_links_that_buildings_leave_open_and_times_a_chain_of_them() -> None:
    drawing = drawn("A.#\n..B", rule=OccupancyRule.CONTAINMENT)
    network = network_of(drawing.airspace)
    links = set(zip(network.tail.tolist(), network.head.tolist(), strict=True))
    # Blocks 3 4 # over 0 1 2: the diagonal from 2 to 4 would cut the building.
    assert links == {pair for one, other in [(0, 1), (1, 2), (0, 3), (1, 4), (3, 4), (0, 4), (1, 3)]
                     for pair in ((one, other), (other, one))}  # fmt: skip
    path = [drawing["A"], 1, drawing["B"]]
    assert network.time_along(path, TIMES) == TIMES.diagonal + TIMES.horizontal
    with pytest.raises(KeyError):
        network.time_along([2, 4], TIMES)


def test_an_unknown_part_is_refused_with_those_that_there_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["bench", "speed"])
    with pytest.raises(SystemExit):
        bench.main()
    assert "unknown part 'speed'; there are intents, committed, city, peers" in capsys.readouterr().err
