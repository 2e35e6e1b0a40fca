"""The report's figures: measured arrays in, SVG or PNG out.

Colours are Okabe and Ito's, told apart by the colour-blind; line styles and markers tell the same apart in grey print.
Figures are drawn on canvases of their own and leave nothing behind in matplotlib.
"""

import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator

from planner.aircraft import AircraftType
from planner.airmatrix import AirMatrix, FloatArray
from planner.airspace import Airspace, OccupancyRule
from planner.cfa_star import Search
from planner.experiments import paper
from planner.experiments.cases import Case, Comparison
from planner.experiments.metrics import positions
from planner.experiments.simulation import Run
from planner.experiments.study import Balance, NearMiss, Reference, Trade, Trial, UseByType
from planner.experiments.traffic import Od
from planner.path import Plan, Trajectory

P = ParamSpec("P")

_BLUE, _RED, _GREEN, _ORANGE, _PINK, _SKY, _GREY, _PALE = (
    "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#606060", "#c4c4c4",
)  # fmt: skip
_SERIES = ((_BLUE, "o", "-"), (_RED, "s", "--"), (_GREEN, "^", "-."), (_ORANGE, "D", ":"), (_PINK, "v", "--"))
_WIDTH_IN = 7.4
_DPI = 140
_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.axisbelow": True,
    "axes.formatter.use_mathtext": False,
    "lines.linewidth": 1.3,
    "lines.markersize": 4,
    "legend.frameon": False,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "image.interpolation": "none",
    "text.parse_math": False,
    "svg.hashsalt": "airmatrix",
}
_PLAN_VIEW_RATIO = 1.45
_MAPS_A_ROW = 3
_MOST_MAPS = 9
_THOUSANDS = FuncFormatter(lambda value, _: f"{value:,.0f}")
_SECONDS = FuncFormatter(lambda value, _: f"{value:,.0f} s" if value >= 1 else f"{1000 * value:g} ms")


@dataclass(frozen=True)
class Picture:
    """A drawn figure; `format` is svg or png."""

    content: bytes
    format: str


def _drawn_as(format_: str) -> Callable[[Callable[P, Figure]], Callable[P, Picture]]:
    """Draw in the house style and render."""

    def decorate(draw: Callable[P, Figure]) -> Callable[P, Picture]:
        def picture(*args: P.args, **kwargs: P.kwargs) -> Picture:
            buffer = io.BytesIO()
            with mpl.rc_context(_STYLE):
                figure = draw(*args, **kwargs)
                metadata = {"Date": None, "Creator": None} if format_ == "svg" else {"Software": None}
                figure.savefig(buffer, format=format_, dpi=_DPI, metadata=metadata)
            return Picture(buffer.getvalue(), format_)

        return picture

    return decorate


