"""What a frame is registered to, behind one call: NDT, and GICP and VGICP of small_gicp as peers.

A target takes points (`add`), finds the pose of other points in it (`fit`), and can forget (`clear`, `drop_beyond`).
"""

from typing import Protocol

import numpy as np
import small_gicp

from streetscan.errors import BadInput
from streetscan.geometry import apply
from streetscan.registration.ndt import Fit, NdtSettings, build_fields, fit
from streetscan.registration.object_target import ObjectTarget

METHODS = ("ndt", "objects", "gicp", "vgicp")
_GICP_ITERATIONS = 50


class Target(Protocol):
    """A target of registration; `points` are (N, 3) float64, metres, without NaN."""

    is_empty: bool

    def add(self, points: np.ndarray, T_target_points: np.ndarray) -> None:
        """Take points, given in another frame, into the target."""

    def fit(self, points: np.ndarray, T_target_source: np.ndarray) -> Fit:
        """The pose of source points, searched from a prediction."""

    def clear(self) -> None:
        """Forget everything."""

    def drop_beyond(self, centre: np.ndarray, distance_m: float) -> None:
        """Forget what is farther than a distance from a place of the target, horizontally."""

    def state(self) -> dict[str, np.ndarray]:
        """Arrays from which `restore` makes the same target again."""

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See `state`."""


class NdtTarget:
    """Normal distributions, coarse to fine (Józsa & Benedek 2013, 6.1)."""

    def __init__(self, settings: NdtSettings, thin_m: float):
        self._settings, self._thin_m = settings, thin_m
        self.clear()

    def clear(self) -> None:
        self._fields = build_fields(np.empty((0, 3)), self._settings)
        self.is_empty = True

    def add(self, points: np.ndarray, T_target_points: np.ndarray) -> None:
        points = apply(T_target_points, points)
        for field in self._fields:
            field.add(points)
        self.is_empty = self.is_empty and len(points) == 0

    def fit(self, points: np.ndarray, T_target_source: np.ndarray) -> Fit:
        return fit(self._fields, points, T_target_source, self._settings, self._thin_m)

    def drop_beyond(self, centre: np.ndarray, distance_m: float) -> None:
        for field in self._fields:
            field.drop_beyond(centre, distance_m)

    def state(self) -> dict[str, np.ndarray]:
        return {f"{name}_{i}": array for i, field in enumerate(self._fields) for name, array in field.state().items()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        for i, field in enumerate(self._fields):
            field.restore(state[f"keys_{i}"], state[f"counts_{i}"], state[f"moments_{i}"])
        self.is_empty = not any(len(field.state()["keys"]) for field in self._fields)


class GicpTarget:
    """Generalised ICP of small_gicp: the points added last are the target (`gicp`), or all of them in voxels (`vgicp`)."""

    # The points a voxel map was made of are kept to make it again; a street's worth at 10 Hz.
    _N_KEPT = 100

    def __init__(self, method: str, thin_m: float, voxel_m: float, max_distance_m: float, n_threads: int):
        self._method, self._thin_m, self._voxel_m = method, thin_m, voxel_m
        self._max_distance_m, self._n_threads = max_distance_m, n_threads
        self.clear()

    def clear(self) -> None:
        self._parts, self._target, self._tree = [], None, None
        self.is_empty = True

    def add(self, points: np.ndarray, T_target_points: np.ndarray) -> None:
        self._insert(apply(T_target_points, points))

    def _insert(self, points: np.ndarray) -> None:
        cloud, tree = self._preprocess(points)
        if self._method == "gicp":
            self._target, self._tree, self._parts = cloud, tree, [points]
        else:
            if self._target is None:
                self._target = small_gicp.GaussianVoxelMap(self._voxel_m)
            self._target.insert(cloud)
            self._parts = [*self._parts, points][-self._N_KEPT :]
        self.is_empty = False

    def _preprocess(self, points):
        return small_gicp.preprocess_points(points, self._thin_m, num_neighbors=10, num_threads=self._n_threads)

    def fit(self, points: np.ndarray, T_target_source: np.ndarray) -> Fit:
        cloud, _ = self._preprocess(points)
        limits = {"max_correspondence_distance": self._max_distance_m, "num_threads": self._n_threads, "max_iterations": _GICP_ITERATIONS}
        if self._method == "gicp":
            result = small_gicp.align(self._target, cloud, self._tree, T_target_source, "GICP", **limits)
        else:
            result = small_gicp.align(self._target, cloud, T_target_source, **limits)
        # small_gicp returns what its steps left of the rotation; chained, the error would double from frame to frame.
        T = np.array(result.T_target_source)
        u, _, vt = np.linalg.svd(T[:3, :3])
        T[:3, :3] = u @ vt
        # small_gicp orders its Hessian rotation first.
        order = [3, 4, 5, 0, 1, 2]
        share = result.num_inliers / max(cloud.size(), 1)
        score = share / (1 + result.error / max(result.num_inliers, 1))
        return Fit(T, score, share, result.H[np.ix_(order, order)], int(result.iterations), bool(result.converged))

    def drop_beyond(self, centre: np.ndarray, distance_m: float) -> None:
        # The voxel map of small_gicp forgets what was not touched for long by itself.
        return

    def state(self) -> dict[str, np.ndarray]:
        return {f"points_{i:03d}": part for i, part in enumerate(self._parts)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        self.clear()
        for name in sorted(state):
            self._insert(state[name])


def make_target(
    method: str,
    ndt: NdtSettings,
    thin_m: float,
    voxel_m: float = 1.0,
    max_distance_m: float = 2.0,
    n_threads: int = 2,
) -> Target:
    """A target of one of METHODS.

    Args:
        method: `ndt`, `objects` (then NDT), `gicp` or `vgicp`.
        ndt: settings of the NDT.
        thin_m: source points (GICP: target points too) are averaged in cubes of this edge; see `streetscan.registration.ndt.fit`.
        voxel_m: voxel of VGICP.
        max_distance_m: farthest correspondence of GICP and VGICP.
        n_threads: threads of small_gicp.
    Raises:
        BadInput: another method.
    """
    if method == "ndt":
        return NdtTarget(ndt, thin_m)
    if method == "objects":
        return ObjectTarget(ndt, thin_m)
    if method in METHODS:
        return GicpTarget(method, thin_m, voxel_m, max_distance_m, n_threads)
    raise BadInput("register_frames.method", f"'{method}'", f"choose one of {', '.join(METHODS)}")
