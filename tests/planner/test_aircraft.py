"""The speed model against the paper's table, and what a profile file may say."""

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.aircraft import AircraftType, merged, read_aircraft_types, shipped_aircraft_types
from planner.errors import AircraftProfileError

INSPIRE_2 = AircraftType("dji-inspire-2", "DJI Inspire 2", 3.44, 6.0, 26.0)

PROFILE = """
[[aircraft]]
id = "x"
name = "X"
mass_kg = 2.0
max_vertical_speed_mps = 4.0
max_horizontal_speed_mps = 16.0
"""


def test_the_shipped_types_are_the_papers_four_and_the_inspire_2() -> None:
    types = shipped_aircraft_types()
    assert [(t.id, t.mass_kg, t.max_vertical_speed_mps, t.max_horizontal_speed_mps) for t in types] == [
        ("dji-mavic-air", 0.43, 4.0, 19.0),
        ("self-built-drone", 0.3, 4.0, 12.0),
        ("dji-phantom-4", 1.375, 3.0, 20.0),
        ("dji-matrice-600-pro", 10.0, 5.0, 18.0),
        ("dji-inspire-2", 3.44, 6.0, 26.0),
    ]


def test_the_shipped_types_fly_at_60_percent_without_overrides_or_endurance() -> None:
    for profile in shipped_aircraft_types():
        assert (profile.speed_factor, profile.endurance_s, profile.link_speed_overrides) == (0.6, None, {})


@pytest.mark.parametrize(
    ("aircraft_id", "alpha", "beta"),
    [
        ("dji-mavic-air", 4.456, 4.862),
        ("self-built-drone", 4.413, 4.768),
        ("dji-phantom-4", 3.350, 3.664),
        ("dji-matrice-600-pro", 5.546, 6.023),
    ],
)
def test_tilted_speeds_in_the_papers_blocks_solve_its_equations(aircraft_id: str, alpha: float, beta: float) -> None:
    speeds = merged(shipped_aircraft_types())[aircraft_id].link_speeds(20.0, 40.0)
    assert (round(speeds.alpha, 3), round(speeds.beta, 3)) == (alpha, beta)


def test_level_and_vertical_speeds_are_the_profiles_own() -> None:
    speeds = INSPIRE_2.link_speeds(20.0, 40.0)
    assert (speeds.horizontal, speeds.vertical) == (26.0, 6.0)


def test_inspire_2_has_the_power_and_drag_that_include_drag_in_the_climb() -> None:
    assert round(INSPIRE_2.max_power_w, 3) == 204.998
    assert round(INSPIRE_2.drag_constant, 5) == 0.01166


@pytest.mark.parametrize(("elevation_deg", "speed_mps"), [(45, 8.310), (60, 6.884)])
def test_inspire_2_climbs_at_the_speed_that_solves_the_equations(elevation_deg: int, speed_mps: float) -> None:
    assert round(INSPIRE_2.full_power_speed(math.radians(elevation_deg)), 3) == speed_mps


@settings(deadline=None)
@given(st.floats(0.01, 100.0), st.floats(0.1, 30.0), st.floats(1.01, 20.0), st.floats(0.0, math.pi / 2))
def test_power_balances_drag_and_weight_at_every_elevation(
    mass_kg: float, climb_mps: float, ratio: float, elevation: float
) -> None:
    aircraft = AircraftType("any", "Any", mass_kg, climb_mps, climb_mps * ratio)
    v = aircraft.full_power_speed(elevation)
    needed = aircraft.drag_constant * v**3 + mass_kg * 9.81 * math.sin(elevation) * v
    assert needed == pytest.approx(aircraft.max_power_w, rel=1e-9)


def test_the_model_meets_both_given_speeds() -> None:
    assert INSPIRE_2.full_power_speed(0.0) == pytest.approx(26.0, rel=1e-12)
    assert INSPIRE_2.full_power_speed(math.pi / 2) == pytest.approx(6.0, rel=1e-12)