def _figure(height_in: float) -> Figure:
    figure = Figure(figsize=(_WIDTH_IN, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


# Scenario


@_drawn_as("png")
def occupied_blocks(airspace: Airspace) -> Figure:
    """Plan views of the statically occupied blocks, a layer each."""
    layers = _layers_shown(airspace.grid, _MOST_MAPS)
    occupied = _by_layer(airspace.grid, airspace.occupied)
    figure, axes = _maps(airspace.grid, len(layers), _MAPS_A_ROW)
    for ax, layer in zip(axes, layers, strict=True):
        ax.imshow(occupied[layer], cmap="Greys", vmin=0, vmax=1.35, origin="lower", extent=_extent(airspace.grid))
        ax.set_title(f"{_layer_name(airspace.grid, layer)}: {occupied[layer].sum():,}")
    return figure


def _layers_shown(grid: AirMatrix, most: int) -> list[int]:
    """Return all layers, or so many of them from the lowest to the highest, evenly."""
    count = grid.dimensions[2]
    return sorted({round(layer) for layer in np.linspace(0, count - 1, min(count, most))})


def _layer_name(grid: AirMatrix, layer: int) -> str:
    height = grid.block_height_m
    return f"{layer * height:g}–{(layer + 1) * height:g} m"


def _by_layer(grid: AirMatrix, values: Any) -> Any:
    count_i, count_j, count_k = grid.dimensions
    return values.reshape(count_k, count_j, count_i)


def _extent(grid: AirMatrix) -> tuple[float, float, float, float]:
    return 0, grid.dimensions[0] * grid.block_side_m, 0, grid.dimensions[1] * grid.block_side_m


def _maps(grid: AirMatrix, count: int, columns: int, beside_in: float = 0.0) -> tuple[Figure, list[Axes]]:
    """Return a figure with so many maps of the airspace, in metres from its south-west corner.

    `beside_in` is the width to be left for a colour bar.
    """
    columns = min(count, columns)
    rows = math.ceil(count / columns)
    map_width = (_WIDTH_IN - 0.6 - beside_in) / max(columns, 2) - 0.2
    slope = min(max(grid.dimensions[1] / grid.dimensions[0], 0.25), 2.0)
    figure = _figure(rows * (map_width * slope + 0.3) + 0.4)
    grid_of_axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    axes = list(grid_of_axes.ravel())
    for ax in axes[count:]:
        ax.set_visible(False)
    for ax in axes[:count]:
        ax.set_aspect("equal")
        ax.xaxis.set_major_locator(MaxNLocator(4))
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.xaxis.set_major_formatter(_THOUSANDS)
        ax.yaxis.set_major_formatter(_THOUSANDS)
        for spine in ax.spines.values():
            spine.set_visible(True)
    figure.supxlabel("east, m", fontsize=8)
    figure.supylabel("north, m", fontsize=8)
    return figure, axes[:count]


@_drawn_as("svg")
def speeds(aircraft: Iterable[AircraftType]) -> Figure:
    """Full-power speed over elevation by the paper's equations, with the paper's printed values as rings.

    Aircraft of which the paper prints nothing are left out.
    """
    figure = _figure(3.0)
    ax = figure.subplots()
    degrees = np.linspace(0, 90, 91)
    alpha, beta = paper.elevations_deg()
    printed: dict[str, dict[float, float]] = {
        id_: {alpha: row.steeper, beta: row.flatter} for id_, row in paper.SPEEDS.items()
    }
    printed[paper.INSPIRE_2] = paper.INSPIRE_2_SPEEDS
    shown = [one for one in aircraft if one.id in printed]
    for (colour, _, line), one in zip(_SERIES, shown, strict=True):
        speed = [one.full_power_speed(math.radians(angle)) for angle in degrees]
        ax.plot(degrees, speed, line, color=colour, label=one.name)
        ax.plot([*printed[one.id]], [*printed[one.id].values()], "o", mfc="none", color=colour, ms=6)
    for angle, name in ((alpha, "α"), (beta, "β")):
        ax.axvline(angle, color=_GREY, lw=0.7, ls=":")
        ax.annotate(f"{name} = {angle:.1f}°", (angle, 1), xycoords=("data", "axes fraction"), xytext=(2, -8),
                    textcoords="offset points", color=_GREY)  # fmt: skip
    ax.plot([], [], "o", mfc="none", color=_GREY, ms=6, label="printed in the paper")
    ax.set(xlabel="elevation of the link, degrees", ylabel="speed at full power, m/s", xlim=(0, 90), ylim=(0, None))
    ax.set_xticks(range(0, 91, 15))
    ax.grid()
    ax.legend(ncols=2)
    return figure


# The paper's scenario


@_drawn_as("svg")
def computing_time(reference: Reference) -> Figure:
    """Accumulated computing time over flights, on a log axis, with the paper's totals."""
    figure = _figure(3.1)
    ax = figure.subplots()
    count = len(reference.astar.flights)
    number = np.arange(1, count + 1)
    for (colour, _, line), (label, run) in zip(_SERIES, _searches(reference), strict=False):
        ax.plot(number, np.cumsum(run.seconds), line, color=colour, label=label)
    for seconds, label in ((paper.CFA_STAR_S, "CFA*, paper"), (paper.ASTAR_S, "A*, paper")):
        ax.plot(paper.FLIGHTS, seconds, "*", color=_GREY, ms=8, clip_on=False)
        ax.annotate(f"{label}: {seconds:,.2f} s", (paper.FLIGHTS, seconds), xytext=(-8, -3), ha="right",
                    textcoords="offset points", color=_GREY)  # fmt: skip
    ax.set_yscale("log")
    ax.set(xlabel="flights planned", ylabel="accumulated computing time", xlim=(0, max(count, paper.FLIGHTS) * 1.02))
    ax.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: f"{value:,.0f} s" if value >= 1 else f"{value * 1000:g} ms")
    )
    ax.grid()
    ax.legend(loc="center right", bbox_to_anchor=(1, 0.62))
    return figure


