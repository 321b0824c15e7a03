"""Where pulses go, and what becomes of their echoes."""

import numpy as np
import pytest

from streetscan.classes import FACADE, GROUND, VEGETATION
from streetscan.simulation.meshes import Surface, box, quads, triangle_soup
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.receiver import Receiver, measure
from streetscan.simulation.scene import Mesh, Scene, join_meshes
from streetscan.simulation.sensors import ProfileScanner, StaticScanner, hits_own_vehicle, mobile_mapper


def wall(x_m: float, material: str = "plaster", y_m: tuple[float, float] = (-50.0, 50.0), label: int = FACADE) -> Mesh:
    corners = [[[x_m, y_m[0], -50], [x_m, y_m[1], -50], [x_m, y_m[1], 50], [x_m, y_m[0], 50]]]
    return quads(np.array(corners), Surface(label, material, (200, 200, 200)))


def shoot(mesh: Mesh, directions, receiver: Receiver, seed: int = 0):
    directions = np.asarray(directions, np.float32).reshape(-1, 3)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    caster = SceneCaster(Scene(mesh))
    n = len(directions)
    return caster, measure(caster, np.zeros((n, 3)), directions, np.arange(n) * 1e-5, receiver, np.random.default_rng(seed))


def test_a_profile_scanner_sweeps_a_plane_through_unit_vectors():
    scanner = ProfileScanner((0, 0, 2), 45.0, 30.0, 100.0, 10_000.0)
    times = np.arange(100) / 10_000.0
    directions = scanner.directions(times)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    assert np.linalg.matrix_rank(directions, tol=1e-4) == 2
    # One revolution is one line: the next one repeats it.
    np.testing.assert_allclose(scanner.directions(times + 0.01), directions, atol=1e-5)
    # It starts pointing down, and with the top leaning forward that is behind the mirror.
    assert directions[0, 2] == pytest.approx(-np.cos(np.radians(30)), abs=1e-6)
    assert directions[0, 0] < 0


def test_the_planes_of_a_mobile_mapper_cross():
    left, right = mobile_mapper(yaw_deg=45, tilt_deg=0)
    normals = [np.cross(s.directions(np.zeros(1)), s.directions(np.array([0.25 / s.lines_per_s])))[0] for s in (left, right)]
    assert abs(np.dot(*normals)) == pytest.approx(0, abs=1e-5)


def test_the_own_roof_is_cut_out():
    directions = np.array([[0.3, 0, -0.5], [-0.5, 0, -0.5], [0, 1, -0.1], [0, 0, 1]], np.float32)
    assert hits_own_vehicle((-2.4, 0.35, 2.7), directions).tolist() == [True, False, False, False]


def test_a_static_scanner_covers_its_field_of_view_evenly():
    scanner = StaticScanner(step_deg=1.0, low_deg=-40, high_deg=60)
    directions = scanner.directions(0, scanner.n_columns)
    assert directions.shape == (360 * 101, 3)
    elevations = np.degrees(np.arcsin(directions[:, 2]))
    assert elevations.min() == pytest.approx(-40, abs=1e-3)
    assert elevations.max() == pytest.approx(60, abs=1e-3)
    np.testing.assert_array_equal(scanner.directions(7, 2), directions[7 * 101 : 9 * 101])


def test_range_noise_is_what_was_asked_for():
    fan = np.c_[np.ones(20_000), np.linspace(-0.2, 0.2, 20_000), np.zeros(20_000)]
    _, returns = shoot(wall(10.0), fan, Receiver(range_noise_m=0.005))
    true = 10 * np.linalg.norm(fan, axis=1)[returns.pulses]
    residuals = returns.ranges_m - true
    assert residuals.std() == pytest.approx(0.005, rel=0.08)
    assert abs(residuals.mean()) < 2e-4
    assert len(returns) == 20_000


def test_dark_surfaces_are_heard_to_the_range_the_receiver_names():
    # Cloth of reflectance 0.25 against the 0.10 of the definition: sqrt(2.5) times as far.
    receiver = Receiver(dark_range_m=20.0, n_subrays=0)
    limit = 20 * np.sqrt(2.5)
    near, far = (len(shoot(wall(x, "cloth_dark"), np.tile([1.0, 0, 0], (400, 1)), receiver)[1]) for x in (0.7 * limit, 1.5 * limit))
    assert (near, far) == (400, 0)
    # At the limit itself fading decides.
    assert 120 < len(shoot(wall(limit, "cloth_dark"), np.tile([1.0, 0, 0], (400, 1)), receiver)[1]) < 280


def shares_heard(material: str, range_m: float, degrees: list[float], n: int = 2000) -> list[float]:
    """Share of the pulses heard from a wall at one range under several angles of incidence."""
    shares = []
    for angle in np.radians(degrees):
        fan = np.tile([np.cos(angle), np.sin(angle), 0], (n, 1))
        _, returns = shoot(wall(range_m * np.cos(angle), material, (-200.0, 200.0)), fan, Receiver(n_subrays=0))
        shares.append(len(returns) / n)
    return shares