@settings(deadline=None)
@given(st.floats(0.01, 100.0))
def test_speeds_do_not_depend_on_mass(mass_kg: float) -> None:
    speeds = AircraftType("any", "Any", mass_kg, 6.0, 26.0).link_speeds(20.0, 40.0)
    assert speeds.alpha == pytest.approx(INSPIRE_2.link_speeds(20.0, 40.0).alpha, rel=1e-9)


def test_link_speeds_of_a_profile_replace_the_models_one_by_one() -> None:
    paper = AircraftType("p", "P", 10.0, 5.0, 18.0, link_speed_overrides={"alpha": 5.713})
    speeds = paper.link_speeds(20.0, 40.0)
    assert (speeds.alpha, round(speeds.beta, 3), speeds.horizontal) == (5.713, 6.023, 18.0)


def test_a_later_group_replaces_a_profile_of_the_same_id() -> None:
    heavier = AircraftType("dji-inspire-2", "Loaded", 4.0, 6.0, 26.0)
    types = merged([INSPIRE_2], [heavier])
    assert list(types) == ["dji-inspire-2"]
    assert types["dji-inspire-2"] is heavier


def test_a_profile_file_with_every_field_is_read(tmp_path: Path) -> None:
    path = tmp_path / "types.toml"
    path.write_text(
        PROFILE + "speed_factor = 0.8\nendurance_s = 1500\n[aircraft.link_speeds_mps]\nbeta = 5.5\n",
        encoding="utf-8",
    )
    assert read_aircraft_types(path) == (AircraftType("x", "X", 2.0, 4.0, 16.0, 0.8, 1500, {"beta": 5.5}),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"expected at least one \[\[aircraft\]\] table"),
        ("aircraft = 3", r"expected at least one \[\[aircraft\]\] table"),
        ("aircraft = []", r"expected at least one \[\[aircraft\]\] table"),
        ("aircraft = [1]", "every .* must be a table"),
        ("not toml", "cannot read aircraft types"),
        (PROFILE.replace('name = "X"', ""), "aircraft 'x' lacks name"),
        (PROFILE.replace('id = "x"', ""), "aircraft 'without id' lacks id"),
        (PROFILE.replace('"X"', '""'), "id and name must be non-empty strings"),
        (PROFILE.replace('"x"', "7"), "id and name must be non-empty strings"),
        (PROFILE + "wings = 2", "unknown fields wings"),
        (PROFILE.replace("2.0", "-2.0"), "mass_kg must be a number from 0.001 to 1000000, not -2.0"),
        (PROFILE.replace("2.0", "nan"), "mass_kg must be a number"),
        (PROFILE.replace("2.0", "inf"), "mass_kg must be a number"),
        (PROFILE.replace("2.0", "true"), "mass_kg must be a number"),
        (PROFILE.replace("2.0", '"2"'), "mass_kg must be a number"),
        (PROFILE.replace("2.0", "1e308"), "mass_kg must be a number"),
        (PROFILE.replace("16.0", "1e200"), "max_horizontal_speed_mps must be a number"),
        (PROFILE.replace("4.0", "1e-200"), "max_vertical_speed_mps must be a number"),
        (PROFILE.replace("4.0", "16.0"), "needs max_horizontal_speed_mps > max_vertical_speed_mps"),
        (PROFILE + "speed_factor = 1.1", "speed_factor must be at most 1"),
        (PROFILE + "endurance_s = 0", "endurance_s must be a number"),
        (PROFILE + "link_speeds_mps = 3", "link_speeds_mps must be a table"),
        (PROFILE + "link_speeds_mps = {gamma = 3}", r"unknown link speeds \['gamma'\]"),
        (PROFILE + "link_speeds_mps = {alpha = 0}", "link_speeds_mps.alpha must be a number"),
    ],
)
def test_a_malformed_profile_file_is_refused_with_its_reason(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "types.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(AircraftProfileError, match=message):
        read_aircraft_types(path)


def test_an_absent_profile_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(AircraftProfileError, match=r"cannot read aircraft types from .*absent\.toml"):
        read_aircraft_types(tmp_path / "absent.toml")
