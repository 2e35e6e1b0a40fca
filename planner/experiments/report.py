"""The report: one HTML page that stands alone, with its tables and figures as files beside it."""

import base64
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined

from planner.airspace import OccupancyRule
from planner.experiments import figures, findings, paper
from planner.experiments.block_sizing import PAPER_TABLE_1
from planner.experiments.cases import Case, typical
from planner.experiments.figures import Picture
from planner.experiments.simulation import GROUND_HOLD_MS, HOVER_LIMIT_MS
from planner.experiments.study import Study
from planner.experiments.tables import all_tables
from planner.experiments.traffic import Od

_MEDIA = {"svg": "image/svg+xml", "png": "image/png"}
# The paper's four; it has no figure of waiting on an unchanged path.
_SHOWN_CASES = (Case.OVERLAPPING, Case.SAME_TIME, Case.DETOUR, Case.DIFFERENT)


@dataclass(frozen=True)
class Provenance:
    """How a report came about: the command, what ran it, when it was finished (UTC), and how long it took."""

    command: str
    versions: Mapping[str, str]
    machine: str
    finished: str
    duration_s: float


def build_report(study: Study, provenance: Provenance) -> dict[str, bytes]:
    """Return the report's files by their names; report.html comes last."""
    pictures = draw_figures(study)
    tables = all_tables(study)
    content = {name: text.encode() for name, text in tables.items()}
    content |= {f"figures/{name}.{picture.format}": picture.content for name, picture in pictures.items()}
    content["report.html"] = write_page(study, provenance, pictures, tables).encode()
    return content


def draw_figures(study: Study) -> dict[str, Picture]:
    """Draw every figure, by name, in the order in which the report numbers them."""
    airspace, reference = study.airspace, study.reference
    cases = {case: example for case in _SHOWN_CASES if (example := typical(reference.comparisons, case)) is not None}
    printed = [use for use in study.use_by_type if use.aircraft.id in paper.USE_BY_TYPE]
    pictures = {
        "occupied-blocks": figures.occupied_blocks(airspace),
        "speeds": figures.speeds(use.aircraft for use in study.use_by_type),
        "computing-time": figures.computing_time(reference),
    }
    if cases:
        pictures["typical-cases"] = figures.typical_cases(airspace, cases)
    pictures |= {
        "delays": figures.delays(reference),
        "accumulation": figures.accumulation(reference),
        "density": figures.density(study.trials, study.design.flights),
        "layer-use": figures.layer_use(airspace, reference.in_use_s),
        "use-by-type": figures.use_by_type(airspace, printed),
        "layer-shares": figures.layer_shares(airspace.grid, study.use_by_type),
    }
    if study.balances:
        prices_s = [use.price_s for use in findings.altitude_uses(airspace, study.balances)]
        pictures["altitude-balance"] = figures.altitude_balance(airspace, study.balances, prices_s)
    pictures["searches"] = figures.searches(study.trades)
    if reference.near_misses:
        contained = len(reference.containment_verdict.too_near)
        pictures["near-miss"] = figures.near_miss(airspace, reference.greedy, reference.near_misses, contained)
    return pictures


def write_page(study: Study, provenance: Provenance, pictures: Mapping[str, Picture], tables: Iterable[str]) -> str:
    """Write the page around these pictures; `tables` are the names of the files that it points to."""
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.filters |= {
        "count": count,
        "fixed": fixed,
        "percent": percent,
        "plural": plural,
        "seconds": seconds,
        "took": took,
    }
    template = environment.from_string(files("planner.experiments").joinpath("report.html.j2").read_text("utf-8"))
    numbers = {name: number for number, name in enumerate(pictures, start=1)}
    return template.render(
        study=study,
        airspace=study.airspace,
        grid=study.airspace.grid,
        design=study.design,
        reference=study.reference,
        provenance=provenance,
        paper=paper,
        figure_numbers=numbers,
        figure_data={name: _data_url(picture) for name, picture in pictures.items()},
        tables=list(tables),
        ground_hold_s=GROUND_HOLD_MS / 1000,
        hover_limit_s=HOVER_LIMIT_MS / 1000,
        **_facts(study),
    )


