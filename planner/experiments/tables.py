"""The study's numbers as CSV: a header and a row an entry, blocks as i, j, k, times in seconds."""

import csv
import io
from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

from planner.experiments.findings import AltitudeUse, LayerUse, altitude_uses, layer_uses, performance_of
from planner.experiments.simulation import Run
from planner.experiments.study import NearMiss, Study, Trade, Trial, UseByType

Cell = str | int | float | None
T = TypeVar("T")


def all_tables(study: Study) -> dict[str, str]:
    """Return every table by its file name."""
    return {
        "flights.csv": _flights(study),
        "density.csv": _density(study),
        "searches.csv": _searches(study),
        "near_misses.csv": _near_misses(study),
        "layers.csv": _layers(study),
        "altitude.csv": _altitude(study),
        "aircraft.csv": _aircraft(study),
    }


def _table(entries: Iterable[T], columns: Mapping[str, Callable[[T], Cell]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([cell(entry) for cell in columns.values()] for entry in entries)
    return text.getvalue()


def _flights(study: Study) -> str:
    """The reference traffic flight by flight, by every search."""
    reference, grid = study.reference, study.airspace.grid
    flights, astar = reference.astar.flights, reference.astar
    cases = {comparison.number: comparison.case.value for comparison in reference.comparisons}
    columns: dict[str, Callable[[int], Cell]] = {
        "flight": lambda number: number + 1,
        "aircraft": lambda number: flights[number].aircraft,
        "origin": lambda number: " ".join(map(str, grid.block(flights[number].origin))),
        "destination": lambda number: " ".join(map(str, grid.block(flights[number].destination))),
        "departure_s": lambda number: flights[number].departure_ms / 1000,
        "astar_s": lambda number: None if (plan := astar.plans[number]) is None else plan.flight_time_ms / 1000,
        "without_traffic_computing_ms": lambda number: round(1000 * float(reference.without_traffic_s[number]), 4),
        "astar_computing_ms": lambda number: _ms(astar, number),
        "safe_interval_alone_computing_ms": lambda number: _ms(reference.safe_interval_alone, number),
        "astar_conflicts": lambda number: int(reference.conflicts[number]),
        "astar_whole_second_conflicts": lambda number: int(reference.whole_second_conflicts[number]),
        "case": cases.get,
    }
    for name, run in (
        ("greedy", reference.greedy),
        ("safe_interval", reference.safe_interval),
        ("containment", reference.containment),
    ):
        columns |= _outcome(name, run)
    return _table(range(len(flights)), columns)


def _outcome(name: str, run: Run) -> dict[str, Callable[[int], Cell]]:
    """Return the columns of what became of flights in one run."""
    return {
        f"{name}_delay_s": lambda number: None if (plan := run.plans[number]) is None else plan.delay_ms / 1000,
        f"{name}_hold_s": lambda number: None if (plan := run.plans[number]) is None else plan.ground_hold_ms / 1000,
        f"{name}_hover_s": lambda number: None if (plan := run.plans[number]) is None else plan.hover_ms / 1000,
        f"{name}_refused": lambda number: run.refusals[number],
        f"{name}_computing_ms": lambda number: _ms(run, number),
    }


def _ms(run: Run, number: int) -> float:
    return round(1000 * float(run.seconds[number]), 4)


def _density(study: Study) -> str:
    """Every seed and window."""
    columns: dict[str, Callable[[Trial], Cell]] = {
        "window_min": lambda trial: trial.window_min,
        "flights_a_minute": lambda trial: round(study.design.flights / trial.window_min, 3),
        "seed": lambda trial: trial.seed,
        "astar_conflicts": lambda trial: trial.conflicts,
        "astar_whole_second_conflicts": lambda trial: trial.whole_second_conflicts,
        "greedy_delay_s": lambda trial: round(trial.delay_s, 3),
        "greedy_refused": lambda trial: trial.refused,
        "greedy_pairs_too_near": lambda trial: trial.too_near,
        "diagonal_links": lambda trial: trial.corner_cuts.diagonal,
        "corner_cuts": lambda trial: trial.corner_cuts.cut,
        "containment_delay_s": lambda trial: round(trial.containment_delay_s, 3),
        "containment_refused": lambda trial: trial.containment_refused,
        "containment_pairs_too_near": lambda trial: trial.containment_too_near,
    }
    return _table(study.trials, columns)


def _searches(study: Study) -> str:
    """Every size of traffic, rule and search."""
    columns: dict[str, Callable[[Trade], Cell]] = {
        "od": lambda trade: trade.od.value,
        "flights": lambda trade: trade.flights,
        "rule": lambda trade: trade.rule.value,
        "search": lambda trade: trade.search.value,
        "accepted": lambda trade: trade.accepted,
        "refused": lambda trade: trade.refused.total(),
        "reasons": lambda trade: " ".join(f"{reason}:{count}" for reason, count in sorted(trade.refused.items())),
        "delay_s": lambda trade: round(trade.delay_s, 3),
        "mean_delay_s": lambda trade: round(trade.mean_delay_s, 4),
        "longest_delay_s": lambda trade: trade.longest_delay_s,
        "computing_s": lambda trade: round(trade.computing_s, 4),
        "expansions": lambda trade: trade.expansions,
        "pairs": lambda trade: trade.verdict.pairs,
        "pairs_too_near": lambda trade: len(trade.verdict.too_near),
        "closest_m": lambda trade: None if (near := trade.verdict.closest) is None else round(near.horizontal_m, 3),
    }
    return _table(study.trades, columns)


def _near_misses(study: Study) -> str:
    """Pairs nearer than a block by greedy CFA* under the midpoint rule, the least separated first."""
    columns: dict[str, Callable[[NearMiss], Cell]] = {
        "first_flight": lambda miss: miss.flights[0] + 1,
        "second_flight": lambda miss: miss.flights[1] + 1,
        "time_s": lambda miss: miss.encounter.time_ms / 1000,
        "separation_blocks": lambda miss: round(miss.encounter.separation, 6),
        "horizontal_m": lambda miss: round(miss.encounter.horizontal_m, 3),
        "vertical_m": lambda miss: round(miss.encounter.vertical_m, 3),
    }
    return _table(study.reference.near_misses, columns)


def _layers(study: Study) -> str:
    """The use of each layer: by all types of aircraft as in the reference, then by each type alone."""
    uses = layer_uses(study.airspace, study.reference)
    held: list[tuple[str, LayerUse, float]] = [("mixed", use, use.in_use_s) for use in uses]
    for by_type in study.use_by_type:
        seconds = by_type.in_use_s.reshape(len(uses), -1).sum(axis=1).tolist()
        held += [(by_type.aircraft.id, use, in_use_s) for use, in_use_s in zip(uses, seconds, strict=True)]
    columns: dict[str, Callable[[tuple[str, LayerUse, float]], Cell]] = {
        "traffic": lambda entry: entry[0],
        "layer": lambda entry: entry[1].layer,
        "floor_m": lambda entry: entry[1].floor_m,
        "ceiling_m": lambda entry: entry[1].ceiling_m,
        "free_blocks": lambda entry: entry[1].free,
        "held_s": lambda entry: round(entry[2], 3),
    }
    return _table(held, columns)


def _altitude(study: Study) -> str:
    """The use of the layers at every weight of surcharges; nothing where there is one layer to fly in."""
    columns: dict[str, Callable[[AltitudeUse], Cell]] = {
        "weight_ms": lambda use: use.weight_ms,
        "refused": lambda use: use.refused,
        "most_crowded_by_mean": lambda use: round(use.peak, 4),
        "flight_time_s": lambda use: round(use.flight_time_s, 4),
        "price_s": lambda use: round(use.price_s, 4),
        "delay_s": lambda use: round(use.delay_s, 4),
        "waiting_s": lambda use: round(use.waiting_s, 4),
        "climb_m": lambda use: round(use.climb_m, 3),
        "pairs_too_near": lambda use: use.too_near,
        "computing_s": lambda use: round(use.computing_s, 4),
    }
    for layer in range(study.airspace.grid.dimensions[2]):
        columns[f"share_of_layer_{layer}"] = _share_of(layer)
    return _table(altitude_uses(study.airspace, study.balances), columns)


def _share_of(layer: int) -> Callable[[AltitudeUse], Cell]:
    return lambda use: round(use.shares[layer], 5)


def _aircraft(study: Study) -> str:
    """The speed model beside the paper, in the paper's blocks, and its speeds in this airspace's."""
    side_m, height_m = study.airspace.grid.block_side_m, study.airspace.grid.block_height_m
    columns: dict[str, Callable[[UseByType], Cell]] = {
        "aircraft": lambda use: use.aircraft.id,
        "mass_kg": lambda use: use.aircraft.mass_kg,
        "vertical_mps": lambda use: use.aircraft.max_vertical_speed_mps,
        "horizontal_mps": lambda use: use.aircraft.max_horizontal_speed_mps,
        "drag_kg_per_m": lambda use: round(use.aircraft.drag_constant, 6),
        "power_w": lambda use: round(use.aircraft.max_power_w, 3),
        "alpha_printed_mps": lambda use: performance_of(use.aircraft).steeper.printed,
        "alpha_mps": lambda use: round(performance_of(use.aircraft).steeper.solved, 4),
        "beta_printed_mps": lambda use: performance_of(use.aircraft).flatter.printed,
        "beta_mps": lambda use: round(performance_of(use.aircraft).flatter.solved, 4),
        "airspace_alpha_mps": lambda use: round(use.aircraft.link_speeds(side_m, height_m).alpha, 4),
        "airspace_beta_mps": lambda use: round(use.aircraft.link_speeds(side_m, height_m).beta, 4),
    }
    return _table(study.use_by_type, columns)
