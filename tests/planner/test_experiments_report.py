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
from planner.experiments import findings
from planner.experiments.altitude import WEIGHTS_MS
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
from planner.experiments.simulation import Verdict
from planner.experiments.study import Balance, Design, Study, conduct
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
    "density.svg", "layer-use.png", "use-by-type.png", "layer-shares.svg", "altitude-balance.svg", "searches.svg",
    "near-miss.svg",
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
        "altitude.csv": 1 + len(WEIGHTS_MS),
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


def packed(text: str) -> str:
    """Return a text without its spaces, of which cells of tables have none between them."""
    return "".join(text.split())


def section(words: str, title: str, following: str) -> str:
    """Return the text between two headings, without its spaces."""
    return packed(words[words.index(title) : words.index(following)])


def test_the_section_on_altitudes_has_a_row_and_the_measures_of_every_weight(files: dict[str, bytes]) -> None:
    study = district_study()
    uses = findings.altitude_uses(study.airspace, study.balances)
    words = section(Page(files["report.html"]).words, "9. Beyond the paper: altitude", "10. Beyond the paper")
    for use in uses:
        name = f"{use.weight_ms:,} ms" if use.weight_ms else "none"
        assert packed(f"{name} {use.peak:.3f} {seconds(use.flight_time_s, 2)}") in words
        assert (
            packed(f"{seconds(use.delay_s, 3)} {seconds(use.waiting_s, 3)} {use.climb_m:.1f} m {use.too_near}") in words
        )
    rows = list(csv.DictReader(io.StringIO(files["altitude.csv"].decode())))
    assert [int(row["weight_ms"]) for row in rows] == [use.weight_ms for use in uses]
    assert [float(row["price_s"]) for row in rows] == [round(use.price_s, 4) for use in uses]
    for row, use in zip(rows, uses, strict=True):
        assert [float(row["share_of_layer_0"]), float(row["share_of_layer_1"])] == pytest.approx(use.shares, abs=1e-5)


def hovering(balance: Balance, hover_s: int, low_s: float, high_s: float, pairs: int) -> Balance:
    """Return a balance of flights that hover so long at first, use two layers so long, and have so many near pairs."""
    plans = tuple(
        plan
        and replace(
            plan,
            arrive_ms=plan.arrive_ms + 1000 * hover_s * (np.arange(len(plan.block)) > 0),
            depart_ms=plan.depart_ms + 1000 * hover_s,
        )
        for plan in balance.run.plans
    )
    in_use_s = np.zeros_like(balance.in_use_s)
    in_use_s[0], in_use_s[-1] = low_s, high_s
    verdict = replace(balance.verdict, too_near=((0, 1),) * pairs)
    return replace(balance, run=replace(balance.run, plans=plans), in_use_s=in_use_s, verdict=verdict)


def test_the_section_on_altitudes_tells_the_price_of_the_most_even_use_and_of_the_lightest_weight() -> None:
    study = district_study()
    base = study.balances[0]
    low, high = ((~study.airspace.occupied).reshape(2, -1).sum(axis=1)).tolist()
    balances = (
        hovering(base, 1, 3 * low, high, pairs=2),
        hovering(replace(base, weight_ms=10), 3, 2 * low, high, pairs=9),
        hovering(replace(base, weight_ms=300), 0, low, high, pairs=5),
        hovering(replace(base, weight_ms=1000), 8, 1.5 * low, high, pairs=9),
    )
    peaks = [part * (low + high) / (part * low + high) for part in (3, 2, 1)]
    effect = (peaks[0] - peaks[1]) / (peaks[0] - peaks[2])
    words = page(replace(study, balances=balances)).words
    assert f"Without surcharges the most crowded layer has {peaks[0]:.2f} times the crowding" in words
    mean_s = sum(plan.flight_time_ms for plan in base.run.accepted) / len(base.run.accepted) / 1000 + 1
    assert f"Use is most even at 300 ms a link: 1.00 times. The mean flight, of {mean_s:.2f} s, then" in words
    assert ", then takes 1.00 s less." in words
    assert f"10 ms already has {effect:.0%}".removesuffix("%") in words
    assert "of this effect, and flights take 2.00 s longer" in words
    assert "from no surcharge to 300 ms a link" in words
    assert "nearer than a block rises from 2 to 5, and a flight’s waiting falls from 1." in words
    assert "which waits little in any case" not in words


