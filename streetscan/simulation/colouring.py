"""The colours a mobile mapper's cameras give to its points, with the faults such colours have.

A point takes the colour of what a camera sees in its direction: from the camera's own place, at the time of the
nearest picture, with a small error of orientation. So facades behind a passing bus turn blue, edges bleed, what the
camera cannot see takes the colour of what hides it, and sides of the street differ in exposure.

Source: Nagy (2020), 2.5.3 and 5.1: "because of several occlusion and illumination artifacts this color information is
often unreliable".
"""

from dataclasses import dataclass

import numpy as np

from streetscan.simulation.raycasting import SceneCaster

_SKY = np.array([196, 212, 232], np.float32)
_N_SIDES = 4


@dataclass(frozen=True)
class Cameras:
    """The cameras of a mobile mapper, one for each side of the vehicle.

    Attributes:
        position_m: (x, y, z) of the cameras in the vehicle frame.
        picture_interval_s: time between pictures.
        misalignment_deg: standard deviation of each camera's constant orientation error, per axis.
        exposure_spread: standard deviation of the logarithm of exposure between sides and passes.
        flicker: the same between neighbouring pictures of one camera.
        noise: standard deviation of a pixel, in grey levels.
    """

    position_m: tuple[float, float, float] = (0.3, 0.0, 2.4)
    picture_interval_s: float = 0.25
    misalignment_deg: float = 0.12
    exposure_spread: float = 0.15
    flicker: float = 0.04
    noise: float = 5.0


def colour_points(
    caster: SceneCaster,
    points: np.ndarray,
    camera_positions: np.ndarray,
    camera_yaws_rad: np.ndarray,
    picture_times_s: np.ndarray,
    pictures: np.ndarray,
    cameras: Cameras,
    seed: list[int],
    rng: np.random.Generator,
) -> np.ndarray:
    """(n, 3) uint8 colours of points.

    Args:
        caster: the scene.
        points: (n, 3) float64 true positions, metres, frame `map`.
        camera_positions: (n, 3) float64 where the camera was when it took the picture used.
        camera_yaws_rad: (n,) heading of the vehicle then.
        picture_times_s: (n,) float64 when.
        pictures: (n,) int number of the picture in its pass.
        cameras: their settings.
        seed: of the pass: orientation errors and exposures are the same for all points of one pass.
        rng: pixel noise.
    """
    to_points = (points - camera_positions).astype(np.float32)
    to_points /= np.maximum(np.linalg.norm(to_points, axis=1, keepdims=True), 1e-6)
    bearings = np.arctan2(to_points[:, 1], to_points[:, 0]) - camera_yaws_rad
    sides = (np.floor(bearings / (2 * np.pi) * _N_SIDES + 0.5) % _N_SIDES).astype(np.int64)

    fixed = np.random.default_rng(seed)
    errors = np.radians(cameras.misalignment_deg) * fixed.standard_normal((_N_SIDES, 3))
    gains = np.exp(cameras.exposure_spread * fixed.standard_normal((_N_SIDES, 1)) + 0.03 * fixed.standard_normal((_N_SIDES, 3)))
    n_pictures = int(pictures.max(initial=0)) + 1
    # Drawn per picture number, so that a part of the pass sees the same values as the whole.
    flicker = np.stack([np.random.default_rng([*seed, i]).standard_normal(_N_SIDES) for i in range(n_pictures)])

    rays = to_points + np.cross(errors.astype(np.float32)[sides], to_points)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    hits = caster.cast(camera_positions, rays, picture_times_s)
    seen = np.where((hits.faces >= 0)[:, None], caster.colours[hits.faces], _SKY).astype(np.float32)
    exposure = gains[sides] * np.exp(cameras.flicker * flicker[pictures, sides])[:, None]
    noise = cameras.noise * rng.standard_normal(seen.shape, np.float32)
    return np.clip(seen * exposure + noise, 0, 255).astype(np.uint8)
