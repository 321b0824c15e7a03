"""Objects of one frame: what stands apart is apart, what touches is one, walls are none."""

import numpy as np
import pytest
from street_frames import SENSOR_HEIGHT_M, pose, scan

from streetscan.errors import BadInput
from streetscan.geometry import transform
from streetscan.localization.ground import find_ground
from streetscan.localization.objects import ObjectSettings, find_objects


def seen(*boxes):
    """Objects of a frame with these boxes on a flat road."""
    points = scan(pose(0.0), np.array(boxes, float), np.random.default_rng(0), n_beams=64, n_azimuths=1800)[0]
    return find_objects(find_ground(points))


def test_a_pole_and_a_box_are_two_objects_with_their_sizes():
    found = seen((8, 4, 0, 8.2, 4.2, 5), (10, -5, 0, 11.0, -4, 0.9))
    assert len(found) == 2
    pole, box = found.objects.sizes_m[np.argsort(-found.objects.centres[:, 1])]
    assert pole[:2].max() < 0.4
    # Cut at 2.5 m above the road, where a sensor 9 m away sees 2.1.
    assert 1.8 < pole[2] < 2.5
    assert np.isclose(box[2], 0.8, atol=0.12)
    assert (np.abs(found.points[:, 2] + SENSOR_HEIGHT_M) > 0.09).all()


def test_touching_things_are_one_object_and_a_gap_parts_them():
    assert len(seen((8, 3, 0, 9, 4, 1), (9.0, 3, 0, 10, 4, 1.2))) == 1
    assert len(seen((8, 3, 0, 9, 4, 1), (8, 4.6, 0, 9, 5.6, 1.2))) == 2


def test_a_crown_above_the_cut_joins_nothing():
    found = seen((8, 3, 0, 8.2, 3.2, 3), (8, 5, 0, 8.2, 5.2, 3), (7.8, 2.8, 2.6, 8.4, 5.4, 4))
    assert len(found) == 2


def test_walls_are_no_objects():
    assert len(seen((-20, 9, 0, 20, 10, 6))) == 0


def test_objects_turn_with_the_frame_they_are_described_in():
    points = scan(pose(0.0), np.array([(8, 4, 0, 9.2, 4.5, 1.0)]), np.random.default_rng(0), n_beams=64, n_azimuths=1800)[0]
    ground = find_ground(points)
    plain, lifted = find_objects(ground), find_objects(ground, T_level_lidar=transform([0, 0, 5.0]))
    assert np.allclose(plain.objects.centres + [0, 0, 5], lifted.objects.centres)
    assert (plain.rows == lifted.rows).all()


def test_nothing_is_found_in_nothing():
    assert len(find_objects(find_ground(np.empty((0, 3))))) == 0


def test_heights_in_a_wrong_order_are_refused():
    with pytest.raises(BadInput, match="max_height_m"):
        ObjectSettings(max_height_m=0.2)
