"""Pictures of scenes whose image is known: where edges lie, what blurs, what the masks say, light and shadow."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from streetscan.classes import CAR, FACADE, GROUND
from streetscan.errors import BadInput
from streetscan.simulation.camera import (
    AutoExposure,
    Camera,
    mount_camera,
    pixel_rays,
    project,
    render,
    settle_exposure,
)
from streetscan.simulation.daylight import HARD_DAYLIGHT, Daylight
from streetscan.simulation.meshes import Surface, box, join, quads
from streetscan.simulation.raycasting import SceneCaster
from streetscan.simulation.recording import Trajectory
from streetscan.simulation.scene import Actor, Mesh, Scene

SMALL = Camera(width=240, height=180, focal_px=180.0, distortion=(-0.2, 0.05, 1e-3, -8e-4), exposure_s=(1e-3, 1e-3))
# No noise to speak of, and enough rays to place an edge to a hundredth of a pixel.
EXACT = Camera(**{**SMALL.__dict__, "full_well": 1e12, "read_noise": 0.0, "edge_rays": 60, "blur_rays": 60})
AHEAD = mount_camera((0.0, 0.0, 0.0))
CLEAR = Daylight(sun_azimuth_deg=180.0, sun_elevation_deg=40.0, clouds=0.0)
BLACK = Surface(FACADE, "rubber", (0, 0, 0))


def still(position=(0.0, 0.0, 2.0)) -> Trajectory:
    return Trajectory(0.0, np.tile(np.asarray(position, float), (401, 1)), np.tile(np.eye(3), (401, 1, 1)))


def moving(velocity, position=(0.0, 0.0, 2.0), mid_s: float = 1.0) -> Trajectory:
    """Where `position` is reached at mid_s."""
    times = np.arange(401)[:, None] / 200.0
    return Trajectory(0.0, np.asarray(position, float) + (times - mid_s) * np.asarray(velocity, float), np.tile(np.eye(3), (401, 1, 1)))


def take(scene: Scene, camera: Camera, trajectory: Trajectory, T=AHEAD, seed=1, exposure_s=1e-3, daylight=CLEAR, mid_s=1.0):
    caster = SceneCaster(scene, 0.5, 1.5)
    return render(caster, trajectory, T, camera, mid_s, AutoExposure(exposure_s), np.random.default_rng(seed), daylight)


def linear(rgb: np.ndarray) -> np.ndarray:
    v = rgb[..., 1] / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def plate(x: float, y: float, z: float, size: float, surface: Surface = BLACK, instance: int = 7) -> Mesh:
    """A square plate that faces the camera, its middle at (x, y, z)."""
    h = size / 2
    mesh = quads(np.array([[[x, y + h, z - h], [x, y - h, z - h], [x, y - h, z + h], [x, y + h, z + h]]]), surface)
    mesh.instances[:] = instance
    return mesh


def level(low: float, high: float, z: float, surface: Surface) -> Mesh:
    """A level square from (low, low) to (high, high)."""
    return quads(np.array([[[low, low, z], [high, low, z], [high, high, z], [low, high, z]]]), surface)


def floor() -> Mesh:
    """Something out of view: a scene needs a mesh."""
    return level(-9.0, -8.0, -400.0, BLACK)


def outline_middle(x: float, y: float, z: float, size: float, camera: Camera, camera_position=(0.0, 0.0, 2.0)) -> np.ndarray:
    """Centroid, in pixels, of the area the plate's distorted outline encloses."""
    u = np.linspace(-0.5, 0.5, 200, endpoint=False)
    side = [(u, -0.5 + 0 * u), (0.5 + 0 * u, u), (-u, 0.5 + 0 * u), (-0.5 + 0 * u, -u)]
    yz = np.concatenate([np.stack(s, axis=1) for s in side]) * size
    points = np.column_stack([np.full(len(yz), x), y + yz[:, 0], z + yz[:, 1]]) - camera_position
    p = project(points @ AHEAD[:3, :3], camera.model)
    q = np.roll(p, -1, axis=0)
    cross = p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]
    return ((p + q) * cross[:, None]).sum(axis=0) / (3 * cross.sum())


