"""Frames of a rotating lidar in a street of boxes: rays against planes, for tests of registration."""

import numpy as np

from streetscan.geometry import apply, transform

SENSOR_HEIGHT_M = 1.8
PERIOD_S = 0.1


def street_boxes(rng: np.random.Generator | None = None) -> np.ndarray:
    """(B, 6) boxes low x, y, z, high x, y, z: house fronts with recesses, poles, parked cars."""
    rng = rng or np.random.default_rng(3)
    boxes = []
    for side in (-1, 1):
        x = -80.0
        while x < 160:
            width, depth = rng.uniform(6, 12), rng.uniform(9, 12)
            y = sorted((side * depth, side * (depth + 6)))
            boxes.append((x, y[0], 0, x + width, y[1], rng.uniform(5, 9)))
            x += width + rng.choice([0.0, 3.0])
        for x in np.arange(-75, 160, 17.0) + rng.uniform(-3, 3, 14):
            y = side * 6.5
            boxes.append((x, y - 0.1, 0, x + 0.2, y + 0.1, 5))
        for x in np.arange(-70, 150, 23.0) + rng.uniform(-4, 4, 10):
            y = sorted((side * 4.2, side * 5.9))
            boxes.append((x, y[0], 0.25, x + 4.2, y[1], 1.45))
    return np.array(boxes, np.float64)


def scan(
    T_map_lidar: np.ndarray,
    boxes: np.ndarray,
    rng: np.random.Generator,
    n_beams: int = 36,
    n_azimuths: int = 540,
    noise_m: float = 0.01,
    max_range_m: float = 50.0,
    velocity_mps: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) float32 in frame `lidar` and their time offsets (N,); as fired where a velocity (3,) in the map is given."""
    elevation = np.radians(np.linspace(-24.8, 2.0, n_beams))
    azimuth = np.linspace(np.pi, -np.pi, n_azimuths, endpoint=False)
    a, e = (g.ravel() for g in np.meshgrid(azimuth, elevation, indexing="ij"))
    offsets = -a / (2 * np.pi) * PERIOD_S
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    directions = rays @ T_map_lidar[:3, :3].T
    origins = np.tile(T_map_lidar[:3, 3], (len(rays), 1))
    if velocity_mps is not None:
        origins = origins + offsets[:, None] * velocity_mps
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(directions[:, 2] < 0, -origins[:, 2] / directions[:, 2], np.inf)
        inverse = 1 / directions
        low, high = boxes[:, :2] - T_map_lidar[:2, 3], boxes[:, 3:5] - T_map_lidar[:2, 3]
        is_near = (np.maximum(np.maximum(low, -high), 0) ** 2).sum(axis=1) < max_range_m**2
        for box in boxes[is_near]:
            t0, t1 = (box[:3] - origins) * inverse, (box[3:] - origins) * inverse
            near, far = np.minimum(t0, t1).max(axis=1), np.maximum(t0, t1).min(axis=1)
            distance = np.where((near <= far) & (near > 0), np.minimum(distance, near), distance)
    hit = distance < max_range_m
    distance = distance[hit] + rng.normal(0, noise_m, hit.sum())
    return (rays[hit] * distance[:, None]).astype(np.float32), offsets[hit].astype(np.float32)


def pose(x_m: float, y_m: float = 0.0, yaw_rad: float = 0.0) -> np.ndarray:
    """T_map_lidar (4, 4) of a vehicle on the flat road."""
    return transform([x_m, y_m, SENSOR_HEIGHT_M], [0, 0, yaw_rad])


def drive(n_frames: int, speed_mps: float = 8.0, turn_rate_radps: float = 0.0, seed: int = 1, **kwargs) -> tuple[list, np.ndarray]:
    """Points of the frames and poses (K, 4, 4) of a drive through the street at 10 Hz."""
    rng, boxes = np.random.default_rng(seed), street_boxes()
    poses = np.array([pose(i * PERIOD_S * speed_mps, 0, i * PERIOD_S * turn_rate_radps) for i in range(n_frames)])
    return [scan(T, boxes, rng, **kwargs)[0] for T in poses], poses


def to_map(T_map_lidar: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points of a frame in the map."""
    return apply(T_map_lidar, points)