def _searches(reference: Reference) -> tuple[tuple[str, Run], ...]:
    return (
        ("A*", reference.astar),
        ("CFA*, greedy", reference.greedy),
        ("CFA*, safe-interval", reference.safe_interval),
    )


@_drawn_as("svg")
def typical_cases(airspace: Airspace, examples: Mapping[Case, Comparison]) -> Figure:
    """Plan view and vertical profile of the example of each case; buildings grey, darker where they are higher."""
    figure = _figure(2.25 * len(examples))
    rows = figure.subplots(len(examples), 2, squeeze=False, width_ratios=(1, 1.25))
    grid = airspace.grid
    storeys = _by_layer(grid, airspace.occupied).sum(axis=0)
    for letter, (plan_view, profile), (case, example) in zip("abcdef", rows, examples.items(), strict=False):
        plan_view.imshow(
            storeys, cmap="Greys", vmin=0, vmax=2.5 * grid.dimensions[2], origin="lower", extent=_extent(grid)
        )
        _draw_case(grid, plan_view, profile, example)
        plan_view.set_title(f"({letter}) {case.value}")
        share, delay_s = f"{100 * example.common:.0f} % of blocks in common", example.cfa_star.delay_ms / 1000
        profile.set_title(f"flight {example.number + 1}: {share}, delay {delay_s:.1f} s")
    rows[0][1].legend(loc="best")
    rows[-1][0].set_xlabel("east, m")
    rows[-1][1].set_xlabel("time from the wished departure, s")
    return figure


def _draw_case(grid: AirMatrix, plan_view: Axes, profile: Axes, example: Comparison) -> None:
    for trajectory, colour, width, label in (
        (example.astar, _SKY, 4.5, "A*"),
        (example.cfa_star, _RED, 1.2, "CFA*, greedy"),
    ):
        east, north, _ = _stops(grid, trajectory).T
        plan_view.plot(east, north, color=colour, lw=width)
        times_ms = np.unique(np.concatenate([trajectory.arrive_ms, trajectory.depart_ms]))
        altitude = positions(grid, trajectory, times_ms)[:, 2]
        since_s = (times_ms - example.cfa_star.earliest_departure_ms) / 1000
        profile.plot(since_s, altitude, color=colour, lw=width, label=label)
    east, north, _ = _stops(grid, example.astar)[[0, -1]].T
    plan_view.plot(east[:1], north[:1], "o", color="black", ms=5)
    plan_view.plot(east[1:], north[1:], "s", color="black", ms=5)
    both = np.concatenate([_stops(grid, example.astar), _stops(grid, example.cfa_star)])
    low, high = both[:, :2].min(axis=0), both[:, :2].max(axis=0)
    reach = (high - low) / 2 + 3 * grid.block_side_m
    half_height = max(reach[1], reach[0] / _PLAN_VIEW_RATIO)
    half = np.array([_PLAN_VIEW_RATIO * half_height, half_height])
    (west, south), (east, north) = (low + high) / 2 - half, (low + high) / 2 + half
    plan_view.set(xlim=(west, east), ylim=(south, north), ylabel="north, m")
    plan_view.set_aspect("equal")
    for axis in (plan_view.xaxis, plan_view.yaxis):
        axis.set_major_locator(MaxNLocator(4))
        axis.set_major_formatter(_THOUSANDS)
    profile.set(ylabel="altitude, m", ylim=(0, grid.dimensions[2] * grid.block_height_m))
    if grid.dimensions[2] <= _MOST_MAPS:
        profile.set_yticks(np.arange(grid.dimensions[2] + 1) * grid.block_height_m)
    profile.grid(axis="y")


def _stops(grid: AirMatrix, trajectory: Trajectory) -> FloatArray:
    corner = (grid.origin_x_m, grid.origin_y_m, 0.0)
    stops: FloatArray = grid.centres(trajectory.block) - corner
    return stops