def test_refusals_under_surcharges_have_a_column_where_there_are_any() -> None:
    study = district_study()
    last = study.balances[-1]
    run = replace(last.run, plans=(None, *last.run.plans[1:]), refusals=("no_departure_slot", *last.run.refusals[1:]))
    refusing = replace(study, balances=(*study.balances[:-1], replace(last, run=run)))
    for shown, expected in ((study, False), (refusing, True)):
        words = section(page(shown).words, "9. Beyond the paper: altitude", "10. Beyond the paper")
        assert ("refused" in words) == expected


def test_where_no_weight_helps_the_page_says_so() -> None:
    study = district_study()
    base = study.balances[0]
    useless = replace(study, balances=(base, *(replace(base, weight_ms=weight_ms) for weight_ms in WEIGHTS_MS)))
    words = page(useless).words
    assert "No weight makes the use of this airspace more even." in words
    assert f"nearer than a block stays at {len(base.verdict.too_near)}, and a flight’s waiting stays at" in words
    assert "Use is most even" not in words


def test_a_price_too_small_to_print_is_no_longer_or_shorter_time() -> None:
    study = district_study()
    low, high = ((~study.airspace.occupied).reshape(2, -1).sum(axis=1)).tolist()
    base = hovering(study.balances[0], 0, 3 * low, high, pairs=2)
    even = hovering(replace(study.balances[0], weight_ms=10), 0, low, high, pairs=2)
    words = page(replace(study, balances=(base, even))).words
    assert "then takes the same time to 0.01 s." in words


def test_where_there_is_one_layer_the_page_balances_nothing() -> None:
    files = report(small(drawn("..#..  .....  .###.").airspace))
    words = Page(files["report.html"]).words
    assert "there is one layer to fly in, so that there is nothing to balance" in words
    assert "surcharge" not in words
    assert "figures/altitude-balance.svg" not in files
    assert len(files["altitude.csv"].splitlines()) == 1


def test_the_section_on_computing_says_what_astar_is_and_that_all_times_share_a_search(files: dict[str, bytes]) -> None:
    reference = district_study().reference
    words = section(Page(files["report.html"]).words, "4. Computing time", "5. Typical")
    shared, astar = reference.without_traffic_s.sum(), reference.astar.seconds.sum()
    assert packed("Here it is the greedy search with nothing reserved") in words
    assert packed(f"Measured by itself this takes {took(shared)}.") in words
    assert packed(f"search without traffic {took(shared)} {reference.astar.static_expansions:,} greedy") in words
    assert packed(f"greedy: A* and CFA* {took(astar)} {reference.astar.expansions:,}") in words
    for seconds_a_flight, expected in ((1e-9, True), (1.0, False)):
        alone = replace(reference.safe_interval_alone, seconds=np.full(90, seconds_a_flight))
        study = replace(district_study(), reference=replace(reference, safe_interval_alone=alone))
        assert ("It is not the fastest way to these flight times" in page(study).words) == expected
    for seconds_a_flight, expected in ((0.0, True), (1.0, False)):
        other = replace(reference, without_traffic_s=np.full(90, seconds_a_flight))
        words = page(replace(district_study(), reference=other)).words
        assert ("beyond the search without traffic" in words) == expected


def test_a_violation_under_surcharges_is_not_passed_over() -> None:
    study = district_study()
    broken = replace(study.balances[1], verdict=replace(study.balances[1].verdict, violations=2))
    words = page(replace(study, balances=(study.balances[0], broken, *study.balances[2:]))).words
    assert "The checker found 2 other violations of the rules." in words


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
    assert (fixed(-0.004, 2), fixed(-0.006, 2)) == ("0.00", "−0.01")
    assert seconds(2246.63, 2) == "2,246.63\u202fs"
    assert percent(0.3925) == "39.2\u202f%"
    assert percent(1) == "100.0\u202f%"
    assert percent(0.99999) == "> 99.9\u202f%"
    assert (plural(1, "pair"), plural(0, "pair"), plural(1200, "pair")) == ("1 pair", "0 pairs", "1,200 pairs")
