"""A labelled map of the street of boxes of `street_frames`, as localization wants it."""

import numpy as np
from street_frames import street_boxes

from streetscan.classes import CAR, COLUMN, FACADE, FURNITURE, GROUND
from streetscan.landmarks import LandmarkSettings, cluster_landmarks
from streetscan.localization.reference import Reference, make_reference
from streetscan.segmentation.ground import add_heights
from streetscan.voxels import voxelize

_STEP_M = 0.1
UTM_SHIFT = np.array([456_000.0, 5_428_000.0, 115.0])


def street(rng: np.random.Generator | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(B, 6) boxes of a stretch of the street, with benches and bins of many sizes and no two equal stretches, and their classes."""
    rng = rng or np.random.default_rng(11)
    boxes = street_boxes()
    boxes = boxes[(boxes[:, 0] > -50) & (boxes[:, 0] < 60)]
    height, width = boxes[:, 5], boxes[:, 3] - boxes[:, 0]
    labels = np.where(width < 1, COLUMN, np.where(height < 2, CAR, FACADE)).astype(np.uint8)
    benches = []
    for side in (-1, 1):
        for x in np.arange(-48, 58, 9.0) + rng.uniform(-3, 3, 12):
            length, depth, top, y = rng.uniform(0.5, 1.8), rng.uniform(0.4, 0.7), rng.uniform(0.5, 1.2), side * rng.uniform(7.2, 8.2)
            benches.append((x, y - depth / 2, 0, x + length, y + depth / 2, top))
    return np.concatenate([boxes, benches]), np.concatenate([labels, np.full(len(benches), FURNITURE, np.uint8)])


def sample_map(boxes: np.ndarray, labels: np.ndarray, noise_m: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) on the sides and tops of boxes and on the road between, 10 cm apart, and their classes."""
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(np.arange(-50, 70, _STEP_M), np.arange(-12, 12, _STEP_M), indexing="ij")
    road = np.c_[x.ravel(), y.ravel(), np.zeros(x.size)]
    parts, classes = [], []
    for (x0, y0, z0, x1, y1, z1), label in zip(boxes, labels, strict=True):
        road = road[~((road[:, 0] > x0) & (road[:, 0] < x1) & (road[:, 1] > y0) & (road[:, 1] < y1))]
        sides = [np.linspace(a, b, max(int((b - a) / _STEP_M), 1) + 1) for a, b in ((x0, x1), (y0, y1), (z0, z1))]
        faces = []
        for axis in range(3):
            u, v = np.meshgrid(*(sides[a] for a in range(3) if a != axis), indexing="ij")
            for end in (0, -1) if axis < 2 else (-1,):
                face = np.empty((u.size, 3))
                face[:, [a for a in range(3) if a != axis]] = np.c_[u.ravel(), v.ravel()]
                face[:, axis] = sides[axis][end]
                faces.append(face)
        parts.append(np.concatenate(faces))
        classes.append(np.full(len(parts[-1]), label, np.uint8))
    points = np.concatenate([road, *parts])
    return points + rng.normal(0, noise_m, points.shape), np.concatenate([np.full(len(road), GROUND, np.uint8), *classes])


def make_street_reference(
    shift: np.ndarray = UTM_SHIFT,
    is_raw: bool = False,
    crs: str | None = "EPSG:32632",
    things: tuple[np.ndarray, np.ndarray] | None = None,
) -> Reference:
    """The reference of the street, or of other boxes and their classes, shifted."""
    boxes, box_labels = things or street()
    points, labels = sample_map(boxes, box_labels)
    grid = voxelize([points + shift], 0.1)
    grid = add_heights(grid, cell_m=0.5, max_object_m=20.0, max_slope=0.15, step_m=0.2, min_patch_m2=4.0)
    rows = grid.find(grid.keys_of(points + shift))
    voxel_labels, means = np.zeros(len(grid), np.uint8), np.zeros((len(grid), 3))
    voxel_labels[rows] = labels
    counts = np.bincount(rows, minlength=len(grid))
    for axis in range(3):
        means[:, axis] = np.bincount(rows, points[:, axis], len(grid)) / counts + shift[axis]
    landmarks = cluster_landmarks(means, grid.height_m, None if is_raw else voxel_labels, LandmarkSettings())
    return make_reference(grid, means, None if is_raw else voxel_labels, landmarks, crs)