@_drawn_as("svg")
def delays(reference: Reference) -> Figure:
    """Bars of flight time without traffic and delay, flight by flight, and the ratio of both."""
    figure = _figure(4.0)
    bars, ratio = figure.subplots(2, sharex=True, height_ratios=(1.5, 1))
    alone_s, delay_s = reference.greedy.unconstrained_s, reference.greedy.delay_s
    edges = np.arange(len(alone_s) + 1) + 0.5
    alone_s, delay_s = np.nan_to_num(alone_s), np.nan_to_num(delay_s)
    bars.stairs(alone_s, edges, fill=True, color=_ORANGE, label="flight time by A*")
    bars.stairs(alone_s + delay_s, edges, baseline=alone_s, fill=True, color=_BLUE, label="delay by CFA*, greedy")
    bars.set(ylabel="seconds", ylim=(0, 1.22 * max((alone_s + delay_s).max(), 1)))
    bars.legend(ncols=2, loc="upper left")
    late = np.flatnonzero(delay_s > 0)
    percent = 100 * np.divide(delay_s, alone_s, out=np.zeros_like(delay_s), where=alone_s > 0)
    ratio.vlines(late + 1, 0, percent[late], color=_BLUE, lw=1)
    ratio.plot(late + 1, percent[late], "o", color=_BLUE, ms=2.5)
    ratio.set(xlabel="flight, in filing order", ylabel="delay / flight time, %", xlim=(0.5, edges[-1]), ylim=(0, None))
    for ax in (bars, ratio):
        ax.grid(axis="y")
    return figure


@_drawn_as("svg")
def accumulation(reference: Reference) -> Figure:
    """Accumulated conflicts of A* and accumulated delay of CFA*, over flights in filing order."""
    figure = _figure(2.6)
    left, right = figure.subplots(1, 2)
    number = np.arange(1, len(reference.conflicts) + 1)
    for (colour, _, line), label, added in zip(
        _SERIES,
        ("at the seconds themselves", "widened to whole seconds"),
        (reference.conflicts, reference.whole_second_conflicts),
        strict=False,
    ):
        left.step(number, np.cumsum(added), line, where="post", color=colour, label=label)
    left.legend(loc="upper left")
    left.set(title="(a) A*: conflicts", ylabel="blocks × seconds with more than one flight")
    for (colour, _, line), (label, run) in list(zip(_SERIES, _searches(reference), strict=False))[1:]:
        right.step(number, np.nancumsum(run.delay_s), line, where="post", color=colour, label=label)
    right.set(title="(b) CFA*: delay", ylabel="seconds")
    right.legend(loc="upper left")
    for ax in (left, right):
        ax.set(xlabel="flights planned", xlim=(0, len(number) * 1.02), ylim=(0, None))
        ax.yaxis.set_major_formatter(_THOUSANDS)
        ax.grid()
    return figure


# Density


@_drawn_as("svg")
def density(trials: Sequence[Trial], flights: int) -> Figure:
    """Conflicts, delays and near misses over flights a minute: every seed, quartiles and medians."""
    figure = _figure(5.0)
    panels: tuple[tuple[str, str, Callable[[Trial], float]], ...] = (
        ("(a) A*: conflicts", "blocks × seconds", lambda trial: trial.conflicts),
        ("(b) CFA*, greedy, midpoint: delay in all", "seconds", lambda trial: trial.delay_s),
        ("(c) the same: pairs nearer than a block", "pairs", lambda trial: trial.too_near),
        ("(d) CFA*, safe-interval, containment: delay in all", "seconds", lambda trial: trial.containment_delay_s),
    )
    windows = sorted({trial.window_min for trial in trials}, reverse=True)
    for ax, (title, unit, measure) in zip(figure.subplots(2, 2, sharex=True).ravel(), panels, strict=True):
        medians = []
        for place, window in enumerate(windows):
            values = np.array([measure(trial) for trial in trials if trial.window_min == window])
            low, median, high = np.percentile(values, [25, 50, 75])
            medians.append(median)
            spread = np.linspace(-0.16, 0.16, len(values)) if len(values) > 1 else np.zeros(1)
            ax.plot(place + spread, values, "o", color=_PALE, ms=2.5, mew=0)
            ax.add_patch(Rectangle((place - 0.22, low), 0.44, high - low, fill=False, color=_BLUE, lw=1))
        ax.plot(range(len(windows)), medians, "o-", color=_BLUE)
        ax.set(title=title, ylabel=unit, ylim=(0, None))
        ax.set_xticks(range(len(windows)), [f"{flights / window:.3g}\n{window} min" for window in windows])
        ax.grid(axis="y")
    figure.supxlabel("flights a minute; departure window", fontsize=8)
    return figure


# Use of the airspace