def shaded_middle(with_plate: np.ndarray, without: np.ndarray) -> np.ndarray:
    """Centroid, in pixels, of the light a black plate takes away."""
    covered = 1 - linear(with_plate) / linear(without)
    covered[covered < 0.02] = 0
    v, u = np.indices(covered.shape)
    return np.array([(u * covered).sum(), (v * covered).sum()]) / covered.sum()


def test_the_lens_is_the_plumb_bob_model_and_its_inverse():
    model = Camera().model
    points = np.random.default_rng(0).uniform([-0.64, -0.48, 1], [0.64, 0.48, 1], (500, 3)) * 7
    pixels = project(points, model)
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), model.K, model.D)[0][:, 0]
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(pixel_rays(pixels, model), points[:, :2] / points[:, 2:], atol=1e-9)
    assert np.isnan(project(np.array([[0.0, 0, -1], [0, 0, 0]]), model)).all()


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        ({"exposure_s": (8e-3, 5e-5)}, "shortest exposure first"),
        ({"distortion": (-0.35, 0.0, 0.0, 0.0)}, "nothing beyond 651 pixels"),
        ({"focal_px": 500.0, "distortion": (-0.3, 0.04, 0.0, 0.0)}, "nothing beyond"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(settings, found):
    with pytest.raises(BadInput, match=found):
        Camera(**settings)


@pytest.mark.parametrize(
    "settings", [{}, {"distortion": (0.3, 0.0, 0.0, 0.0)}, {"focal_px": 1500.0, "distortion": (-0.35, 0.0, 1e-3, 0.0)}]
)
def test_every_pixel_of_a_lens_that_can_be_has_a_ray(settings):
    camera = Camera(**settings)
    border = np.array([[u, v] for u in range(0, camera.width, 7) for v in (0, camera.height - 1)])
    rays = np.column_stack([pixel_rays(border, camera.model), np.ones(len(border))])
    np.testing.assert_allclose(project(rays, camera.model), border, atol=1e-6)


@pytest.mark.parametrize("place", [(60.0, 0.0, 2.0), (60.0, 27.0, 18.0), (60.0, -29.0, 20.0), (60.0, -28.0, -14.0)])
def test_a_plate_is_seen_where_the_model_projects_it(place):
    with_plate, without = (take(Scene(m), EXACT, still()).rgb for m in (join([floor(), plate(*place, 8.0)]), floor()))
    np.testing.assert_allclose(shaded_middle(with_plate, without), outline_middle(*place, 8.0, EXACT), atol=0.05)


def crossing(picture: np.ndarray, near: np.ndarray, reach: int = 5) -> np.ndarray:
    """Where the upright and the level edge of four squares, two of them black, cross; in pixels, from the area that is light.

    OpenCV's cornerSubPix is up to 0.08 pixels off where pixels are sharp squares.
    """
    column, row = np.round(near).astype(int)
    window = picture[row - reach : row + reach + 1, column - reach : column + reach + 1]
    light = np.clip((window - window.min()) / (np.median(window[window > window.max() / 2]) - window.min()), 0, 1)
    steps = np.delete(np.arange(-reach, reach + 1), reach)
    lines = []
    for share in (light, light.T):
        share = np.delete(share, reach, axis=0)
        edges = np.where(share[:, 0] < 0.5, reach + 0.5 - share.sum(axis=1), share.sum(axis=1) - reach - 0.5)
        lines.append(np.polyfit(steps, edges, 1))
    (b, a), (d, c) = lines
    return np.array([column, row]) + np.linalg.solve([[1, -b], [-d, 1]], [a, c])


@pytest.mark.parametrize("place", [(40.0, 0.3, 2.1), (40.0, 18.0, 12.0), (40.0, -19.0, -9.0)])
def test_a_corner_is_seen_where_the_model_projects_it(place):
    x, y, z = place
    white = Surface(FACADE, "plaster", (230, 230, 230))
    squares = [plate(x, y + 3 * a, z + 3 * b, 6.0, BLACK if a == b else white) for a in (-1, 1) for b in (-1, 1)]
    picture = linear(take(Scene(join([floor(), *squares])), EXACT, still(), daylight=replace(CLEAR, wall_contrast=0.0)).rgb)
    expected = project((np.array([place]) - [0, 0, 2]) @ AHEAD[:3, :3], EXACT.model)[0]
    np.testing.assert_allclose(crossing(picture, expected), expected, atol=0.05)


@pytest.mark.parametrize("speed_mps", [30.0, -30.0])
def test_a_passed_edge_blurs_about_where_it_is_at_mid_exposure(speed_mps):
    camera = Camera(**{**EXACT.__dict__, "exposure_s": (0.05, 0.05), "saturation_s": 0.06})
    place, trajectory = (30.0, 0.0, 2.0), moving((0, speed_mps, 0))
    with_plate, without = (take(Scene(m), camera, trajectory, exposure_s=0.05).rgb for m in (join([floor(), plate(*place, 6.0)]), floor()))
    np.testing.assert_allclose(shaded_middle(with_plate, without), outline_middle(*place, 6.0, camera), atol=0.15)
    # 1.5 m in 30 m: the edges spread over 9 pixels, so this many columns are neither light nor dark.
    row = (1 - linear(with_plate) / linear(without))[90]
    assert 12 <= ((row > 0.05) & (row < 0.95)).sum() <= 22


def test_a_moving_thing_blurs_and_a_standing_one_beside_it_does_not():
    camera = Camera(**{**EXACT.__dict__, "exposure_s": (0.05, 0.05), "saturation_s": 0.06})
    body = plate(0, 0, 0, 4.0, instance=9)
    times = np.array([0.0, 2.0])
    mover = Actor(body, times, np.array([[30.0, -20 - 6, 2], [30, 20 - 6, 2]]), np.zeros(2))
    standing = plate(30.0, 6.0, 2.0, 4.0)
    picture = take(Scene(join([floor(), standing]), [mover]), camera, still(), exposure_s=0.05)
    without = take(Scene(floor()), camera, still(), exposure_s=0.05)
    covered = 1 - linear(picture.rgb) / linear(without.rgb)
    half_covered = (covered[90] > 0.1) & (covered[90] < 0.9)
    is_left = np.arange(camera.width) < camera.width / 2
    assert half_covered[is_left].sum() <= 2
    assert half_covered[~is_left].sum() >= 8
    covered[:, is_left] = 0
    middle = (np.arange(camera.width) * covered[60:120].sum(axis=0)).sum() / covered[60:120].sum()
    assert middle == pytest.approx(outline_middle(30.0, -6.0, 2.0, 4.0, camera)[0], abs=0.2)


def test_masks_are_the_objects_hit_at_mid_exposure():
    rng = np.random.default_rng(3)
    things = [plate(20.0 + i, *rng.uniform([-8, -2], [8, 6]), 3.0, Surface(CAR, "paint_dark", (80, 80, 90)), 10 + i) for i in range(8)]
    scene = Scene(join([floor(), *things]), [])
    trajectory = moving((8.0, 0, 0))
    picture = take(scene, SMALL, trajectory, exposure_s=0.008)
    pixels = np.stack([rng.integers(0, SMALL.width, 500), rng.integers(0, SMALL.height, 500)], axis=1)
    xy = pixel_rays(pixels, SMALL.model)
    rays = np.column_stack([xy, np.ones(len(xy))]) @ AHEAD[:3, :3].T
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    caster = SceneCaster(scene, 0.5, 1.5)
    hits = caster.cast(np.tile([0.0, 0, 2], (len(rays), 1)), rays, np.full(len(rays), 1.0))
    seen = picture.instances[pixels[:, 1], pixels[:, 0]], picture.classes[pixels[:, 1], pixels[:, 0]]
    np.testing.assert_array_equal(seen[0], np.where(hits.faces >= 0, caster.instances[hits.faces], 0))
    np.testing.assert_array_equal(seen[1], np.where(hits.faces >= 0, CAR, 255))
    assert len(np.unique(seen[0])) > 5
    assert (picture.rgb.dtype, picture.instances.dtype, picture.classes.dtype) == (np.uint8, np.uint32, np.uint8)


def test_a_seed_repeats_a_picture():
    scene = Scene(join([floor(), plate(20.0, 0, 2, 6.0, Surface(FACADE, "brick", (150, 82, 62)))]))
    a, b, c = (take(scene, SMALL, moving((5.0, 1, 0)), seed=s).rgb for s in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert (a != c).mean() > 0.1


def sample(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    return cv2.remap(image.astype(np.float32), pixels[None].astype(np.float32), None, cv2.INTER_LINEAR)[0]


@pytest.mark.parametrize("material", ["plaster", "brick", "asphalt", "stone", "painted_metal"])
def test_a_point_has_one_colour_from_everywhere(material):
    camera = Camera(width=480, height=360, focal_px=400.0, exposure_s=(1e-3, 1e-3), full_well=1e9, read_noise=0.0)
    wall = join([floor(), plate(8.0, 0, 2, 6.0, Surface(FACADE, material, (150, 140, 120)))])
    points = np.column_stack([np.full(3000, 8.0), *np.random.default_rng(1).uniform([-2.4, -0.4], [2.4, 4.4], (3000, 2)).T])
    values = []
    for position in ((0.0, 0.0, 2.0), (0.4, 0.6, 2.3)):
        pixels = project((points - position) @ AHEAD[:3, :3], camera.model)
        values.append(sample(linear(take(Scene(wall), camera, still(position)).rgb), pixels))
    assert np.corrcoef(*values)[0, 1] > 0.93
    assert values[0].std() > 0.05 * values[0].mean()


def test_the_pattern_of_a_moving_thing_moves_with_it():
    camera = Camera(width=480, height=360, focal_px=400.0, exposure_s=(1e-3, 1e-3), full_well=1e9, read_noise=0.0)
    body = plate(0.0, 0, 0, 3.0, Surface(CAR, "plaster", (180, 170, 150)))
    mover = Actor(body, np.array([0.0, 2.0]), np.array([[8.0, -2, 2], [8.0, 2, 2]]), np.zeros(2))
    offsets = np.random.default_rng(2).uniform(-1.2, 1.2, (2000, 2))
    values = []
    for mid_s in (0.8, 1.2):
        picture = take(Scene(floor(), [mover]), camera, still(), mid_s=mid_s, exposure_s=1e-4)
        points = np.column_stack([np.full(2000, 8.0), offsets + [-2 + 2 * mid_s, 2.0]])
        values.append(sample(linear(picture.rgb), project((points - [0, 0, 2]) @ AHEAD[:3, :3], camera.model)))
    assert np.corrcoef(*values)[0, 1] > 0.9


def test_what_is_finer_than_a_pixel_does_not_flicker():
    """Far away the pattern is faint, and next to no different a third of a pixel further on."""
    camera = Camera(width=160, height=120, focal_px=200.0, distortion=(0, 0, 0, 0), exposure_s=(1e-3, 1e-3), full_well=1e9, read_noise=0.0)
    wall = Scene(join([floor(), plate(150.0, 0, 2, 90.0, Surface(FACADE, "brick", (150, 100, 90)))]))
    a, b = (linear(take(wall, camera, still((0.0, y, 2.0))).rgb)[40:80, 50:110] for y in (0.0, 0.25))
    near = Scene(join([floor(), plate(4.0, 0, 2, 3.0, Surface(FACADE, "brick", (150, 100, 90)))]))
    close = linear(take(near, camera, still()).rgb)[40:80, 50:110]
    assert a.std() / a.mean() < 0.5 * close.std() / close.mean()
    assert (a - b).std() < 0.5 * a.std() + 0.004


def test_noise_is_that_of_electrons():
    camera = Camera(**{**SMALL.__dict__, "full_well": 2000.0, "read_noise": 10.0})
    many = np.stack([linear(take(Scene(floor()), camera, still(), seed=s).rgb) for s in range(12)])
    electrons = many[:, 60:90, 100:140] * 2000
    expected = np.sqrt(electrons.mean(axis=0) + 100)
    assert electrons.std(axis=0, ddof=1).mean() == pytest.approx(expected.mean(), rel=0.1)


def test_the_automatic_finds_the_exposure_in_light_and_in_shade():
    camera = Camera(**{**SMALL.__dict__, "exposure_s": (5e-5, 8e-3)})
    bright = Scene(join([floor(), plate(20.0, 0, 2, 60.0, Surface(FACADE, "plaster", (230, 230, 225)))]))
    dark = Scene(join([floor(), plate(20.0, 0, 2, 60.0, Surface(FACADE, "rubber", (40, 40, 40)))]))
    chosen = []
    for scene in (bright, dark):
        caster = SceneCaster(scene, 0.5, 1.5)
        auto = settle_exposure(caster, still(), AHEAD, camera, 1.0, CLEAR)
        chosen.append(auto.exposure_s * auto.gain)
        picture = render(caster, still(), AHEAD, camera, 1.0, auto, np.random.default_rng(0), CLEAR)
        assert linear(picture.rgb).mean() == pytest.approx(camera.target, rel=0.35)
        assert auto.exposure_s * auto.gain == pytest.approx(chosen[-1], rel=0.25)
    assert chosen[1] > 4 * chosen[0]
    # After a jump into the dark it takes some pictures.
    auto, values = AutoExposure(chosen[0]), []
    for _ in range(8):
        picture = render(SceneCaster(dark, 0.5, 1.5), still(), AHEAD, camera, 1.0, auto, np.random.default_rng(0), CLEAR)
        values.append(linear(picture.rgb).mean())
    assert values[0] < 0.3 * camera.target
    assert values[1] > values[0]
    assert values[-1] == pytest.approx(camera.target, rel=0.4)


def test_gain_comes_after_the_longest_exposure():
    auto, camera = AutoExposure(4e-3), Camera(exposure_s=(1e-4, 8e-3), largest_gain=4.0)
    auto.adjust(2.0, camera)
    assert (auto.exposure_s, auto.gain) == (pytest.approx(8e-3), 1.0)
    auto.adjust(3.0, camera)
    assert (auto.exposure_s, auto.gain) == (pytest.approx(8e-3), pytest.approx(3.0))
    auto.adjust(10.0, camera)
    assert auto.gain == 4.0
    auto.adjust(1 / 16, camera)
    assert (auto.exposure_s, auto.gain) == (pytest.approx(2e-3), 1.0)


def test_a_box_throws_its_shadow_away_from_the_sun():
    ground = level(-50.0, 50.0, 0.0, Surface(GROUND, "concrete", (140, 140, 140)))
    pole = box((11.5, -0.5, 0), (12.5, 0.5, 4), Surface(FACADE, "concrete", (140, 140, 140)))
    sun = Daylight(sun_azimuth_deg=90.0, sun_elevation_deg=45.0, clouds=0.0)  # to the left: the shadow falls to the right, 4 m long
    picture = linear(take(Scene(join([ground, pole])), SMALL, still(), exposure_s=4e-4, daylight=sun).rgb)

    def brightness(x, y):
        u, v = np.round(project((np.array([[x, y, 0.0]]) - [0, 0, 2]) @ AHEAD[:3, :3], SMALL.model)[0]).astype(int)
        return picture[v - 1 : v + 2, u - 2 : u + 3].mean()

    assert brightness(12, -2.5) < 0.5 * brightness(12, 2.5)
    assert brightness(12, -6.0) > 0.7 * brightness(12, 2.5)


def test_low_sun_saturates_and_a_dark_day_does_not():
    facing = Daylight(sun_azimuth_deg=0.0, sun_elevation_deg=6.0, clouds=0.0)
    ground = Scene(level(-80.0, 80.0, 0.0, Surface(GROUND, "asphalt", (82, 82, 84))))
    low, overcast = (take(ground, SMALL, still(), daylight=d, exposure_s=1.2e-3).rgb for d in (facing, HARD_DAYLIGHT["overcast"]))
    is_white = (low == 255).all(axis=2)
    assert is_white.sum() > 20
    v, u = (int(np.median(c)) for c in np.nonzero(is_white))
    expected = project(np.array([facing.sun_direction]) @ AHEAD[:3, :3], SMALL.model)[0]
    np.testing.assert_allclose([u, v], expected, atol=8)
    assert (overcast == 255).all(axis=2).sum() == 0


def test_a_bare_wall_shows_next_to_nothing():
    camera = Camera(**{**SMALL.__dict__, "full_well": 1e9, "read_noise": 0.0})
    wall = Scene(join([floor(), plate(8.0, 0, 2, 20.0, Surface(FACADE, "plaster", (150, 140, 120)))]))
    plain, rich = (linear(take(wall, camera, still(), daylight=d).rgb) for d in (HARD_DAYLIGHT["bare_walls"], CLEAR))
    assert plain[40:140, 60:180].std() < 0.1 * rich[40:140, 60:180].std()