def _facts(study: Study) -> dict[str, Any]:
    """Return what the template states, by name."""
    airspace, reference = study.airspace, study.reference
    in_window = [trial for trial in study.trials if trial.window_min == paper.WINDOW_MIN]
    printed_types = [use for use in study.use_by_type if use.aircraft.id in paper.USE_BY_TYPE]
    types = [use.aircraft for use in study.use_by_type]
    inspire = next(aircraft for aircraft in types if aircraft.id == paper.INSPIRE_2)
    return {
        "navigation": PAPER_TABLE_1,
        "sizing": findings.sizing(),
        "performances": [findings.performance_of(aircraft) for aircraft in types],
        "elevations": paper.elevations_deg(),
        "inspire": inspire,
        "inspire_speeds": [
            findings.speed_at(inspire, elevation, printed) for elevation, printed in paper.INSPIRE_2_SPEEDS.items()
        ],
        "growth": findings.growth(reference),
        "cases": findings.case_counts(reference.comparisons),
        "undelayed": sum(one.cfa_star.delay_ms == 0 for one in reference.comparisons),
        "Case": Case,
        "conflicts_late": findings.second_half(reference.conflicts),
        "delay_late": findings.second_half(reference.greedy.delay_s),
        "greedy_delay": findings.delay_of(reference.greedy),
        "safe_interval_delay": findings.delay_of(reference.safe_interval),
        "trends": {
            "conflicts": findings.trend(study.trials, lambda trial: trial.conflicts),
            "delay": findings.trend(study.trials, lambda trial: trial.delay_s),
            "pairs": findings.trend(study.trials, lambda trial: trial.too_near),
            "containment": findings.trend(study.trials, lambda trial: trial.containment_delay_s),
        },
        "trial_refusals": sum(trial.refused for trial in study.trials),
        "whole_second_spread": findings.Spread.of([trial.whole_second_conflicts for trial in in_window]),
        "near_spread": findings.Spread.of([trial.too_near for trial in in_window]),
        "contained_near": sum(
            (
                len(reference.containment_verdict.too_near),
                *(trial.containment_too_near for trial in study.trials),
                *(len(one.verdict.too_near) for one in study.trades if one.rule is OccupancyRule.CONTAINMENT),
            )
        ),
        "broken_rules": sum(
            (
                reference.greedy_verdict.violations,
                reference.containment_verdict.violations,
                *(trial.violations for trial in study.trials),
                *(balance.verdict.violations for balance in study.balances),
                *(one.verdict.violations for one in study.trades),
            )
        ),
        "layers": findings.layer_uses(airspace, reference),
        "use_by_type": sorted(study.use_by_type, key=lambda use: use.speed_ratio),
        "above": {use.aircraft.id: findings.share_above_lowest(airspace.grid, use) for use in study.use_by_type},
        "printed_fall": findings.falls_with_ratio(airspace.grid, printed_types),
        "all_fall": findings.falls_with_ratio(airspace.grid, study.use_by_type),
        "altitude": findings.altitude_uses(airspace, study.balances),
        "compared": findings.compare_searches(study.trades),
        "price": findings.price_of_containment(reference),
        "Od": Od,
    }


def _data_url(picture: Picture) -> str:
    return f"data:{_MEDIA[picture.format]};base64,{base64.b64encode(picture.content).decode()}"


# Numbers for people. Units follow a narrow space that does not break.


def count(value: float) -> str:
    """Format a whole number with thousands separators."""
    return fixed(value, 0)


def plural(value: float, noun: str) -> str:
    """Format a whole number of things whose plural ends in s."""
    return f"{count(value)} {noun}" if value == 1 else f"{count(value)} {noun}s"


def fixed(value: float, decimals: int = 1) -> str:
    """Format a number with so many decimals, thousands separators and a minus sign, which a rounded zero has not."""
    return f"{value:z,.{decimals}f}".replace("-", "−")


def percent(share: float, decimals: int = 1) -> str:
    """Format a share as a percentage; what is not quite all is not rounded up to it."""
    text = fixed(100 * share, decimals)
    if share < 1 and text == fixed(100, decimals):
        text = f"> {fixed(100 - 10**-decimals, decimals)}"
    return f"{text}\u202f%"


def seconds(value: float, decimals: int = 1) -> str:
    """Format a time of flight or delay."""
    return f"{fixed(value, decimals)}\u202fs"


def took(value: float) -> str:
    """Format a computing time with three significant digits, in milliseconds or microseconds where it is short."""
    scale, unit = next(((scale, unit) for scale, unit in ((1, "s"), (1e3, "ms")) if value * scale >= 1), (1e6, "µs"))
    scaled = value * scale
    decimals = max(0, 2 - math.floor(math.log10(scaled))) if scaled > 0 else 0
    return f"{fixed(scaled, decimals)}\u202f{unit}"