@_drawn_as("png")
def layer_use(airspace: Airspace, in_use_s: FloatArray) -> Figure:
    """Heat maps of how long each block is held, a layer each; buildings are grey."""
    layers = _layers_shown(airspace.grid, _MOST_MAPS)
    figure, axes = _maps(airspace.grid, len(layers), _MAPS_A_ROW, beside_in=0.7)
    _heat(figure, airspace, [(ax, layer, in_use_s) for ax, layer in zip(axes, layers, strict=True)])
    for ax, layer in zip(axes, layers, strict=True):
        ax.set_title(_layer_name(airspace.grid, layer))
    return figure


@_drawn_as("png")
def use_by_type(airspace: Airspace, uses: Sequence[UseByType]) -> Figure:
    """The same heat maps for traffic of one type of aircraft: a row a layer, the lowest first, a column a type."""
    layers = _layers_shown(airspace.grid, _MAPS_A_ROW)
    figure, axes = _maps(airspace.grid, len(layers) * len(uses), len(uses), beside_in=0.7)
    places = [(layer, use) for layer in layers for use in uses]
    _heat(figure, airspace, [(ax, layer, use.in_use_s) for ax, (layer, use) in zip(axes, places, strict=True)])
    for ax, (layer, use) in zip(axes, places, strict=True):
        ax.set_title(f"{use.aircraft.name}, {_layer_name(airspace.grid, layer)}")
    return figure


def _heat(figure: Figure, airspace: Airspace, maps: Sequence[tuple[Axes, int, FloatArray]]) -> None:
    """Draw heat maps of layers of the use of blocks on one scale."""
    used = np.concatenate([in_use_s[in_use_s > 0] for _, _, in_use_s in maps])
    # A few blocks where flights wait would leave the corridors pale.
    most = float(np.percentile(used, 99.5)) if used.size else 1.0
    occupied = _by_layer(airspace.grid, airspace.occupied)
    colours = mpl.colormaps["Blues"].with_extremes(bad=_PALE)
    for ax, layer, in_use_s in maps:
        shown = np.ma.masked_array(_by_layer(airspace.grid, in_use_s)[layer], occupied[layer])
        image = ax.imshow(
            shown, cmap=colours, norm=PowerNorm(0.5, 0, most), origin="lower", extent=_extent(airspace.grid)
        )
    bar = figure.colorbar(image, ax=[ax for ax, _, _ in maps], shrink=0.6, pad=0.02, aspect=24, extend="max")
    bar.set_label("seconds held, square-root scale")
    bar.outline.set_visible(False)


@_drawn_as("svg")
def layer_shares(grid: AirMatrix, uses: Sequence[UseByType]) -> Figure:
    """Shares of the layers in the time that blocks are held, a bar a type of aircraft, by ratio of speeds."""
    uses = sorted(uses, key=lambda use: use.speed_ratio)
    figure = _figure(0.7 + 0.33 * len(uses))
    ax = figure.subplots()
    _draw_shares(ax, grid, [use.in_use_s for use in uses], least_named=6)
    ax.set_yticks(range(len(uses)), [f"{use.aircraft.name} ({use.speed_ratio:.2f})" for use in uses])
    ax.set_xlabel("share of the time for which blocks are held, %")
    return figure


@_drawn_as("svg")
def altitude_balance(airspace: Airspace, balances: Sequence[Balance], prices_s: Sequence[float]) -> Figure:
    """Shares of the layers at each weight of surcharges, the layers' shares of the free blocks, and each price."""
    figure = _figure(0.8 + 0.33 * (len(balances) + 1))
    bars, price = figure.subplots(1, 2, sharey=True, width_ratios=(1.9, 1))
    free = (~airspace.occupied).astype(np.float64)
    _draw_shares(bars, airspace.grid, [*(balance.in_use_s for balance in balances), free], least_named=11)
    names = [f"{balance.weight_ms:,} ms a link" if balance.weight_ms else "no surcharge" for balance in balances]
    bars.set_yticks(range(len(balances) + 1), [*names, "free blocks"])
    bars.get_yticklabels()[-1].set_style("italic")
    bars.axhline(len(balances) - 0.5, color=_GREY, lw=0.7, ls=":")
    bars.set_xlabel("share of the time for which blocks are held, %")
    rows = range(len(balances))
    price.hlines(rows, 0, prices_s, color=_BLUE, lw=1.3)
    price.plot(prices_s, rows, "o", color=_BLUE)
    price.axvline(0, color="black", lw=0.7)
    price.set_xlabel("flight time more, s a flight")
    price.margins(x=0.3)
    for row, value in zip(rows, prices_s, strict=True):
        text = f"{value:+.2f}".replace("-", "−") if abs(value) >= 0.005 else "0"
        aside, align = (6, "left") if value > -0.005 else (-6, "right")
        price.annotate(text, (value, row), xytext=(aside, 0), textcoords="offset points", va="center", ha=align)
    price.spines["left"].set_visible(False)
    price.tick_params(axis="y", length=0)
    price.grid(axis="x")
    return figure