def test_scanners_lose_what_they_are_known_to_lose():
    # Panes answer squarely, mirror-like, and otherwise only near by.
    assert shares_heard("glass", 12.0, [0, 30, 60]) == [1, 0, 0]
    # Black cars fade with the angle and the distance, white ones do not.
    assert shares_heard("paint_white", 15.0, [0, 30, 60, 75]) == [1, 1, 1, 1]
    black = shares_heard("paint_black", 10.0, [0, 30, 60, 75])
    assert black[1] > 0.9 > black[2] > black[3]
    assert shares_heard("paint_black", 25.0, [30, 60]) == [0, 0]
    # A wet road is seen beneath the scanner and no longer ten metres away, a dry one is.
    assert shares_heard("wet_asphalt", 3.0, [20])[0] == 1
    assert shares_heard("wet_asphalt", 10.0, [75]) == [0]
    assert shares_heard("asphalt", 10.0, [75]) == [1]


def test_the_echoes_of_one_surface_scatter_as_asked():
    _, returns = shoot(wall(10.0), np.tile([1.0, 0, 0], (4000, 1)), Receiver(n_subrays=0, fading_db=1.5))
    assert returns.intensities.std() == pytest.approx(150, rel=0.05)


def test_returns_fade_with_incidence():
    receiver = Receiver(dark_range_m=20.0, n_subrays=0, fading_db=0.1)
    counts = []
    for degrees in (0, 70, 80):
        angle = np.radians(degrees)
        # The same range under every angle: the wall comes nearer as the ray turns.
        counts.append(len(shoot(wall(25 * np.cos(angle), "cloth_dark"), np.tile([np.cos(angle), np.sin(angle), 0], (500, 1)), receiver)[1]))
    assert counts == [500, 0, 0]


def test_intensity_falls_with_range_and_saturates():
    receiver = Receiver(n_subrays=0, saturation_db=35.0, fading_db=0.1)
    at = {x: shoot(wall(x), np.tile([1.0, 0, 0], (500, 1)), receiver)[1].intensities.mean() for x in (5.0, 10.0, 20.0)}
    assert at[5.0] - at[10.0] == pytest.approx(602, abs=10)  # 6.02 dB per doubling
    assert at[10.0] - at[20.0] == pytest.approx(602, abs=10)
    saturated = shoot(wall(3.0, "retroreflector"), np.tile([1.0, 0, 0], (50, 1)), receiver)[1]
    assert set(saturated.intensities.tolist()) == {3500}


def test_an_edge_closer_than_the_resolution_makes_mixed_pixels_and_a_farther_one_two_returns():
    # A half plane whose edge lies in the middle of the beam, with a wall behind it.
    receiver = Receiver(range_noise_m=0.0, beam_divergence_mrad=2.0, resolution_m=0.6)
    beam = [[1.0, 0.0, 0.0]]
    for behind, n in ((0.3, 1), (2.0, 2)):
        _, returns = shoot(join_meshes([wall(10.0, y_m=(0.001, 50.0)), wall(10.0 + behind)]), beam, receiver)
        assert len(returns) == n
        assert returns.n_returns.tolist() == [n] * n
        assert returns.return_numbers.tolist() == list(range(1, n + 1))
        if n == 1:
            assert 10.02 < returns.ranges_m[0] < 10.28
        else:
            np.testing.assert_allclose(returns.ranges_m, [10, 12], atol=0.01)


def test_glass_lets_the_pulse_go_on():
    caster, returns = shoot(join_meshes([wall(10.0, "glass"), wall(14.0, "interior", label=GROUND)]), [[1.0, 0, 0]], Receiver())
    assert caster.labels[returns.faces].tolist() == [FACADE, GROUND]
    np.testing.assert_allclose(returns.ranges_m, [10, 14], atol=0.05)
    # Seen slantwise the pane mirrors the pulse away, and only what lies behind it answers.
    caster, returns = shoot(join_meshes([wall(20.0, "glass"), wall(21.0, "interior", label=GROUND)]), [[1.0, 1.0, 0]], Receiver())
    assert caster.labels[returns.faces].tolist() == [GROUND]


def test_foliage_is_penetrated_and_answers_several_times():
    rng = np.random.default_rng(3)
    centres = rng.uniform([8, -2, -2], [12, 2, 2], (2500, 3))
    crown = triangle_soup(centres[:, None] + rng.normal(0, 0.03, (2500, 3, 3)), Surface(VEGETATION, "leaves", (60, 110, 40)))
    y, z = np.meshgrid(np.linspace(-1.5, 1.5, 60), np.linspace(-1.5, 1.5, 60))
    fan = np.c_[np.full(3600, 10.0), y.ravel(), z.ravel()]
    caster, returns = shoot(join_meshes([crown, wall(15.0)]), fan, Receiver(beam_divergence_mrad=3.0))
    labels = caster.labels[returns.faces]
    assert (labels == VEGETATION).sum() > 500
    assert (labels == FACADE).sum() > 500
    assert (returns.n_returns > 1).mean() > 0.1
    assert returns.ranges_m[labels == VEGETATION].std() > 0.5
    firsts = returns.return_numbers == 1
    assert len(np.unique(returns.pulses)) == firsts.sum()
    assert (np.diff(returns.pulses) >= 0).all()


def test_ranges_outside_the_gates_are_not_recorded():
    for x in (1.0, 250.0):
        assert len(shoot(wall(x, "retroreflector"), [[1.0, 0, 0]], Receiver(min_range_m=1.5, max_range_m=200, dark_range_m=1000))[1]) == 0


def test_an_empty_batch_has_no_return():
    assert len(shoot(box((1, 1, 1), (2, 2, 2), Surface(FACADE, "brick", (0, 0, 0))), np.empty((0, 3)), Receiver())[1]) == 0
