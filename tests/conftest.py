"""Fixtures of the whole test suite: the folder of real recordings and one tiny street made of numpy arrays."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from toy_detections import DetectionDrive, write_detection_drive

from streetscan import classes
from streetscan.clouds import PointCloud
from streetscan.io.las import write_las

ROOT = Path(__file__).resolve().parents[1]
SHARED_DATA = ROOT.parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; the test is skipped where it does not exist."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no real recordings at {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="session")
def detection_drive(tmp_path_factory) -> DetectionDrive:
    """A tiny drive with images, lidar frames and the truth of what could move, made once; treat it as read-only."""
    return write_detection_drive(tmp_path_factory.mktemp("detections"))


@dataclass
class TinyObject:
    """One object of the tiny street: its class, the middle of its box on the ground (map), size and yaw of its long side."""

    instance: int
    label: int
    foot: np.ndarray
    size_m: tuple[float, float, float]
    yaw_rad: float


@dataclass
class TinyWorld:
    """A street of 24 m by 12 m on a 6 % slope, at the coordinates of a national grid, its axis 30 degrees off east.

    Attributes:
        cloud: the map as simulate_city writes it (intensity, time_s, rgb, return_number, n_returns), frame `map`.
        labels: (N,) uint8, 255 for 60 stray points, 20 of them up to 2 m below the ground.
        instances: (N,) uint32, 0 where the point belongs to no object.
        objects: the instances of the object classes.
    """

    cloud: PointCloud
    labels: np.ndarray
    instances: np.ndarray
    objects: list[TinyObject] = field(default_factory=list)

    def ground_z_m(self, points: np.ndarray) -> np.ndarray:
        """(N,) true height of the ground below (N, >=2) positions in `map`: road and, 0.12 m higher, two sidewalks."""
        u, v = ((np.asarray(points)[:, :2] - _CENTRE[:2]) @ _AXES.T).T
        return _CENTRE[2] + _ground_m(u, v)

    def write(self, folder: Path) -> Path:
        """Write map.laz and truth/labels.npy, truth/instances.npy as simulate_city does; returns the map's path."""
        (folder / "truth").mkdir(parents=True, exist_ok=True)
        write_las(folder / "map.laz", self.cloud)
        np.save(folder / "truth" / "labels.npy", self.labels)
        np.save(folder / "truth" / "instances.npy", self.instances)
        return folder / "map.laz"


_CENTRE = np.array([650_123.4, 239_876.5, 112.3])
_YAW_RAD = np.radians(30.0)
_AXES = np.array([[np.cos(_YAW_RAD), np.sin(_YAW_RAD)], [-np.sin(_YAW_RAD), np.cos(_YAW_RAD)]])
_STEP_M, _NOISE_M = 0.08, 0.01
_LENGTH_M, _WIDTH_M, _KERB_V_M = 24.0, 12.0, 4.0


