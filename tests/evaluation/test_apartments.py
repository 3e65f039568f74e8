import json
from pathlib import Path

import numpy as np
import pytest

from evaluation.apartments import APARTMENTS, draw, files
from specshield.policy.geodesic import geodesic_distance
from specshield.world.map_server import load_map
from specshield.world.regions import region_from_json, signed_distance

MAPS = Path(__file__).parents[2] / "maps"
EACH = pytest.mark.parametrize("apartment", APARTMENTS.values(), ids=list(APARTMENTS))
RADIUS = 0.1855
MARGIN = 0.05  # inside a region, by a cell


def steps(distance):
    """A generous estimate: 0.2 m a step, a third more for turning on the way, six turns at the start."""
    return distance / 0.2 * 1.35 + 6


@EACH
def test_the_committed_files_are_what_the_data_makes(apartment):
    made = files(apartment)
    assert {name: (MAPS / name).read_bytes() for name in made} == made


@EACH
def test_the_files_read_back(apartment):
    made = files(apartment)
    assert load_map(made[f"{apartment.name}.yaml"].decode(), made[f"{apartment.name}.pgm"]) == draw(apartment)
    beside = json.loads(made[f"{apartment.name}.regions.json"])
    regions = {name: region_from_json(spec, name) for name, spec in beside["regions"].items()}
    assert regions == apartment.regions
    assert set(beside["rooms"]) == set(apartment.rooms)
    assert all(name in beside["formula"] for name in regions)
    assert all(target in beside["instruction"] for target in beside["targets"])


@EACH
def test_all_free_space_is_one_and_every_region_in_it(apartment):
    grid = draw(apartment)
    free = grid.clearance > RADIUS
    for x, y in apartment.targets.values():
        target = np.zeros_like(free)
        target[int(y / grid.resolution), int(x / grid.resolution)] = True
        assert np.all(np.isfinite(geodesic_distance(free, target, grid.resolution)[free]))
    for name, region in apartment.regions.items():
        if name != "Forbidden":
            assert np.all(free[signed_distance(region, grid.centres) > MARGIN]), name


def distances(apartment, names):
    """Free space without Forbidden, and the distance along it to the nearest of the named regions."""
    grid = draw(apartment)
    free = grid.clearance > RADIUS
    allowed = free.copy()
    if "Forbidden" in apartment.regions:
        allowed &= signed_distance(apartment.regions["Forbidden"], grid.centres) < -MARGIN
    inside = [signed_distance(apartment.regions[name], grid.centres) > MARGIN for name in names]
    distance = geodesic_distance(allowed, np.any(inside, axis=0) & allowed, grid.resolution)
    return free, inside, np.where(free, distance, np.inf)


def test_case_1_can_be_kept_with_slack_from_everywhere():
    free, _, distance = distances(APARTMENTS["case1"], ["Charger1", "Charger2"])
    assert np.mean(steps(distance[free]) <= 55) > 0.99


def test_case_2_can_be_kept_with_slack_from_nearly_everywhere():
    free, inside, first = distances(APARTMENTS["case2"], ["Region1"])
    assert np.mean(steps(first[free]) <= 45) > 0.96
    for here, there in (("Region1", "Region2"), ("Region2", "Region3")):
        _, (start, _), _ = distances(APARTMENTS["case2"], [here, there])
        _, _, onward = distances(APARTMENTS["case2"], [there])
        assert np.all(steps(onward[start]) <= 45)
    assert np.count_nonzero(inside[0]) > 300


def test_forbidden_lies_across_most_ways_to_the_pan_and_can_be_gone_around():
    apartment = APARTMENTS["case2"]
    grid = draw(apartment)
    free = grid.clearance > RADIUS
    forbidden = signed_distance(apartment.regions["Forbidden"], grid.centres) > 0
    x, y = apartment.targets["pan"]
    target = np.zeros_like(free)
    target[int(y / grid.resolution), int(x / grid.resolution)] = True
    straight = geodesic_distance(free, target, grid.resolution)
    around = geodesic_distance(free & ~forbidden, target, grid.resolution)
    outside = free & ~forbidden
    assert np.mean(forbidden[free]) < 0.04
    assert np.all(np.isfinite(around[outside]))
    assert np.mean(around[outside] > straight[outside] + grid.resolution) > 0.5