def _draw_shares(ax: Axes, grid: AirMatrix, uses: Sequence[FloatArray], least_named: float) -> None:
    """Draw bars of the layers' shares of uses of the blocks; shares from `least_named` % on are written into them."""
    shares = np.array([_by_layer(grid, use).sum(axis=(1, 2)) for use in uses])
    shares = 100 * shares / np.maximum(shares.sum(axis=1, keepdims=True), 1e-9)
    colours = mpl.colormaps["Blues"](np.linspace(0.25, 0.85, grid.dimensions[2]))
    left = np.zeros(len(uses))
    for layer, colour in enumerate(colours):
        label = _layer_name(grid, layer) if grid.dimensions[2] <= _MOST_MAPS else None
        ax.barh(range(len(uses)), shares[:, layer], left=left, color=colour, ec="white", lw=0.6, label=label)
        for row, share in enumerate(shares[:, layer]):
            if share >= least_named:
                ax.text(left[row] + share / 2, row, f"{share:.1f} %", ha="center", va="center",
                        color="white" if colour[:3].mean() < 0.55 else "black")  # fmt: skip
        left += shares[:, layer]
    ax.invert_yaxis()
    ax.set_xlim(0, 100)
    ax.spines["left"].set_visible(False)
    ax.tick_params(axis="y", length=0)
    if grid.dimensions[2] <= _MOST_MAPS:
        ax.legend(ncols=min(grid.dimensions[2], 5), loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2)


# Beyond the paper


@_drawn_as("svg")
def searches(trades: Sequence[Trade]) -> Figure:
    """Delay, refusals and computing time over the size of traffic, for each rule and search; a column a generator."""
    figure = _figure(5.6)
    rows: tuple[tuple[str, Callable[[Trade], float]], ...] = (
        ("delay a flight, s", lambda one: one.mean_delay_s),
        ("refused, %", lambda one: 100 * (one.flights - one.accepted) / one.flights),
        ("computing a flight, ms", lambda one: 1000 * one.computing_s / one.flights),
    )
    panels = figure.subplots(len(rows), len(Od), sharex=True, sharey="row")
    for column, od in enumerate(Od):
        panels[0][column].set_title("anywhere to anywhere" if od is Od.UNIFORM else "from and to the ground")
        for ax, (unit, measure) in zip(panels[:, column], rows, strict=True):
            for rule in OccupancyRule:
                for search in Search:
                    line = [one for one in trades if (one.od, one.rule, one.search) == (od, rule, search)]
                    colour = _BLUE if rule is OccupancyRule.MIDPOINT else _RED
                    mark, style = ("o", "--") if search is Search.GREEDY else ("s", "-")
                    ax.plot([one.flights for one in line], [measure(one) for one in line], style, marker=mark,
                            color=colour, mfc="white" if search is Search.GREEDY else colour,
                            label=f"{rule.value}, {search.value}")  # fmt: skip
            ax.set_xscale("log")
            ax.set_xticks(sorted({one.flights for one in trades}))
            ax.xaxis.set_major_formatter(_THOUSANDS)
            ax.minorticks_off()
            ax.grid()
            if column == 0:
                ax.set_ylabel(unit)
    for ax in panels[-1]:
        ax.set_xlabel(f"flights in {paper.WINDOW_MIN} min")
    panels[0][0].legend()
    return figure


