"""The city's generator makes what its version has always made: every number measured in the city rests on it.

When a test here fails, the city has changed: undo the change, or raise GENERATOR_VERSION and VERSION, put the new
figures here and make every number of the city again.
"""

import numpy as np
import pytest

from streetscan import classes
from streetscan.simulation.colouring import Cameras
from streetscan.simulation.layout import GENERATOR_VERSION, build_street
from streetscan.simulation.receiver import Receiver
from streetscan.simulation.recording import Errors, record_street
from streetscan.simulation.sensors import mobile_mapper

# A recording's sums hardly show a noise that grows, so the settings are written out.
SETTINGS = (
    Receiver(1.5, 200.0, 50.0, 0.005, 0.3, 6, 0.6, 5, 35.0, 1.0, 1550, "first", 0.0),
    Cameras((0.3, 0.0, 2.4), 0.25, 0.12, 0.15, 0.04, 5.0),
    Errors(0.03, (0.02, 0.10), 0.01, 0.01),
)
LENGTH_M, SPLIT, SEED = 28.0, "test", 1
VERSION = 2
SCENE = {
    "n_actors": 98,
    "n_instances": 210,
    "triangles": [15780, 100952, 0, 2108, 27962, 13332, 148677, 8842, 8336],
    "colours": 101258678,
    "materials": 5863534,
    "vertices_m": [-9045106.463142773, -7978859.976626361, 3331390.7888185196],
    "paths_m": [-481.16479081846774, -504.1393950151105, 29.93056463029083],
}
RECORDING = {
    "points": [6951, 4331, 3154, 457, 29, 221, 347, 145, 37],
    "middle_m": [689997.119550071, 239986.24356899865, 113.52561143042729],
    "intensity": 1712.6405811878665,
    "rgb": [112.61693856742289, 103.70386184042825, 100.50216670915115],
}


def test_receiver_cameras_and_navigation_are_those_of_their_version():
    assert (Receiver(), Cameras(), Errors()) == SETTINGS
    assert GENERATOR_VERSION == VERSION


def test_what_stands_and_moves_is_that_of_its_version():
    scene, expected = build_street(LENGTH_M, SPLIT, SEED, block=0), SCENE
    static, start = scene.static, scene.roads[0][0]
    assert len(scene.actors) == expected["n_actors"]
    assert len(np.unique(static.instances)) == expected["n_instances"]
    assert np.bincount(static.labels, minlength=classes.N_CLASSES)[: classes.N_CLASSES].tolist() == expected["triangles"]
    assert [int(v.sum(dtype=np.int64)) for v in (static.colours, static.materials)] == [expected["colours"], expected["materials"]]
    paths = np.sum([a.positions.mean(axis=0) - start for a in scene.actors], axis=0)
    # Sums over a million corners: a lamp that moves by a centimetre shows.
    np.testing.assert_allclose((static.vertices - start).sum(axis=0), expected["vertices_m"], rtol=1e-8)
    np.testing.assert_allclose(paths, expected["paths_m"], rtol=1e-8)


def test_what_is_recorded_is_that_of_its_version():
    expected = RECORDING
    scanners = mobile_mapper(lines_per_s=20.0, pulses_per_s=2000.0)
    records = list(record_street(SPLIT, SEED, {"length_m": LENGTH_M}, scanners, Receiver(), Cameras(), Errors()))
    fields = {name: np.concatenate([r.cloud.fields[name] for r in records]) for name in ("intensity", "rgb")}
    points = np.bincount(np.concatenate([r.labels for r in records]), minlength=classes.N_CLASSES)[: classes.N_CLASSES]
    # Ray casters of other processors round otherwise: a grazing pulse may meet another object there.
    np.testing.assert_allclose(points, expected["points"], atol=2)
    np.testing.assert_allclose(np.concatenate([r.cloud.points for r in records]).mean(axis=0), expected["middle_m"], atol=0.01)
    assert fields["intensity"].mean() == pytest.approx(expected["intensity"], rel=1e-4)
    np.testing.assert_allclose(fields["rgb"].mean(axis=0), expected["rgb"], rtol=1e-3)
