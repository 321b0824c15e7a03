"""Building blocks of meshes: boxes, tubes, lofts, reliefs; how to move them, and how to sample their surface.

Every function returns a `Mesh` with instance 0; whoever places an object gives it its instance. Metres throughout.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from streetscan.simulation.appearance import MATERIAL_IDS
from streetscan.simulation.scene import Mesh, join_meshes


class Surface(NamedTuple):
    """What a triangle is made of: semantic label, material name, RGB colour."""

    label: int
    material: str
    colour: tuple[int, int, int]


def make_mesh(vertices: np.ndarray, triangles: np.ndarray, surface: Surface) -> Mesh:
    """A mesh of one surface from (V, 3) vertices and (T, 3) triangles."""
    triangles = np.asarray(triangles, np.int32).reshape(-1, 3)
    n = len(triangles)
    return Mesh(
        np.asarray(vertices, np.float64).reshape(-1, 3),
        triangles,
        np.full(n, surface.label, np.uint8),
        np.zeros(n, np.uint32),
        np.full(n, MATERIAL_IDS[surface.material], np.uint8),
        np.tile(np.array(surface.colour, np.uint8), (n, 1)),
    )


def empty_mesh() -> Mesh:
    """A mesh without triangles."""
    return make_mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), Surface(255, "concrete", (0, 0, 0)))


def triangle_soup(corners: np.ndarray, surface: Surface) -> Mesh:
    """Separate triangles from (T, 3, 3) corners."""
    corners = np.asarray(corners, float)
    return make_mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), surface)


def quads(corners: np.ndarray, surface: Surface) -> Mesh:
    """Separate quadrilaterals from (Q, 4, 3) corners, counter-clockwise seen from outside."""
    corners = np.asarray(corners, float).reshape(-1, 4, 3)
    first = 4 * np.arange(len(corners))[:, None]
    return make_mesh(corners.reshape(-1, 3), (first[:, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3), surface)


_BOX_FACES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])


def box(low: tuple, high: tuple, surface: Surface) -> Mesh:
    """The axis-parallel box between two corners."""
    corners = np.array([[x, y, z] for z in (low[2], high[2]) for y in (low[1], high[1]) for x in (low[0], high[0])], float)
    return make_mesh(corners, np.concatenate([_BOX_FACES[:, [0, 1, 2]], _BOX_FACES[:, [0, 2, 3]]]), surface)


def loft(sections: np.ndarray, surface: Surface, closed: bool = True, caps: bool = True) -> Mesh:
    """Skin over K sections of M points each.

    Args:
        sections: (K, M, 3), every section with its points in the same order, counter-clockwise seen from the last section.
        closed: whether point M-1 joins point 0.
        caps: whether the end sections are filled (as a fan around their mean).
    Returns:
        Triangles ordered section interval by section interval, strip by strip (two per quad), then the caps.
    """
    sections = np.asarray(sections, float)
    n_sections, n_points = sections.shape[:2]
    index = np.arange(n_sections * n_points).reshape(n_sections, n_points)
    here = index if closed else index[:, :-1]
    right = np.roll(index, -1, axis=1) if closed else index[:, 1:]
    a, b, c, d = here[:-1], right[:-1], right[1:], here[1:]
    triangles = [np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], -2).reshape(-1, 3)]
    vertices = [sections.reshape(-1, 3)]
    if caps:
        vertices += [sections[0].mean(0, keepdims=True), sections[-1].mean(0, keepdims=True)]
        middle = index.size
        triangles.append(np.stack([np.full(n_points, middle), np.roll(index[0], -1), index[0]], 1))
        triangles.append(np.stack([np.full(n_points, middle + 1), index[-1], np.roll(index[-1], -1)], 1))
    return make_mesh(np.concatenate(vertices), np.concatenate(triangles), surface)


def tube(path: np.ndarray, radii: np.ndarray | float, surface: Surface, n_sides: int = 8, caps: bool = True) -> Mesh:
    """A round bar along a polyline (K, 3) with a radius at each of its points."""
    path = np.asarray(path, float)
    radii = np.broadcast_to(np.asarray(radii, float), len(path))
    tangents = np.gradient(path, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    # One reference direction for the whole bar keeps the rings from twisting; it must not be parallel to it.
    mean = np.abs(tangents).mean(0)
    reference = np.eye(3)[int(np.argmin(mean))]
    side = np.cross(tangents, reference)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    other = np.cross(tangents, side)
    angle = np.linspace(0, 2 * np.pi, n_sides, endpoint=False)
    rings = path[:, None] + radii[:, None, None] * (np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * other[:, None])
    return loft(rings, surface, caps=caps)


def revolve(profile: np.ndarray, surface: Surface, n_sides: int = 12, centre: tuple = (0, 0, 0), caps: bool = True) -> Mesh:
    """The solid of (K, 2) radius and height, upwards, turned about the vertical through `centre`."""
    profile = np.asarray(profile, float)
    angle = np.linspace(0, 2 * np.pi, n_sides, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)
    sections = np.concatenate([profile[:, None, :1] * ring, np.broadcast_to(profile[:, None, 1:], (len(profile), n_sides, 1))], -1)
    return loft(sections + np.asarray(centre, float), surface, caps=caps)


def ellipsoid(radii: tuple, centre: tuple, surface: Surface, n_sides: int = 10, n_rings: int = 6) -> Mesh:
    """An ellipsoid with axes parallel to x, y, z."""
    polar = np.linspace(-np.pi / 2, np.pi / 2, n_rings + 1)
    profile = np.stack([np.maximum(np.cos(polar), 1e-3), np.sin(polar)], 1)
    mesh = revolve(profile, surface, n_sides, caps=False)
    mesh.vertices = mesh.vertices * np.asarray(radii, float) + np.asarray(centre, float)
    return mesh


def transform(mesh: Mesh, yaw_rad: float = 0.0, position: tuple = (0, 0, 0), scale: tuple | float = 1.0, slope: tuple = (0, 0)) -> Mesh:
    """The mesh scaled, then sheared to stand on a slope (rise per metre along its x and y), turned and moved."""
    vertices = mesh.vertices * np.asarray(scale, float)
    vertices = np.column_stack([vertices[:, :2], vertices[:, 2] + vertices[:, :2] @ np.asarray(slope, float)])
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turned = np.column_stack([c * vertices[:, 0] - s * vertices[:, 1], s * vertices[:, 0] + c * vertices[:, 1], vertices[:, 2]])
    return Mesh(turned + np.asarray(position, float), mesh.triangles, mesh.labels, mesh.instances, mesh.materials, mesh.colours)


def with_instances(mesh: Mesh, first: int) -> tuple[Mesh, int]:
    """The mesh with one instance id per semantic label it holds, counted from `first`; and the next free id.

    An object of two classes (a tree: trunk and crown) thus becomes two instances, each of one class.
    """
    present = np.unique(mesh.labels)
    table = np.zeros(256, np.uint32)
    table[present] = first + np.arange(len(present))
    instances = table[mesh.labels]
    return Mesh(mesh.vertices, mesh.triangles, mesh.labels, instances, mesh.materials, mesh.colours), first + len(present)


def triangle_areas(mesh: Mesh) -> np.ndarray:
    """(T,) areas, m²."""
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def sample_surface(mesh: Mesh, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """n points (n, 3) drawn uniformly from the surface, and the triangles (n,) they lie on."""
    areas = triangle_areas(mesh)
    rows = rng.choice(len(areas), n, p=areas / areas.sum())
    u, v = rng.random((2, n))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    a, b, c = (mesh.vertices[mesh.triangles[rows, i]] for i in range(3))
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), rows


class Relief:
    """A surface of rectangular cells, each at its own depth, painted rectangle over rectangle.

    Ground with kerbs and facades with recessed windows are both reliefs: a carrier surface with coordinates (a, b),
    and where neighbouring cells differ in depth, a wall between them (with the surface of the higher cell).
    """

    def __init__(self, a: tuple[float, float], b: tuple[float, float], depth: float, surface: Surface):
        self.rectangles = [(a[0], a[1], b[0], b[1], depth, surface)]

    def paint(self, a0: float, a1: float, b0: float, b1: float, depth: float, surface: Surface) -> None:
        """Cover the rectangle a0..a1 x b0..b1; what lies outside the relief is cut off."""
        low_a, high_a, low_b, high_b = self.rectangles[0][:4]
        a0, a1, b0, b1 = max(a0, low_a), min(a1, high_a), max(b0, low_b), min(b1, high_b)
        if a1 - a0 > 1e-4 and b1 - b0 > 1e-4:
            self.rectangles.append((a0, a1, b0, b1, depth, surface))

    def build(
        self,
        place: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
        max_step: tuple[float, float] = (np.inf, np.inf),
        colour_spread: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> Mesh:
        """The mesh.

        Args:
            place: maps a, b, depth (n,) to points (n, 3); (a, b, depth) must be right-handed as seen from outside.
            max_step: cells larger than this along a or b are cut; infinite means the carrier is flat, and equal
                neighbours along a are merged.
            colour_spread: brightness noise (1 sigma) of each cell, drawn from `rng`.
        """
        edges = []
        for low, high, step in ((0, 1, max_step[0]), (2, 3, max_step[1])):
            breaks = np.unique(np.round([v for r in self.rectangles for v in (r[low], r[high])], 4))
            if np.isfinite(step):
                pieces = np.maximum(1, np.ceil(np.diff(breaks) / step)).astype(int)
                breaks = np.concatenate(
                    [np.linspace(x, y, n, endpoint=False) for x, y, n in zip(breaks[:-1], breaks[1:], pieces, strict=True)] + [breaks[-1:]]
                )
            edges.append(breaks)
        edge_a, edge_b = edges
        owner = np.zeros((len(edge_a) - 1, len(edge_b) - 1), int)
        for row, (a0, a1, b0, b1, _, _) in enumerate(self.rectangles):
            i0, i1 = np.searchsorted(edge_a, [a0 - 1e-3, a1 - 1e-3])
            j0, j1 = np.searchsorted(edge_b, [b0 - 1e-3, b1 - 1e-3])
            owner[i0:i1, j0:j1] = row
        depth = np.array([r[4] for r in self.rectangles])[owner]
        ids: dict[Surface, int] = {}
        surface_of_row = np.array([ids.setdefault(r[5], len(ids)) for r in self.rectangles])
        surface = surface_of_row[owner]

        if np.isfinite(max_step[0]):
            i, j = np.indices(owner.shape).reshape(2, -1)
            i_end = i + 1
        else:
            # Runs of equal cells along a, row of b by row of b.
            d, s = depth.T, surface.T
            starts = np.ones(d.shape, bool)
            starts[:, 1:] = (d[:, 1:] != d[:, :-1]) | (s[:, 1:] != s[:, :-1])
            j, i = np.nonzero(starts)
            i_end = np.append(i[1:], 0)
            i_end = np.where(np.append(j[1:] != j[:-1], True), d.shape[1], i_end)
        a0, a1, b0, b1, d = edge_a[i], edge_a[i_end], edge_b[j], edge_b[j + 1], depth[i, j]
        corners = [np.stack([a0, b0, d]), np.stack([a1, b0, d]), np.stack([a1, b1, d]), np.stack([a0, b1, d])]
        all_corners, all_surfaces = [np.stack(corners)], [surface[i, j]]
        # Walls across a: between cells (i, j) and (i + 1, j).
        i, j = np.nonzero(np.abs(np.diff(depth, axis=0)) > 1e-6)
        x, near, far = edge_a[i + 1], depth[i, j], depth[i + 1, j]
        all_corners.append(np.stack([[x, edge_b[j], near], [x, edge_b[j], far], [x, edge_b[j + 1], far], [x, edge_b[j + 1], near]]))
        all_surfaces.append(np.where(near > far, surface[i, j], surface[i + 1, j]))
        i, j = np.nonzero(np.abs(np.diff(depth, axis=1)) > 1e-6)
        y, near, far = edge_b[j + 1], depth[i, j], depth[i, j + 1]
        all_corners.append(np.stack([[edge_a[i + 1], y, near], [edge_a[i + 1], y, far], [edge_a[i], y, far], [edge_a[i], y, near]]))
        all_surfaces.append(np.where(near > far, surface[i, j], surface[i, j + 1]))

        corners = np.concatenate([c.reshape(4, 3, -1) for c in all_corners], axis=-1)  # (4, 3, Q)
        surface = np.concatenate(all_surfaces)
        points = place(*corners.transpose(1, 2, 0).reshape(3, -1)).reshape(-1, 4, 3)
        mesh = quads(points, next(iter(ids)))
        table = list(ids)
        per_quad = np.repeat(surface, 2)
        mesh.labels = np.array([s.label for s in table], np.uint8)[per_quad]
        mesh.materials = np.array([MATERIAL_IDS[s.material] for s in table], np.uint8)[per_quad]
        colours = np.array([s.colour for s in table], float)[per_quad]
        if colour_spread and rng is not None:
            colours += np.repeat(rng.normal(0, colour_spread, (len(surface), 1)), 2, axis=0)
        mesh.colours = np.clip(colours, 0, 255).astype(np.uint8)
        return mesh


def join(meshes: list[Mesh]) -> Mesh:
    """One mesh of many, which may be none."""
    meshes = [m for m in meshes if len(m.triangles)]
    return join_meshes(meshes) if meshes else empty_mesh()
