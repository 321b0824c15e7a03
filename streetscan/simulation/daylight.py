"""Light in a simulated street: sun, sky, shadows, reflections; the radiance that comes along a ray.

Radiance 1 is a white matt board that faces the noon sun. One bounce: the sun with a shadow ray, the sky by how open the
hemisphere above a surface is, what buildings and ground throw back as a constant; panes and paint are followed one mirror
ray further, panes also one ray through.

ASSUME: strengths and colours are ours (clear sky: about one fifth of the light of a high sun); the papers give none.
"""

from dataclasses import dataclass

import numba
import numpy as np

from streetscan.classes import FACADE
from streetscan.simulation.appearance import MATERIALS
from streetscan.simulation.raycasting import Hits, SceneCaster
from streetscan.simulation.textures import GLOSS, LOOK_TABLE, MIRROR, TRANSLUCENCY, look_at, look_up, patterns_of

_TRANSMISSION = np.array([m.transmission if LOOK_TABLE[i, MIRROR] > 0 else 0.0 for i, m in enumerate(MATERIALS)])
# Secondary rays start this far from the surface, clear of float32 steps and of paint on the road.
_LIFT_M = 0.004
# Hemisphere rays: 4 x 4 directions, shared by a neighbourhood of 4 x 4 places; what is nearer than this takes light away.
_N_DIRECTIONS = 16
_REACH_M = 5.0
_GRID_STEP = 2


@dataclass(frozen=True)
class Daylight:
    """Sun and sky, and how much there is to see on walls.

    Attributes:
        sun_azimuth_deg: where the sun stands, counter-clockwise from easting.
        sun_elevation_deg: its height above the horizon.
        haze: 0 is a clear sky, 1 an overcast one: the sun loses, the sky gains.
        clouds: share of the sky under clouds.
        wall_contrast: how much of their pattern facades show; 1 all of it, 0 none, as freshly painted walls.
        seed: of the clouds.
    """

    sun_azimuth_deg: float = 220.0
    sun_elevation_deg: float = 48.0
    haze: float = 0.15
    clouds: float = 0.35
    wall_contrast: float = 1.0
    seed: int = 1

    @property
    def sun_direction(self) -> np.ndarray:
        """(3,) float64 unit vector towards the sun, frame `map`."""
        a, e = np.radians(self.sun_azimuth_deg), np.radians(self.sun_elevation_deg)
        return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])

    @property
    def sun_light(self) -> np.ndarray:
        """(3,) irradiance of a surface that faces the sun, linear RGB; redder and weaker the lower the sun stands."""
        height = np.sin(np.radians(max(self.sun_elevation_deg, 0.5)))
        # Optical thickness of the air per colour, times the length of the way through it.
        way = np.minimum(1 / (height + 0.05), 12.0)
        return 1.05 * (1 - 0.95 * self.haze) * np.exp(-np.array([0.045, 0.085, 0.17]) * way)

    @property
    def sky_light(self) -> np.ndarray:
        """(3,) irradiance of a level surface under the open sky, linear RGB."""
        height = np.sin(np.radians(max(self.sun_elevation_deg, 0.5)))
        clear, grey = np.array([0.135, 0.170, 0.235]), np.array([0.33, 0.34, 0.35])
        share = min(self.haze + 0.3 * self.clouds, 1.0)
        return (0.25 + 0.75 * min(height / 0.6, 1.0)) * ((1 - share) * clear + share * grey)


# Stretches that are hard on purpose, besides dense traffic, which is a setting of the street. The low sun stands where the
# caller turns it, as a rule ahead: dataclasses.replace(HARD_DAYLIGHT["low_sun"], sun_azimuth_deg=heading).
HARD_DAYLIGHT = {
    "low_sun": Daylight(sun_elevation_deg=7.0, haze=0.25, clouds=0.15),
    "bare_walls": Daylight(wall_contrast=0.0),
    "overcast": Daylight(haze=1.0, clouds=0.0),
}


@dataclass
class Openness:
    """How much of the sky near surfaces leave free, at every second pixel of every second row.

    Attributes:
        points: (h, w, 3) float64 relative to the caster's origin; NaN where nothing is hit.
        normals: (h, w, 3) float32.
        values: (h, w) float32, 0 closed to 1 open.
    """

    points: np.ndarray
    normals: np.ndarray
    values: np.ndarray


