"""Static A* by graph libraries that need not be installed, each with the best admissible heuristic that it takes."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec

import numpy as np

from planner.airmatrix import IntArray
from planner.airspace import Airspace
from planner.links import LINK_COUNT, LinkTimes, build_offsets
from planner.occupancy import open_links
from tests.reference.safe_interval import lattice_table

# From an origin to a destination: a chain of blocks.
FindPath = Callable[[int, int], Sequence[int]]


@dataclass(frozen=True, eq=False)
class Network:
    """The open links of an airspace: `tail`, `head` and the number of the link, each (links,)."""

    airspace: Airspace
    tail: IntArray
    head: IntArray
    link: IntArray

    def time_along(self, path: Sequence[int], times: LinkTimes) -> int:
        """Return an aircraft's time along a chain of blocks in ms; raises `KeyError` where no open link leads on."""
        return sum(int(times.time[self._links[pair]]) for pair in itertools.pairwise(path))

    @cached_property
    def _links(self) -> dict[tuple[int, int], int]:
        pairs = zip(self.tail.tolist(), self.head.tolist(), strict=True)
        return dict(zip(pairs, self.link.tolist(), strict=True))


def network_of(airspace: Airspace) -> Network:
    """Return an airspace's open links."""
    tail, link = np.nonzero(open_links(airspace)[:, np.newaxis] >> np.arange(LINK_COUNT) & 1)
    return Network(airspace, tail, tail + build_offsets(airspace.grid)[link], link)


def is_installed(library: str) -> bool:
    """Tell whether a library can be used."""
    return find_spec(_MODULES[library]) is not None


def w9_pathfinding(network: Network, aircraft: Sequence[LinkTimes]) -> list[FindPath]:
    """Return w9-pathfinding's A* for each aircraft: C++, the straight distance as its heuristic.

    Its two-sided A* and its Dijkstras are slower here. Coordinates are scaled to times so that no link is shorter than
    straight: by the level link, and by what any climb needs upwards at least.
    """
    envs, finders = import_module("w9_pathfinding.envs"), import_module("w9_pathfinding.pf")
    grid = network.airspace.grid
    ijk = grid.ijk(np.arange(grid.block_count))

    def prepared(times: LinkTimes) -> FindPath:
        level = min(times.horizontal, times.diagonal / math.sqrt(2))
        up = min(
            float(times.vertical),
            math.sqrt(max(times.alpha**2 - level**2, 0)),
            math.sqrt(max(times.beta**2 - 2 * level**2, 0)),
        )
        # Shortened by more than floating point can add.
        coordinates = ijk * np.array([level, level, up]) * (1 - 1e-9)
        edges = np.stack([network.tail, network.head, times.time[network.link]], axis=1)
        graph = envs.Graph(grid.block_count, directed=True, edges=edges.tolist(), coordinates=coordinates.tolist())
        find_path: FindPath = finders.AStar(graph).find_path
        return find_path

    return [prepared(times) for times in aircraft]


def rustworkx(network: Network, aircraft: Sequence[LinkTimes]) -> list[FindPath]:
    """Return rustworkx's A* for each aircraft: Rust, calling Python for costs and for the lattice distance."""
    library = import_module("rustworkx")
    grid = network.airspace.grid

    def prepared(times: LinkTimes) -> FindPath:
        blocks = [grid.block(block) for block in range(grid.block_count)]
        graph = library.PyDiGraph(multigraph=False)
        graph.add_nodes_from(blocks)
        costs = times.time[network.link].astype(np.float64)
        graph.add_edges_from(list(zip(network.tail.tolist(), network.head.tolist(), costs.tolist(), strict=True)))
        table = lattice_table(network.airspace, times)

        def find_path(origin: int, destination: int) -> Sequence[int]:
            i, j, k = goal = blocks[destination]
            path: Sequence[int] = library.digraph_astar_shortest_path(
                graph,
                origin,
                goal.__eq__,
                float,
                lambda block: float(table[abs(block[2] - k)][abs(block[1] - j)][abs(block[0] - i)]),
            )
            return path

        return find_path

    return [prepared(times) for times in aircraft]


def networkx(network: Network, aircraft: Sequence[LinkTimes]) -> list[FindPath]:
    """Return networkx's A* for each aircraft: Python, with the lattice distance."""
    library = import_module("networkx")
    grid = network.airspace.grid
    blocks = [grid.block(block) for block in range(grid.block_count)]
    graph = library.DiGraph()
    costs = [times.time[network.link].tolist() for times in aircraft]
    # One graph with a weight for each aircraft: as many graphs would take gigabytes.
    for tail, head, *weights in zip(network.tail.tolist(), network.head.tolist(), *costs, strict=True):
        graph.add_edge(tail, head, **{str(number): weight for number, weight in enumerate(weights)})

    def prepared(number: int, times: LinkTimes) -> FindPath:
        table = lattice_table(network.airspace, times)

        def heuristic(block: int, destination: int) -> int:
            (i, j, k), (i_D, j_D, k_D) = blocks[block], blocks[destination]
            return table[abs(k - k_D)][abs(j - j_D)][abs(i - i_D)]

        def find_path(origin: int, destination: int) -> Sequence[int]:
            path: Sequence[int] = library.astar_path(graph, origin, destination, heuristic, weight=str(number))
            return path

        return find_path

    return [prepared(number, times) for number, times in enumerate(aircraft)]


LIBRARIES: dict[str, Callable[[Network, Sequence[LinkTimes]], list[FindPath]]] = {
    "w9-pathfinding": w9_pathfinding,
    "rustworkx": rustworkx,
    "networkx": networkx,
}
_MODULES = {"w9-pathfinding": "w9_pathfinding", "rustworkx": "rustworkx", "networkx": "networkx"}
