"""What a simulated sensor sees: one static mesh, and actors that move rigidly through it.

Frame `map` throughout: metres, z up, yaw counter-clockwise from easting.
"""

from dataclasses import dataclass, field

import numpy as np


@dataclass
class Mesh:
    """Triangles with what each of them is.

    Attributes:
        vertices: (V, 3) float64, metres.
        triangles: (T, 3) int32 indices into vertices, counter-clockwise seen from outside.
        labels: (T,) uint8 semantic class (streetscan.classes), 255 for what no class describes.
        instances: (T,) uint32 id of the object the triangle belongs to, unique in a city; 0 is "no object" (ground).
        materials: (T,) uint8 index into streetscan.simulation.appearance.MATERIALS.
        colours: (T, 3) uint8 RGB of the surface.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    labels: np.ndarray
    instances: np.ndarray
    materials: np.ndarray
    colours: np.ndarray


@dataclass
class Actor:
    """A rigid mesh on a path: mesh coordinates have the origin on the ground below the middle, x forward, z up.

    Attributes:
        mesh: in the actor's own frame; `labels` is its class when it stands still.
        times_s: (K,) float64, increasing.
        positions: (K, 3) float64 positions of the origin in `map` at those times.
        yaws_rad: (K,) float64 headings, unwrapped.
    """

    mesh: Mesh
    times_s: np.ndarray
    positions: np.ndarray
    yaws_rad: np.ndarray

    def pose_at(self, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (n, 3) and yaws (n,) at times, linear between the path's samples, standing before and after it."""
        positions = np.stack([np.interp(times_s, self.times_s, self.positions[:, i]) for i in range(3)], axis=-1)
        return positions, np.interp(times_s, self.times_s, self.yaws_rad)

    def speed_at(self, times_s: np.ndarray) -> np.ndarray:
        """Speed (n,) in m/s at times: of the path's segment in force, 0 before and after the path."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1) / np.diff(self.times_s)
        segment = np.searchsorted(self.times_s, times_s, side="right") - 1
        inside = (segment >= 0) & (segment < len(steps))
        return np.where(inside, steps[np.clip(segment, 0, len(steps) - 1)], 0.0)


@dataclass
class Scene:
    """One street of the city at the time it is recorded.

    Attributes:
        static: everything that stands still, in `map`.
        actors: everything that may move.
        roads: centre lines, each (K, 3) float64 on the road surface, in driving direction of the first lane.
        speeds_kmh: the speed a mapping vehicle drives on each road.
        lane_offset_m: distance from the centre line to the middle of the driving lane (right-hand traffic).
        crs: the map's projected CRS.
        places: kind of place to the lines, (K, 3) float64 each, along which one drives through it.
        changes: one row per object of what became of it since the day of the map; empty on that day.
    """

    static: Mesh
    actors: list[Actor] = field(default_factory=list)
    roads: list[np.ndarray] = field(default_factory=list)
    speeds_kmh: list[float] = field(default_factory=list)
    lane_offset_m: float = 1.75
    crs: str | None = None
    places: dict[str, list[np.ndarray]] = field(default_factory=dict)
    changes: list[dict] = field(default_factory=list)


def join_meshes(meshes: list[Mesh]) -> Mesh:
    """One mesh of many."""
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.triangles + o for m, o in zip(meshes, offsets, strict=True)]).astype(np.int32),
        *(np.concatenate([getattr(m, name) for m in meshes]) for name in ("labels", "instances", "materials", "colours")),
    )