def _ground_m(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return 0.06 * u + 0.02 * v + 0.12 * (np.abs(v) > _KERB_V_M)


def _grid(length_m: float, width_m: float) -> np.ndarray:
    a, b = np.meshgrid(np.arange(0, length_m, _STEP_M), np.arange(0, width_m, _STEP_M), indexing="ij")
    return np.stack([a.ravel() - length_m / 2, b.ravel() - width_m / 2], axis=1)


def _box(length_m: float, width_m: float, bottom_m: float, top_m: float) -> np.ndarray:
    """Points on the sides and the top of a box that stands over (0, 0)."""
    side, front, roof = _grid(length_m, top_m - bottom_m), _grid(width_m, top_m - bottom_m), _grid(length_m, width_m)
    middle = (top_m + bottom_m) / 2
    return np.concatenate(
        [np.c_[side[:, 0], np.full(len(side), s * width_m / 2), side[:, 1] + middle] for s in (-1, 1)]
        + [np.c_[np.full(len(front), s * length_m / 2), front[:, 0], front[:, 1] + middle] for s in (-1, 1)]
        + [np.c_[roof, np.full(len(roof), top_m)]]
    )


def _tube(radius_m: float, bottom_m: float, top_m: float) -> np.ndarray:
    wall = _grid(2 * np.pi * radius_m, top_m - bottom_m)
    angle = wall[:, 0] / radius_m
    return np.c_[radius_m * np.cos(angle), radius_m * np.sin(angle), wall[:, 1] + (top_m + bottom_m) / 2]


def _make_tiny_world() -> TinyWorld:
    rng = np.random.default_rng(7)
    crown = rng.normal(size=(4000, 3))
    crown *= (1.5 * rng.random(4000) ** (1 / 3) / np.linalg.norm(crown, axis=1))[:, None]
    phantom = (rng.random((900, 3)) - [0.5, 0.5, 0.0]) * [7.0, 1.6, 1.5] + [0, 0, 0.2]
    c = classes
    # class, (u, v) of the middle, size, points about the foot; long sides lie along the street.
    things = [
        (c.CAR, (-8.0, -2.6), (4.2, 1.8, 1.45), _box(4.2, 1.8, 0.25, 1.45)),
        (c.CAR, (-1.5, -2.6), (4.2, 1.8, 1.45), _box(4.2, 1.8, 0.25, 1.45)),
        (c.TRAM_BUS, (2.0, 1.7), (6.0, 2.5, 3.0), _box(6.0, 2.5, 0.35, 3.0)),
        (c.PHANTOM, (6.0, -2.0), (7.0, 1.6, 1.7), phantom),
        (c.PEDESTRIAN, (-6.0, 5.0), (0.5, 0.5, 1.75), _tube(0.25, 0.0, 1.75)),
        (c.PEDESTRIAN, (8.0, 5.4), (0.5, 0.5, 1.75), _tube(0.25, 0.0, 1.75)),
        (c.VEGETATION, (-3.0, -5.4), (3.0, 3.0, 5.0), crown + np.array([0, 0, 3.5])),
        (c.COLUMN, (-3.0, -5.4), (0.3, 0.3, 2.0), _tube(0.15, 0.0, 2.0)),
        (c.COLUMN, (-10.0, 4.6), (0.2, 0.2, 4.5), _tube(0.1, 0.0, 4.5)),
        (c.COLUMN, (10.0, -4.6), (0.2, 0.2, 4.5), _tube(0.1, 0.0, 4.5)),
        (c.FURNITURE, (4.0, -5.5), (1.6, 0.5, 0.5), _box(1.6, 0.5, 0.1, 0.5)),
        (c.FURNITURE, (-1.0, 5.2), (0.5, 0.5, 0.9), _tube(0.25, 0.0, 0.9)),
    ]
    ground = _grid(_LENGTH_M, _WIDTH_M)
    # Cars and the tram hide the ground below them.
    for label, (u, v), (length, width, _), _ in things:
        if label in (c.CAR, c.TRAM_BUS):
            ground = ground[(np.abs(ground[:, 0] - u) > length / 2) | (np.abs(ground[:, 1] - v) > width / 2)]
    wall = _grid(_LENGTH_M, 3.6)
    facade = np.c_[wall[:, 0], np.full(len(wall), _WIDTH_M / 2), wall[:, 1] + 1.8]
    parts = [(c.GROUND, 0, np.c_[ground, np.zeros(len(ground))]), (c.FACADE, 0, facade)]
    objects = []
    for instance, (label, (u, v), size_m, points) in enumerate(things, start=1):
        parts.append((label, instance, points + np.array([u, v, 0])))
        foot = _CENTRE + np.r_[np.array([u, v]) @ _AXES, _ground_m(np.array(u), np.array(v))]
        objects.append(TinyObject(instance, label, foot, size_m, _YAW_RAD))
    stray = (rng.random((60, 3)) - [0.5, 0.5, 0]) * [_LENGTH_M, _WIDTH_M, 4.0]
    stray[:20, 2] = -rng.uniform(0.3, 2.0, 20)
    parts.append((c.UNLABELLED, 0, stray))

    local = np.concatenate([p for _, _, p in parts])
    labels = np.concatenate([np.full(len(p), label, np.uint8) for label, _, p in parts])
    instances = np.concatenate([np.full(len(p), i, np.uint32) for _, i, p in parts])
    local[:, 2] += _ground_m(local[:, 0], local[:, 1])
    local += rng.normal(0, _NOISE_M, local.shape)
    # File order is the order of recording: along the street.
    order = np.argsort(local[:, 0], kind="stable")
    local, labels, instances = local[order], labels[order], instances[order]
    points = np.round(_CENTRE + np.c_[local[:, :2] @ _AXES, local[:, 2]], 3)
    n = len(points)
    fields = {
        "intensity": rng.integers(0, 65535, n).astype(np.uint16),
        "time_s": (local[:, 0] + _LENGTH_M) / 8.0,
        "rgb": rng.integers(0, 256, (n, 3)).astype(np.uint8),
        "return_number": np.ones(n, np.uint8),
        "n_returns": np.ones(n, np.uint8),
    }
    return TinyWorld(PointCloud(points, fields, "EPSG:23700"), labels, instances, objects)


@pytest.fixture(scope="session")
def tiny_world() -> TinyWorld:
    """The tiny street, made once; treat it as read-only."""
    return _make_tiny_world()


@pytest.fixture
def tiny_map(tiny_world: TinyWorld, tmp_path: Path) -> Path:
    """Path of the tiny street's map.laz in a fresh folder, with truth/ beside it."""
    return tiny_world.write(tmp_path / "tiny")
