"""`airmatrix experiment paper`: the paper's section 4 over any airspace, as a page with tables and figures."""

import csv
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from planner.airmatrix import AirMatrix
from planner.airspace import Airspace
from tests.cli.conftest import Run
from tests.cli.serving import AIRMATRIX, environment

QUICK = ("--quick", "--flights", 20, "--seeds", 1)
COLUMNS = {
    "flights.csv": [
        "flight", "aircraft", "origin", "destination", "departure_s", "astar_s", "without_traffic_computing_ms",
        "astar_computing_ms", "safe_interval_alone_computing_ms", "astar_conflicts",
        "astar_whole_second_conflicts", "case",
        "greedy_delay_s", "greedy_hold_s", "greedy_hover_s", "greedy_refused", "greedy_computing_ms",
        "safe_interval_delay_s", "safe_interval_hold_s", "safe_interval_hover_s", "safe_interval_refused",
        "safe_interval_computing_ms",
        "containment_delay_s", "containment_hold_s", "containment_hover_s", "containment_refused",
        "containment_computing_ms",
    ],
    "density.csv": [
        "window_min", "flights_a_minute", "seed", "astar_conflicts", "astar_whole_second_conflicts", "greedy_delay_s",
        "greedy_refused", "greedy_pairs_too_near", "diagonal_links", "corner_cuts", "containment_delay_s",
        "containment_refused", "containment_pairs_too_near",
    ],
    "searches.csv": [
        "od", "flights", "rule", "search", "accepted", "refused", "reasons", "delay_s", "mean_delay_s",
        "longest_delay_s", "computing_s", "expansions", "pairs", "pairs_too_near", "closest_m",
    ],
    "near_misses.csv": ["first_flight", "second_flight", "time_s", "separation_blocks", "horizontal_m", "vertical_m"],
    "layers.csv": ["traffic", "layer", "floor_m", "ceiling_m", "free_blocks", "held_s"],
    "altitude.csv": [
        "weight_ms", "refused", "most_crowded_by_mean", "flight_time_s", "price_s", "delay_s", "waiting_s", "climb_m",
        "pairs_too_near", "computing_s", "share_of_layer_0", "share_of_layer_1", "share_of_layer_2",
    ],
    "aircraft.csv": [
        "aircraft", "mass_kg", "vertical_mps", "horizontal_mps", "drag_kg_per_m", "power_w", "alpha_printed_mps",
        "alpha_mps", "beta_printed_mps", "beta_mps", "airspace_alpha_mps", "airspace_beta_mps",
    ],
}  # fmt: skip


def rows(path: Path) -> list[dict[str, str]]:
    """Return a table's rows without the columns that tell computing times."""
    with path.open(newline="") as file:
        return [{key: cell for key, cell in row.items() if "computing" not in key} for row in csv.DictReader(file)]


