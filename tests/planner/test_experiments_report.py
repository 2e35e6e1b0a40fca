"""The report stands alone, shows every figure, and stays true where an airspace has little to show."""

import csv
import functools
import io
import re
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from planner.airspace import Airspace
from planner.experiments.figures import Picture
from planner.experiments.report import (
    Provenance,
    build_report,
    count,
    draw_figures,
    fixed,
    percent,
    plural,
    seconds,
    took,
    write_page,
)
from planner.experiments.study import Design, Study, Verdict, conduct
from tests.planner.drawing import drawn
from tests.planner.experimenting import district, district_study

PROVENANCE = Provenance(
    command="airmatrix experiment paper --out 'my report'",
    versions={"airmatrix": "0.0.0", "Python": "3"},
    machine="an abacus",
    finished="2030-01-01 00:00 UTC",
    duration_s=12.3,
)
FIGURES = {
    "occupied-blocks.png", "speeds.svg", "computing-time.svg", "typical-cases.svg", "delays.svg", "accumulation.svg",
    "density.svg", "layer-use.png", "use-by-type.png", "layer-shares.svg", "searches.svg", "near-miss.svg",
}  # fmt: skip


class Page(HTMLParser):
    """A page's tags, attributes and text."""

    def __init__(self, html: bytes) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.text = ""
        self.feed(html.decode())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.text += data

    @property
    def words(self) -> str:
        """The text with single spaces."""
        return " ".join(self.text.split())

    def values(self, name: str) -> list[str]:
        """Return the values of all attributes of a name."""
        return [value for attribute, value in self.attributes if attribute == name]


def report(study: Study) -> dict[str, bytes]:
    """Return a study's report."""
    return build_report(study, PROVENANCE)


@functools.cache
def pictures() -> dict[str, Picture]:
    """Return the pictures of the district, which take longest."""
    return draw_figures(district_study())


def page(study: Study) -> Page:
    """Return the page of a study like that of the district."""
    shown = {
        name: picture for name, picture in pictures().items() if name != "near-miss" or study.reference.near_misses
    }
    return Page(write_page(study, PROVENANCE, shown, []).encode())


def small(airspace: Airspace, flights: int = 6) -> Study:
    """Conduct the smallest study of an airspace."""
    return conduct(airspace, Design(flights, (1,), (flights,), 1, windows_min=(5,)))


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    return report(district_study())


def test_the_page_loads_nothing(files: dict[str, bytes]) -> None:
    html = Page(files["report.html"])
    assert html.open == []
    assert all(source.startswith("data:image/") for source in html.values("src"))
    assert all(target.startswith("#") for target in html.values("href"))
    assert b"url(" not in files["report.html"]
    assert b"@import" not in files["report.html"]
    assert b"<script" not in files["report.html"]
    assert b"<link" not in files["report.html"]


def test_every_figure_is_in_the_page_and_a_file(files: dict[str, bytes]) -> None:
    html = Page(files["report.html"])
    assert {name.removeprefix("figures/") for name in files if name.startswith("figures/")} == FIGURES
    ids = [id_ for id_ in html.values("id") if id_.startswith("figure-")]
    assert ids == [
        f"figure-{name.split('.')[0]}" for name in sorted(FIGURES, key=lambda name: ids.index(f"figure-{name[:-4]}"))
    ]
    assert len(html.values("src")) == len(html.values("alt")) == len(FIGURES)
    assert re.findall(r"Figure (\d+)\.", html.words) == [str(number) for number in range(1, len(FIGURES) + 1)]
    assert {f"#{id_}" for id_ in ids} >= set(html.values("href"))
    for name, content in files.items():
        if name.endswith(".svg"):
            assert content.startswith(b"<?xml")
        if name.endswith(".png"):
            assert content.startswith(b"\x89PNG")


def test_the_page_comes_last_and_the_same_study_gives_the_same_bytes(files: dict[str, bytes]) -> None:
    assert list(files)[-1] == "report.html"
    assert report(district_study()) == files


def test_the_sentences_have_their_spaces_and_stops(files: dict[str, bytes]) -> None:
    words = Page(files["report.html"]).words
    assert re.findall(r".{20} [.,;:)]", words) == []
    assert re.findall(r".{20}[a-z]\.[A-Z]", words) == []
    assert re.findall(r".{20}\.\.", words) == []
    assert not {"None", "nan", "inf"} & set(re.findall(r"\w+", words))


def test_the_summary_states_the_measured_figures(files: dict[str, bytes]) -> None:
    reference = district_study().reference
    words = Page(files["report.html"]).words
    assert f"they meet in {reference.conflicts.sum()} blocks × seconds" in words
    assert f"{len(reference.near_misses)} pairs of these conflict-free flights come nearer" in words
    assert "Under containment no pair does" not in words
    assert "Under the containment rule no pair does, in any of the simulations" in words
    assert "airmatrix experiment paper --out 'my report'" in words
    assert "an abacus" in words