@dataclass
class Seen:
    """What rays met.

    Attributes:
        radiance: (n, 3) float32 linear RGB.
        hits: of the rays.
        points: (n, 3) float64 relative to the caster's origin; NaN where nothing is hit.
        normals: (n, 3) float32 towards the viewer, frame `map`.
        sunlit: (n,) bool.
    """

    radiance: np.ndarray
    hits: Hits
    points: np.ndarray
    normals: np.ndarray
    sunlit: np.ndarray


class Lighting:
    """Light in one scene: what the kernels read of the caster, made once."""

    def __init__(self, caster: SceneCaster, daylight: Daylight):
        self.caster, self.daylight = caster, daylight
        self._patterns = patterns_of(caster.materials, caster.labels)
        self._seeds = caster.own_frames.seeds[caster.own_frames.numbers]
        self._contrasts = np.where(caster.labels == FACADE, daylight.wall_contrast, 1.0).astype(np.float32)
        self._colours = _SRGB_TO_LINEAR[caster.colours]
        self._sky = np.concatenate(
            [daylight.sun_direction, daylight.sun_light, daylight.sky_light, [daylight.clouds, daylight.seed, daylight.haze]]
        )

    @property
    def white(self) -> np.ndarray:
        """(3,) colour of the light, mean 1: what a camera's white balance divides by."""
        light = self.daylight.sun_light * 0.7 + self.daylight.sky_light
        return light / light.mean()

    def see(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        times_s: np.ndarray,
        spread_rad: float,
        openness: Openness | None = None,
        pixels: np.ndarray | None = None,
        travelled_m: np.ndarray | None = None,
    ) -> Seen:
        """Radiance along rays.

        Args:
            origins: (n, 3) float64, metres, frame `map`.
            directions: (n, 3) float32 unit vectors.
            times_s: (n,) float64.
            spread_rad: angle between neighbouring pixels.
            openness: of the picture's places; without it surfaces count as half open.
            pixels: (n, 2) int32 column and row of each ray, where `openness` is looked up.
            travelled_m: (n,) float32 way of the light behind the ray's origin: given for rays that were mirrored or went
                through a pane, which end at the next surface.
        """
        seen, albedo = self._meet(origins, directions, times_s, spread_rad, travelled_m)
        self._light(seen, albedo, directions, times_s, spread_rad, openness, pixels, travelled_m)
        return seen

    def see_picture(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        times_s: np.ndarray,
        spread_rad: float,
        pixels: np.ndarray,
        shape: tuple[int, int],
    ) -> tuple[Seen, Openness]:
        """Radiance along one ray for each pixel of a whole picture (height, width), row by row, and the openness found on the way."""
        seen, albedo = self._meet(origins, directions, times_s, spread_rad, None)
        openness = self._openness(seen, shape, times_s)
        self._light(seen, albedo, directions, times_s, spread_rad, openness, pixels, None)
        return seen, openness

    def _meet(self, origins, directions, times_s, spread_rad, travelled_m) -> tuple[Seen, np.ndarray]:
        """What rays hit, still dark, and its albedo (n, 3)."""
        caster = self.caster
        hits = caster.cast(origins, directions, times_s)
        behind = np.zeros(len(hits), np.float32) if travelled_m is None else travelled_m
        points, normals, albedo = look_at(
            origins - caster.origin,
            directions,
            hits.distances_m,
            hits.faces,
            hits.actors,
            behind,
            spread_rad,
            caster.own_frames.normals,
            caster.own_poses(hits, times_s),
            self._seeds,
            self._patterns,
            caster.materials,
            self._colours,
            self._contrasts,
            LOOK_TABLE,
        )
        return Seen(np.zeros_like(albedo), hits, points, normals, self._sunlit(points, normals, hits, times_s)), albedo

    def _light(self, seen: Seen, albedo, directions, times_s, spread_rad, openness, pixels, travelled_m) -> None:
        """Fill in the radiance."""
        hits = seen.hits
        if openness is None:
            open_sky = np.full(len(hits), 0.5, np.float32)
        else:
            open_sky = _gather(seen.points, seen.normals, hits.distances_m, pixels, openness.points, openness.normals, openness.values)
        is_last = travelled_m is not None
        # A pane's mirror image of the sun is spread by the pane's waviness.
        seen.radiance = look_up(directions, hits.faces, self._sky, spread_rad, 30.0 if is_last else np.inf)
        surface = hits.faces, self.caster.materials, seen.normals, albedo, seen.sunlit, open_sky
        _shade(seen.radiance, directions, *surface, self._sky, LOOK_TABLE)
        if not is_last:
            self._follow(seen, directions, times_s, spread_rad)

    def _openness(self, seen: Seen, shape: tuple[int, int], times_s: np.ndarray) -> Openness:
        """Openness of the places a whole picture (height, width) sees."""
        height, width = shape
        points = seen.points.reshape(height, width, 3)[::_GRID_STEP, ::_GRID_STEP]
        normals = seen.normals.reshape(height, width, 3)[::_GRID_STEP, ::_GRID_STEP]
        times = times_s.reshape(height, width)[::_GRID_STEP, ::_GRID_STEP]
        values = np.ones(points.shape[:2], np.float32)
        for k in range(_N_DIRECTIONS):
            # Rays of one direction after one another: neighbours run side by side.
            part = (slice(k // 4, None, 4), slice(k % 4, None, 4))
            p, n, t = points[part].reshape(-1, 3), normals[part].reshape(-1, 3), times[part].ravel()
            there = np.isfinite(p[:, 0])
            rays = _hemisphere(n[there], k)
            hits = self.caster.cast(p[there] + _LIFT_M * n[there] + self.caster.origin, rays, t[there], _REACH_M)
            free = np.ones(len(p), np.float32)
            free[there] = np.minimum(hits.distances_m / _REACH_M, 1.0)
            values[part] = free.reshape(values[part].shape)
        return Openness(np.ascontiguousarray(points), np.ascontiguousarray(normals), values)

    def _sunlit(self, points, normals, hits: Hits, times_s) -> np.ndarray:
        """(n,) bool: places the sun reaches."""
        sun = self.daylight.sun_direction.astype(np.float32)
        sunlit = np.zeros(len(hits), bool)
        passes_light = LOOK_TABLE[self.caster.materials[hits.faces], TRANSLUCENCY] > 0
        rows = np.flatnonzero((hits.faces >= 0) & ((normals @ sun > 0) | passes_light))
        # The back of a leaf is lit through the leaf.
        side = np.where(normals[rows] @ sun > 0, 1.0, -1.0)[:, None]
        starts = points[rows] + side * _LIFT_M * normals[rows] + self.caster.origin
        sunlit[rows] = ~self.caster.is_blocked(starts, np.tile(sun, (len(rows), 1)), times_s[rows])
        return sunlit

    def _follow(self, seen: Seen, directions, times_s, spread_rad) -> None:
        """Add what mirrors and panes show to the radiance."""
        hits, points, normals, radiance = seen.hits, seen.points, seen.normals, seen.radiance
        materials = self.caster.materials[hits.faces]
        rows = np.flatnonzero((hits.faces >= 0) & (LOOK_TABLE[materials, MIRROR] > 0))
        # Rays that one plane mirrors run side by side, and are cheap to cast together.
        rows = rows[np.argsort(hits.faces[rows], kind="stable")]
        if len(rows) == 0:
            return
        d, n = directions[rows], normals[rows]
        cosine = -np.einsum("ij,ij->i", d, n)
        f0 = LOOK_TABLE[materials[rows], MIRROR].astype(np.float32)
        share = (f0 + (1 - f0) * (1 - np.clip(cosine, 0, 1)) ** 5)[:, None]
        mirrored = d + 2 * cosine[:, None] * n
        travelled = hits.distances_m[rows]
        start = points[rows] + self.caster.origin
        mirror = self.see(start + _LIFT_M * n, mirrored, times_s[rows], spread_rad, travelled_m=travelled).radiance
        through = _TRANSMISSION[materials[rows]].astype(np.float32)[:, None]
        behind = np.zeros_like(mirror)
        panes = np.flatnonzero(through[:, 0] > 0)
        behind[panes] = self.see(
            start[panes] - _LIFT_M * n[panes], d[panes], times_s[rows[panes]], spread_rad, travelled_m=travelled[panes]
        ).radiance
        radiance[rows] = share * mirror + (1 - share) * (through * behind + (1 - through) * radiance[rows])


def _srgb_to_linear() -> np.ndarray:
    v = np.arange(256) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4).astype(np.float32)


_SRGB_TO_LINEAR = _srgb_to_linear()


def _hemisphere(normals: np.ndarray, k: int) -> np.ndarray:
    """(n, 3) float32 directions about normals: the k-th of 4 x 4, together distributed as the cosine law wants."""
    a, b = (k % 4 + 0.5) / 4, 2 * np.pi * (k // 4 + 0.25 * (k % 4) + 0.3) / 4
    radius, along = np.sqrt(a), np.sqrt(1 - a)
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, np.array([[0, 0, 1.0]]), np.array([[1.0, 0, 0]]))
    side = np.cross(helper, normals)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    other = np.cross(normals, side)
    return (radius * np.cos(b) * side + radius * np.sin(b) * other + along * normals).astype(np.float32)


@numba.njit(cache=True, parallel=True)
def _shade(radiance, directions, faces, materials, normals, albedo, sunlit, open_sky, sky, looks):
    """Fill in the radiance of hits, from sun and sky."""
    for r in numba.prange(len(faces)):
        if faces[r] < 0:
            continue
        dx, dy, dz = np.float64(directions[r, 0]), np.float64(directions[r, 1]), np.float64(directions[r, 2])
        nx, ny, nz = np.float64(normals[r, 0]), np.float64(normals[r, 1]), np.float64(normals[r, 2])
        look = looks[materials[faces[r]]]
        facing = nx * sky[0] + ny * sky[1] + nz * sky[2]
        translucency = look[TRANSLUCENCY]
        direct = 0.0
        if sunlit[r]:
            direct = (1 - translucency) * facing if facing > 0 else -translucency * facing
            if translucency > 0:
                direct = 0.55 * direct + 0.2
        above = 0.5 * (1 + nz)
        opened = 0.12 + 0.88 * open_sky[r]
        # Light thrown back by sunny ground and walls, warmer than the sky's.
        bounce = (0.10 + 0.08 * (1 - above)) * (0.5 + 0.5 * sky[2])
        highlight = 0.0
        if sunlit[r] and facing > 0:
            hx, hy, hz = sky[0] - dx, sky[1] - dy, sky[2] - dz
            length = max(np.sqrt(hx * hx + hy * hy + hz * hz), 1e-9)
            peak = max((hx * nx + hy * ny + hz * nz) / length, 0.0)
            cosine = max(-(dx * hx + dy * hy + dz * hz) / length, 0.0)
            fresnel = 0.035 + 0.965 * (1 - min(cosine, 1.0)) ** 5
            gloss = look[GLOSS]
            highlight = fresnel * (gloss + 8) / 8 * peak**gloss * facing * 0.5
        for k in range(3):
            light = sky[3 + k] * direct + opened * (above * sky[6 + k] + bounce * sky[3 + k])
            radiance[r, k] = albedo[r, k] * light + highlight * sky[3 + k]


@numba.njit(cache=True, parallel=True)
def _gather(points, normals, distances_m, pixels, grid_points, grid_normals, values):
    """Openness at points: mean over the 4 x 4 grid places around the pixel that lie on the same surface."""
    n = len(points)
    found = np.ones(n, np.float32)
    height, width = values.shape
    for r in numba.prange(n):
        if np.isnan(points[r, 0]):
            continue
        i, j = pixels[r, 1] // _GRID_STEP - 1, pixels[r, 0] // _GRID_STEP - 1
        total, weight, any_total, any_weight = 0.0, 0.0, 0.0, 0.0
        for gi in range(max(i, 0), min(i + 4, height)):
            for gj in range(max(j, 0), min(j + 4, width)):
                if np.isnan(grid_points[gi, gj, 0]):
                    continue
                off = 0.0
                along = 0.0
                for k in range(3):
                    off += normals[r, k] * (grid_points[gi, gj, k] - points[r, k])
                    along += normals[r, k] * grid_normals[gi, gj, k]
                any_total += values[gi, gj]
                any_weight += 1.0
                if abs(off) < 0.03 + 0.004 * distances_m[r] and along > 0.8:
                    total += values[gi, gj]
                    weight += 1.0
        if weight > 0:
            found[r] = total / weight
        elif any_weight > 0:
            found[r] = any_total / any_weight
    return found