def everything_in(folder: Path) -> dict[str, bytes]:
    """Return every file below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_quick_run_writes_the_page_its_tables_and_its_figures(
    airmatrix: Run, town_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "reports" / "town"
    outcome = airmatrix("experiment", "paper", "--airspace", town_file, "--out", out, *QUICK)
    assert outcome.status == 0, outcome.err
    assert outcome.out.strip() == str(out / "report.html")
    files = everything_in(out)
    figures = {name for name in files if name.startswith("figures/")}
    assert set(files) == {"report.html", *COLUMNS, *figures}
    html = files["report.html"].decode()
    assert html.count("<figure ") == len(figures) > 10
    assert re.findall(r'(?:src|href)="(?!data:image/|#)[^"]*"', html) == []
    assert "town" in html
    assert f"airmatrix experiment paper --airspace {town_file} --out {out} --quick" in html
    for name, columns in COLUMNS.items():
        assert files[name].decode().splitlines()[0].split(",") == columns


def test_the_seed_decides_everything_but_computing_times(airmatrix: Run, town_file: Path, tmp_path: Path) -> None:
    for name, seed in (("first", 5), ("again", 5), ("other", 6)):
        run = ("experiment", "paper", "--airspace", town_file, "--out", tmp_path / name, "--seed", seed)
        assert airmatrix(*run, *QUICK).status == 0
    for table in COLUMNS:
        assert rows(tmp_path / "first" / table) == rows(tmp_path / "again" / table)
    assert rows(tmp_path / "first" / "flights.csv") != rows(tmp_path / "other" / "flights.csv")
    assert {row["seed"] for row in rows(tmp_path / "other" / "density.csv")} == {"6"}


@pytest.mark.parametrize(
    ("option", "value"), [("--flights", "0"), ("--flights", "3001"), ("--seeds", "0"), ("--seed", "-1")]
)
def test_an_option_outside_its_bounds_is_refused(airmatrix: Run, option: str, value: str) -> None:
    airmatrix("experiment", "paper", "--out", "here", option, value).assert_misused(option)


def test_the_folder_has_to_be_named(airmatrix: Run) -> None:
    airmatrix("experiment", "paper").assert_misused("--out")


def test_a_folder_that_cannot_be_written_is_refused_at_once(airmatrix: Run, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("mine")
    for out in (tmp_path / "taken", tmp_path / "taken" / "below", Path("/proc/report"), tmp_path / ("x" * 300)):
        airmatrix("experiment", "paper", "--out", out).assert_refused("cannot write into", str(out))
    assert (tmp_path / "taken").read_text() == "mine"


def test_an_airspace_that_is_none_is_refused(airmatrix: Run, tmp_path: Path) -> None:
    airmatrix("experiment", "paper", "--airspace", "none.geojson", "--out", "here").assert_refused("none.geojson")
    assert not (tmp_path / "here").exists()


def test_an_airspace_without_room_is_refused_and_leaves_no_folder(airmatrix: Run, tmp_path: Path) -> None:
    grid = AirMatrix(32642, 668_920.0, 5_665_220.0, 20.0, 40.0, (1, 1, 3))
    Airspace("shaft", "shaft", grid, 120.0, np.zeros(3, dtype=np.bool_)).write(tmp_path / "shaft.geojson")
    run = airmatrix("experiment", "paper", "--airspace", "shaft.geojson", "--out", "here")
    run.assert_refused("fewer than two columns")
    assert not (tmp_path / "here").exists()


def test_an_earlier_report_stays_whole_when_a_later_run_fails(airmatrix: Run, tmp_path: Path) -> None:
    grid = AirMatrix(32642, 668_920.0, 5_665_220.0, 20.0, 40.0, (3, 1, 1))
    parted = Airspace("parted", "parted", grid, 40.0, np.array([False, True, False]))
    parted.write(tmp_path / "parted.geojson")
    out = tmp_path / "here"
    out.mkdir()
    (out / "report.html").write_text("an earlier report")
    run = airmatrix("experiment", "paper", "--airspace", "parted.geojson", "--out", out, "--flights", 3)
    run.assert_refused("buildings part the ends of all 3 flights")
    assert everything_in(out) == {"report.html": b"an earlier report"}


def test_a_place_that_is_taken_by_a_folder_is_refused(airmatrix: Run, town_file: Path, tmp_path: Path) -> None:
    taken = tmp_path / "here" / "report.html"
    (taken / "mine").mkdir(parents=True)
    run = airmatrix("experiment", "paper", "--airspace", town_file, "--out", tmp_path / "here", *QUICK)
    run.assert_refused("cannot write", str(taken))
    assert not list((tmp_path / "here").glob(".report-*"))


def test_an_interrupted_run_leaves_nothing(town_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "here"
    arguments = [
        str(AIRMATRIX),
        "experiment",
        "paper",
        "--airspace",
        str(town_file),
        "--out",
        str(out),
        "--flights",
        "3000",
    ]
    with subprocess.Popen(
        arguments, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            while process.poll() is None and not list(out.glob(".report-*")):
                time.sleep(0.05)
            process.send_signal(signal.SIGINT)
            printed, err = process.communicate(timeout=30)
        finally:
            process.kill()
    assert (process.returncode, printed) == (130, "")
    assert "interrupted: nothing was written" in err
    assert "Traceback" not in err
    assert not out.exists()


def test_other_commands_do_not_wait_for_matplotlib() -> None:
    check = "import sys, app.cli; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", check], env=environment(), check=False).returncode == 0