def test_tables_have_a_header_and_a_row_an_entry(files: dict[str, bytes]) -> None:
    study = district_study()
    rows = {name: list(csv.reader(io.StringIO(files[name].decode()))) for name in files if name.endswith(".csv")}
    entries = {
        "flights.csv": len(study.reference.astar.flights),
        "density.csv": len(study.trials),
        "searches.csv": len(study.trades),
        "near_misses.csv": len(study.reference.near_misses),
        "layers.csv": 2 * (1 + 5),
        "aircraft.csv": 5,
    }
    assert {name: len(table) - 1 for name, table in rows.items()} == entries
    assert all(len(row) == len(table[0]) for table in rows.values() for row in table)


def test_flights_are_numbered_from_one_and_their_delays_add_up(files: dict[str, bytes]) -> None:
    study = district_study()
    rows = list(csv.DictReader(io.StringIO(files["flights.csv"].decode())))
    assert [int(row["flight"]) for row in rows] == list(range(1, len(rows) + 1))
    for name, run in (("greedy", study.reference.greedy), ("containment", study.reference.containment)):
        delays = [float(row[f"{name}_delay_s"]) for row in rows if row[f"{name}_delay_s"]]
        assert sum(delays) == pytest.approx(np.nansum(run.delay_s))
        assert sum(bool(row[f"{name}_refused"]) for row in rows) == run.refused.total()
    assert sum(int(row["astar_conflicts"]) for row in rows) == study.reference.conflicts.sum()
    misses = list(csv.DictReader(io.StringIO(files["near_misses.csv"].decode())))
    first = study.reference.near_misses[0]
    assert (int(misses[0]["first_flight"]), int(misses[0]["second_flight"])) == (
        first.flights[0] + 1,
        first.flights[1] + 1,
    )


@pytest.mark.parametrize(
    "airspace",
    [
        drawn("......").airspace,
        drawn("..").airspace,
        drawn(*(["...  ..."] * 12)).airspace,
        drawn("..#..  .....  .###.").airspace,
    ],
    ids=["one row", "two blocks", "twelve layers", "one layer with buildings"],
)
def test_any_airspace_has_a_report(airspace: Airspace) -> None:
    html = Page(report(small(airspace))["report.html"])
    assert html.open == []
    assert re.findall(r".{20} [.,;:)]", html.words) == []
    assert not {"None", "nan", "inf"} & set(re.findall(r"\w+", html.words))
    assert "1 flights" not in html.words


def test_one_flight_alone_has_a_report_without_conflicts_delays_and_near_misses() -> None:
    study = small(drawn("......").airspace, flights=1)
    files = report(study)
    words = Page(files["report.html"]).words
    assert "figures/near-miss.svg" not in files
    assert "no two of them ever meet in a block" in words
    assert "No flight is delayed" in words
    assert "No two of these flights come nearer to each other than a block" in words
    assert "this traffic has none that is" in words


def test_names_are_shown_as_they_are() -> None:
    nasty = replace(district(), name='<script>alert("$x$ & y")</script>', attribution="Me & <b>you</b>.", licence="")
    study = replace(district_study(), airspace=nasty)
    html = page(study)
    assert "script" not in html.tags
    assert 'Conflict-free paths over <script>alert("$x$ & y")</script>' in html.words
    assert "Buildings: Me & <b>you</b>. The traffic" in html.words


def test_a_broken_promise_is_not_passed_over() -> None:
    study = district_study()
    broken = replace(study.reference.containment_verdict, too_near=((0, 1),), violations=2)
    words = page(replace(study, reference=replace(study.reference, containment_verdict=broken))).words
    assert "Under containment 1 pair came nearer than a block." in words
    assert "The checker found 2 other violations of the rules." in words
    assert "no pair does" not in words


def test_where_nothing_is_near_the_page_says_so() -> None:
    study = district_study()
    far = Verdict(12, (), 0, 0, None, None)
    words = page(replace(study, reference=replace(study.reference, near_misses=(), greedy_verdict=far))).words
    assert "none of the 12 pairs of flights in the air at the same time comes nearer than a block" in words


def test_refusals_are_stated_with_their_reasons() -> None:
    study = district_study()
    greedy = study.reference.greedy
    refusals = ("no_departure_slot", "disconnected", "disconnected", *[None] * (len(greedy.plans) - 3))
    refusing = replace(greedy, plans=(None, None, None, *greedy.plans[3:]), refusals=refusals)
    assert refusing.refused == Counter({"disconnected": 2, "no_departure_slot": 1})
    words = page(replace(study, reference=replace(study.reference, greedy=refusing))).words
    assert "3 flights are refused (no departure slot: 1, disconnected: 2)." in words
    assert "and with 3 flights refused" in words


# Numbers


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (2246.63, "2,247\u202fs"),
        (1.0, "1.00\u202fs"),
        (0.0635, "63.5\u202fms"),
        (0.000108, "108\u202fµs"),
        (0, "0\u202fµs"),
    ],
)
def test_computing_times_have_three_digits(value: float, text: str) -> None:
    assert took(value) == text


def test_numbers_are_written_for_people() -> None:
    assert count(25_629.4) == "25,629"
    assert fixed(-1234.567, 2) == "−1,234.57"
    assert seconds(2246.63, 2) == "2,246.63\u202fs"
    assert percent(0.3925) == "39.2\u202f%"
    assert percent(1) == "100.0\u202f%"
    assert percent(0.99999) == "> 99.9\u202f%"
    assert (plural(1, "pair"), plural(0, "pair"), plural(1200, "pair")) == ("1 pair", "0 pairs", "1,200 pairs")
