"""The same street on another day: what must stay stays to the last bit, the rest changes as much as asked."""

import numpy as np
import pytest

from streetscan.classes import COLUMN, FACADE, VEGETATION
from streetscan.errors import BadInput
from streetscan.simulation import shapes
from streetscan.simulation.changes import Day, dress
from streetscan.simulation.drives import count_changes
from streetscan.simulation.layout import build_street

STREET = {"length_m": 120.0, "split": "test", "seed": 3, "time_span_s": (0.0, 1.0), "traffic_density": 0.3}
NOTHING = Day(season="summer", parked_cars=0.0, people=0.0, furniture_moved=0.0, furniture_gone=0.0, n_building_sites=0)


@pytest.fixture(scope="module")
def before():
    return build_street(**STREET)


@pytest.fixture(scope="module")
def after():
    return build_street(**STREET, day=Day())


def corners(mesh, instance):
    return mesh.vertices[mesh.triangles[mesh.instances == instance]]


def test_a_day_without_changes_is_the_maps_day_to_the_last_bit(before):
    same = build_street(**STREET, day=NOTHING)
    for name in ("vertices", "triangles", "labels", "instances", "materials", "colours"):
        assert np.array_equal(getattr(before.static, name), getattr(same.static, name)), name
    assert before.changes == []
    assert {row["change"] for row in same.changes} == {"same"}


def test_the_maps_day_does_not_depend_on_other_days_having_been_built(before, after):
    again = build_street(**STREET)
    assert np.array_equal(before.static.vertices, again.static.vertices)
    assert np.array_equal(before.static.colours, again.static.colours)
    assert all(np.array_equal(a.positions, b.positions) for a, b in zip(before.actors, again.actors, strict=True))
    assert len(after.static.vertices) != len(before.static.vertices)


def test_houses_columns_and_most_furniture_stay_to_the_last_bit(before, after):
    for label in (FACADE, COLUMN):
        ids = np.unique(before.static.instances[before.static.labels == label])
        assert len(ids) > 10
        for i in ids:
            is_label = [m.instances[m.labels == label] == i for m in (before.static, after.static)]
            a, b = (m.vertices[m.triangles[m.labels == label][k]] for m, k in zip((before.static, after.static), is_label, strict=True))
            assert np.array_equal(a, b)
    kept = [r for r in after.changes if r["change"] == "same" and r["class"] == "furniture"]
    assert len(kept) > 50
    for row in kept:
        assert row["instance"] == row["instance_before"]
        assert np.array_equal(corners(before.static, row["instance"]), corners(after.static, row["instance"]))


def test_as_much_changes_as_asked_and_the_table_says_what(before, after):
    counts = count_changes(after.changes)
    assert counts["column"]["share_same"] == 1.0
    assert counts["pedestrian"]["share_same"] == 0.0
    assert 0.1 < counts["car"]["share_same"] < 0.5  # 30 % of some 30 cars
    assert counts["car"]["other"] >= 10
    assert 0.7 < counts["furniture"]["share_same"] < 0.95
    assert counts["furniture"]["moved"] >= 3
    assert counts["furniture"]["new"] >= 10  # of the building site
    for row in after.changes:
        there = (after.static.instances == row["instance"]).any() if row["instance"] else False
        assert there == (row["change"] != "gone"), row
        if row["instance_before"]:
            assert (before.static.instances == row["instance_before"]).any()
        if row["change"] == "moved":
            assert 0.5 < row["moved_m"] < 4.5
    # No id means two things.
    now = [r["instance"] for r in after.changes if r["instance"]]
    assert len(set(now)) == len(now)


def test_share_of_cars_follows_the_setting():
    street = STREET | {"length_m": 360.0}
    shares = []
    for asked in (0.3, 0.7, 1.0):
        changes = build_street(**street, day=Day(parked_cars=asked, n_building_sites=0)).changes
        shares.append(1 - count_changes(changes)["car"]["share_same"])
    assert shares == pytest.approx([0.3, 0.7, 1.0], abs=0.12)


def test_traffic_and_people_are_others(before, after):
    places = [{tuple(np.round(a.positions[0], 3)) for a in s.actors} for s in (before, after)]
    assert not places[0] & places[1]


def test_blocks_of_one_day_fit_together():
    settings = STREET | {"length_m": 360.0}
    first, second = (build_street(**settings, block=i, day=Day()) for i in (0, 1))
    shared = [i for i in np.intersect1d(first.static.instances, second.static.instances) if i > 0 and i % 100_000 > 999]
    assert len(shared) > 10
    assert all(np.array_equal(corners(first.static, i), corners(second.static, i)) for i in shared)


def test_days_repeat_and_differ_by_their_number(after):
    again, other = (build_street(**STREET, day=Day(number=n)) for n in (1, 2))
    assert np.array_equal(after.static.vertices, again.static.vertices)
    assert after.changes == again.changes != other.changes


@pytest.mark.parametrize(("season", "low", "high"), [("summer", 1.0, 1.0), ("autumn", 0.5, 0.6), ("winter", 0.01, 0.06)])
def test_leaves_fall_and_the_trunk_stays(season, low, high):
    tree = shapes.make_object("lime", 300, np.random.default_rng(1))
    dressed = dress(tree, "lime", season, np.random.default_rng(2))
    leaf = tree.materials == tree.materials[-1]
    n_leaves = [(m.materials == tree.materials[-1]).sum() for m in (tree, dressed)]
    assert low <= n_leaves[1] / n_leaves[0] <= high
    assert (dressed.materials != tree.materials[-1]).sum() == (~leaf).sum()
    assert (dressed.labels == VEGETATION).any()
    conifer = shapes.make_object("conifer", 300, np.random.default_rng(1))
    assert dress(conifer, "conifer", season, np.random.default_rng(2)) is conifer


def test_an_unknown_season_is_refused():
    with pytest.raises(BadInput, match="'monsoon' is unknown"):
        Day(season="monsoon")