@_drawn_as("svg")
def near_miss(airspace: Airspace, run: Run, misses: Sequence[NearMiss], contained: int) -> Figure:
    """The first of some near misses in close-up, its distances in time, and how many pairs come how near.

    `contained` is how many pairs come nearer than a block under containment.
    """
    figure = _figure(3.1)
    close_up, distances, pairs = figure.subplots(1, 3, width_ratios=(1.15, 1, 0.8))
    miss = misses[0]
    first, second = (run.plans[number] for number in miss.flights)
    assert first is not None
    assert second is not None
    _draw_close_up(airspace, close_up, first, second, miss)
    _draw_distances(airspace.grid, distances, first, second, miss)
    separations = np.array([one.encounter.separation for one in misses])
    pairs.step([0, *separations, 1], [0, *range(1, len(misses) + 1), len(misses)], where="post", color=_BLUE)
    pairs.plot(1, contained, "s", color=_RED, clip_on=False)
    pairs.annotate(f"containment: {contained}", (1, contained), xytext=(-8, 4), textcoords="offset points",
                   color=_RED, ha="right")  # fmt: skip
    pairs.annotate(f"midpoint: {len(misses)}", (1, len(misses)), xytext=(-4, 4), textcoords="offset points",
                   color=_BLUE, ha="right")  # fmt: skip
    pairs.set(title="(c) pairs that come so near", xlabel="separation, blocks", xlim=(0, 1), ylim=(0, None))
    pairs.grid()
    return figure


def _draw_close_up(airspace: Airspace, ax: Axes, first: Plan, second: Plan, miss: NearMiss) -> None:
    grid, time_ms = airspace.grid, miss.encounter.time_ms
    side = grid.block_side_m
    for plan, colour, hatch, number in (
        (first, _BLUE, "////", miss.flights[0]),
        (second, _RED, "\\\\\\\\", miss.flights[1]),
    ):
        held = plan.hold_block[(plan.hold_enter_ms <= time_ms) & (time_ms < plan.hold_exit_ms)]
        for i, j, _ in grid.ijk(held):
            ax.add_patch(
                Rectangle((i * side, j * side), side, side, fc="none", ec=colour, hatch=hatch, lw=0, alpha=0.45)
            )
        seconds = time_ms + 1000 * np.arange(-8, 9)
        seconds = seconds[(plan.departure_ms <= seconds) & (seconds <= plan.arrival_ms)]
        east, north, _ = positions(grid, plan, seconds).T
        ax.plot(*_stops(grid, plan)[:, :2].T, "-", color=colour, lw=1.2, label=f"flight {number + 1}")
        ax.plot(east, north, ".", color=colour, ms=4)
        here, towards = positions(grid, plan, np.array([time_ms, time_ms + 2000]))[:, :2]
        ax.annotate("", towards, here, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.6})
        ax.plot(*here, "o", color=colour, ms=7, mec="black", mew=0.8, zorder=5)
    centre = positions(grid, first, np.array([time_ms]))[0, :2]
    reach = 2.2 * side
    corner = np.floor(centre / side) * side
    for line in np.arange(-4, 6) * side:
        ax.axvline(corner[0] + line, color="#d8d8d8", lw=0.7, zorder=0)
        ax.axhline(corner[1] + line, color="#d8d8d8", lw=0.7, zorder=0)
    ax.set(xlim=(centre[0] - reach, centre[0] + reach), ylim=(centre[1] - reach, centre[1] + reach))
    ax.set(title="(a) plan view, a dot a second", xlabel="east, m", ylabel="north, m")
    ax.set_aspect("equal")
    ax.legend(loc="upper right", fontsize=7, frameon=True, framealpha=0.9, edgecolor="none")


def _draw_distances(grid: AirMatrix, ax: Axes, first: Plan, second: Plan, miss: NearMiss) -> None:
    begin = max(first.departure_ms, second.departure_ms, miss.encounter.time_ms - 12_000)
    end = min(first.arrival_ms, second.arrival_ms, miss.encounter.time_ms + 12_000)
    times_ms = np.arange(begin, end + 1, 50)
    apart = positions(grid, first, times_ms) - positions(grid, second, times_ms)
    since_s = (times_ms - miss.encounter.time_ms) / 1000
    ax.plot(since_s, np.hypot(apart[:, 0], apart[:, 1]) / grid.block_side_m, "-", color=_GREEN, label="horizontally")
    ax.plot(since_s, np.abs(apart[:, 2]) / grid.block_height_m, "--", color=_PINK, label="vertically")
    ax.axhline(1, color=_GREY, lw=0.8, ls=":")
    ax.set(title="(b) distance", xlabel="seconds from the encounter", ylabel="blocks", ylim=(-0.15, None))
    ax.grid()
    ax.legend()
