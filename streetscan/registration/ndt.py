"""The 3-D normal distributions transform: one cloud as a field of Gaussians, another one fitted into it by Newton steps.

Source: Magnusson (2009), chapter 6, which is the method of Józsa & Benedek (2013), 6.1 (J-15, J-16).

Space is divided into cubes; the points of a cube become a Gaussian (mean, covariance). A pose of the source is scored by the
sum over its points of `-d1 * exp(-d2/2 * q' C^-1 q)` with q the distance to the mean of the point's cube, and Newton's method finds the
pose of the largest score. Cells hold sums of moments, so a cube takes more points at any time: the field of one frame and the
field of a street are the same thing.

Where we leave the thesis: the Newton step is taken in the tangent space of the current pose (translation and rotation vector
of the left perturbation) instead of Euler angles, which gives the same function without a singular attitude; the line search
is halving (the thesis: Moré-Thuente); and the cube sizes go from coarse to fine.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from streetscan.errors import BadInput

_N_MOMENTS = 9
EMPTY = np.int64(-(2**62))
_NEIGHBOURS = {
    1: np.zeros((1, 3), np.int64),
    7: np.array([(0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], np.int64),
}


@dataclass(frozen=True)
class NdtSettings:
    """How the Gaussians are made and the pose is sought.

    Attributes:
        sizes_m: edges of the cubes, coarse to fine; the last one decides.
        min_points: a cube with fewer points has no Gaussian.
        n_neighbours: 1 scores a point against the Gaussian of its cube, 7 against those of the six cubes beside it too.
        outlier_ratio: expected share of points without a counterpart (Magnusson, equation 6.7).
        flatness: smallest eigenvalue of a covariance as a share of its largest; keeps walls from being infinitely thin.
        noise_m: standard deviation no Gaussian goes below (range noise of the sensor).
        max_iterations: Newton steps at one size.
        min_step_m: stop when a step moves less than this and turns by less than `min_step_rad`.
        min_step_rad: see `min_step_m`.
    """

    sizes_m: tuple[float, ...] = (4.0, 2.0, 1.0)
    min_points: int = 6
    n_neighbours: int = 7
    outlier_ratio: float = 0.55
    flatness: float = 0.001
    noise_m: float = 0.02
    max_iterations: int = 20
    min_step_m: float = 0.001
    min_step_rad: float = 0.00005

    def __post_init__(self):
        object.__setattr__(self, "sizes_m", tuple(float(s) for s in self.sizes_m))
        if not self.sizes_m or min(self.sizes_m) <= 0:
            raise BadInput("register_frames.sizes_m", f"{self.sizes_m}", "give cube edges above 0 in metres, coarse to fine")
        if self.n_neighbours not in _NEIGHBOURS:
            raise BadInput("register_frames.n_neighbours", f"{self.n_neighbours}", f"choose one of {sorted(_NEIGHBOURS)}")
        if not 0 < self.outlier_ratio < 1:
            raise BadInput("register_frames.outlier_ratio", f"{self.outlier_ratio}", "give a share between 0 and 1")


@dataclass
class Fit:
    """What the search found.

    Attributes:
        T_target_source: (4, 4) float64.
        score: mean of the points' exponentials at the last size, 0 to 1 (to `n_neighbours` at most).
        overlap: share of the source points that lie in a cube with a Gaussian at the last size.
        hessian: (6, 6) of the negative log-likelihood at the solution: x, y, z, then rotation about x, y, z (m, rad).
        n_iterations: Newton steps at all sizes.
        is_converged: the last size ended with a short step and not with `max_iterations`.
    """

    T_target_source: np.ndarray
    score: float
    overlap: float
    hessian: np.ndarray
    n_iterations: int
    is_converged: bool


class NdtField:
    """Gaussians of one cube size, in a hash table; grows by `add`.

    Attributes:
        size_m: edge of a cube.
        n_cells: cubes that hold a point.
    """

    def __init__(self, size_m: float, settings: NdtSettings = NdtSettings()):
        self.size_m, self._settings = float(size_m), settings
        self.n_cells = 0
        self._table = np.full(1 << 12, EMPTY)
        self._rows = np.zeros(1 << 12, np.int32)
        self._allocate(1 << 11)

    def _allocate(self, n: int) -> None:
        old = self.n_cells
        arrays = {
            "_keys": np.zeros((n, 3), np.int64),
            "_counts": np.zeros(n, np.int64),
            "_moments": np.zeros((n, _N_MOMENTS)),
            "_means": np.zeros((n, 3)),
            "_precisions": np.zeros((n, 6)),
            "_is_gaussian": np.zeros(n, np.bool_),
            "_is_dirty": np.zeros(n, np.bool_),
        }
        for name, array in arrays.items():
            if old:
                array[:old] = getattr(self, name)[:old]
            setattr(self, name, array)

    def add(self, points: np.ndarray) -> None:
        """Take points into the field: (N, 3), metres, frame of the field; no NaN."""
        points = np.ascontiguousarray(points, np.float64)
        start = 0
        while start < len(points):
            start, self.n_cells = _insert(
                points,
                start,
                self.size_m,
                self._table,
                self._rows,
                self._keys,
                self._counts,
                self._moments,
                self._is_dirty,
                self.n_cells,
            )
            if start < len(points):
                self._grow()
        s = self._settings
        _make_gaussians(
            self.n_cells,
            self.size_m,
            s.min_points,
            s.flatness,
            s.noise_m**2,
            self._keys,
            self._counts,
            self._moments,
            self._is_dirty,
            self._means,
            self._precisions,
            self._is_gaussian,
        )

    def _grow(self) -> None:
        self._allocate(2 * len(self._counts))
        self._table = np.full(2 * len(self._table), EMPTY)
        self._rows = np.zeros(len(self._table), np.int32)
        _rebuild(self._table, self._rows, self._keys, self.n_cells)

    def drop_beyond(self, centre: np.ndarray, distance_m: float) -> None:
        """Forget the cubes farther than `distance_m` from `centre` (3,) in the horizontal plane."""
        offset = (self._keys[: self.n_cells, :2] + 0.5) * self.size_m - np.asarray(centre)[:2]
        kept = np.flatnonzero(np.hypot(*offset.T) <= distance_m)
        if len(kept) == self.n_cells:
            return
        for name in ("_keys", "_counts", "_moments", "_means", "_precisions", "_is_gaussian", "_is_dirty"):
            array = getattr(self, name)
            array[: len(kept)] = array[kept]
            array[len(kept) : self.n_cells] = 0
        self.n_cells = len(kept)
        self._table[:] = EMPTY
        _rebuild(self._table, self._rows, self._keys, self.n_cells)

    @property
    def gaussians(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means (G, 3), inverse covariances (G, 3, 3) and point counts (G,) of the cubes that have a Gaussian."""
        rows = np.flatnonzero(self._is_gaussian[: self.n_cells])
        a, b, c, d, e, f = self._precisions[rows].T
        return self._means[rows], np.stack([a, b, c, b, d, e, c, e, f], axis=1).reshape(-1, 3, 3), self._counts[rows]

    def state(self) -> dict[str, np.ndarray]:
        """The cubes' sums, enough for `restore` to continue exactly here."""
        return {name: getattr(self, f"_{name}")[: self.n_cells].copy() for name in ("keys", "counts", "moments")}

    def restore(self, keys: np.ndarray, counts: np.ndarray, moments: np.ndarray) -> None:
        """Replace the content by what `state` gave."""
        n = len(keys)
        self.n_cells = 0
        self._allocate(max(2048, 1 << int(np.ceil(np.log2(max(n, 1) + 1)))))
        self._table = np.full(2 * len(self._counts), EMPTY)
        self._rows = np.zeros(len(self._table), np.int32)
        self._keys[:n], self._counts[:n], self._moments[:n], self._is_dirty[:n] = keys, counts, moments, True
        self.n_cells = n
        _rebuild(self._table, self._rows, self._keys, n)
        self.add(np.empty((0, 3)))

    def score(self, points: np.ndarray, T_field_points: np.ndarray) -> float:
        """`Fit.score` of points (M, 3), metres, at a pose (4, 4), without a search; 0 for none."""
        d1, _ = likelihood_constants(self._settings.outlier_ratio, self.size_m)
        cost = self._evaluate(points, T_field_points[:3, :3].copy(), T_field_points[:3, 3].copy(), False)[0]
        return float(cost / d1 / max(len(points), 1))

    def _evaluate(self, points, rotation, translation, with_derivatives):
        d1, d2 = likelihood_constants(self._settings.outlier_ratio, self.size_m)
        return _evaluate(
            points,
            rotation,
            translation,
            self.size_m,
            _NEIGHBOURS[self._settings.n_neighbours],
            self._table,
            self._rows,
            self._means,
            self._precisions,
            self._is_gaussian,
            -d1,
            d2,
            with_derivatives,
        )


def likelihood_constants(outlier_ratio: float, size_m: float) -> tuple[float, float]:
    """d1 (negative) and d2 of the Gaussian that replaces the logarithm of a Gaussian plus a uniform outlier density.

    Source: Magnusson (2009), equations 6.7 and 6.8.
    """
    c1, c2 = 10 * (1 - outlier_ratio), outlier_ratio / size_m**3
    d3 = -np.log(c2)
    d1 = -np.log(c1 + c2) - d3
    d2 = -2 * np.log((-np.log(c1 * np.exp(-0.5) + c2) - d3) / d1)
    return float(d1), float(d2)


def build_fields(points: np.ndarray, settings: NdtSettings) -> list[NdtField]:
    """The fields of a target, one per cube size, coarse to fine. `points`: (N, 3), metres, no NaN."""
    fields = [NdtField(size, settings) for size in settings.sizes_m]
    for field in fields:
        field.add(points)
    return fields


def thin_points(points: np.ndarray, size_m: float) -> np.ndarray:
    """One point per cube: the mean of its points, (M, 3) float64, in the order in which the cubes first appear."""
    points = np.ascontiguousarray(points, np.float64)
    if size_m <= 0 or len(points) == 0:
        return points.reshape(-1, 3)
    n_table = 1 << int(np.ceil(np.log2(2 * len(points) + 2)))
    return _thin(points, size_m, np.full(n_table, EMPTY), np.zeros(n_table, np.int32))


def fit(fields: list[NdtField], points: np.ndarray, T_target_source: np.ndarray, settings: NdtSettings, thin_m: float = 0.0) -> Fit:
    """Pose of the source in the target by Newton's method, from the coarsest to the finest field.

    Args:
        fields: the target (`build_fields`, or fields that grew).
        points: (M, 3) float64 source points, metres, source frame.
        T_target_source: (4, 4) float64 prediction.
        settings: see NdtSettings.
        thin_m: the points are averaged in cubes of this edge for the finest field, and in cubes as many times larger for each
            coarser one as its cubes are larger; 0 takes them as they are.
    Returns:
        the fit; with no source point or no Gaussian its overlap is 0 and its pose the prediction.
    Source: Magnusson (2009), 6.2 and algorithm 2.
    """
    rotation, translation = T_target_source[:3, :3].copy(), T_target_source[:3, 3].copy()
    n_steps, is_converged, hessian, score, overlap = 0, False, np.zeros((6, 6)), 0.0, 0.0
    for field in fields:
        thinned = thin_points(points, thin_m * field.size_m / fields[-1].size_m)
        rotation, translation, score, overlap, hessian, n, is_converged = _search(field, thinned, rotation, translation, settings)
        n_steps += n
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return Fit(T, score, overlap, hessian, n_steps, is_converged)


def _search(field, points, rotation, translation, settings):
    d1, _ = likelihood_constants(settings.outlier_ratio, field.size_m)
    cost, gradient, newton, gauss, n_hit = field._evaluate(points, rotation, translation, True)
    is_converged, n = False, 0
    while n < settings.max_iterations and n_hit > 0:
        n += 1
        step = _newton_step(gradient, newton, gauss, field.size_m)
        # Halving: a step is taken once it raises the score by a little of what its slope promises (Armijo).
        slope, scale, found = float(gradient @ step), 1.0, None
        for _ in range(6):
            trial = (_rotation_of(scale * step[3:]) @ rotation, translation + scale * step[:3])
            result = field._evaluate(points, *trial, True)
            if result[0] <= cost + 1e-4 * scale * slope:
                found = result
                break
            scale /= 2
        if found is None:
            is_converged = True
            break
        rotation, translation = trial
        cost, gradient, newton, gauss, n_hit = found
        if np.linalg.norm(scale * step[:3]) < settings.min_step_m and np.linalg.norm(scale * step[3:]) < settings.min_step_rad:
            is_converged = True
            break
    # Re-orthogonalise: products of many small rotations drift.
    u, _, vt = np.linalg.svd(rotation)
    n_points = max(len(points), 1)
    return u @ vt, translation, -cost / -d1 / n_points, n_hit / n_points, gauss, n, is_converged


def _newton_step(gradient: np.ndarray, newton: np.ndarray, gauss: np.ndarray, size_m: float) -> np.ndarray:
    """Minimising step. Far from the optimum the Hessian is not positive definite; its first part, which always is, then serves."""
    scale = np.sqrt(np.maximum(np.diag(gauss), 1e-9))
    for matrix in (newton, gauss):
        values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
        if values[0] > 1e-6:
            break
    # A direction the points do not fix (a bare tunnel) is left where the prediction put it.
    weights = np.where(values > 1e-6, 1 / np.maximum(values, 1e-6), 0.0)
    step = -(vectors @ (weights * (vectors.T @ (gradient / scale)))) / scale
    # A Gaussian is felt about one cube far; the rotation limit is the same length at a few cubes' distance.
    return step * min(1.0, 0.5 * size_m / max(np.linalg.norm(step[:3]), 1e-12), 0.05 * size_m / max(np.linalg.norm(step[3:]), 1e-12))


def _rotation_of(vector: np.ndarray) -> np.ndarray:
    """Rodrigues' formula; `vector` (3,) rotation vector in radians."""
    angle = np.linalg.norm(vector)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


@njit(inline="always")
def pack_cell(i, j, k):
    # 21 bits an axis, as in streetscan.voxels.
    half = 1 << 20
    return ((i + half) << 42) | ((j + half) << 21) | (k + half)


@njit(inline="always")
def _slot_of(key, n_table):
    # A table is a power of two long; multiplying by an odd constant spreads neighbouring keys over it.
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((h >> np.uint64(32)) & np.uint64(n_table - 1))


@njit(inline="always")
def find_slot(table, key):
    """Slot that holds the key, or the empty slot where it belongs."""
    n_table = len(table)
    slot = _slot_of(key, n_table)
    while table[slot] != key and table[slot] != EMPTY:
        slot = (slot + 1) & (n_table - 1)
    return slot


@njit(cache=True, nogil=True)
def _rebuild(table, rows, keys, n_cells):
    for row in range(n_cells):
        key = pack_cell(keys[row, 0], keys[row, 1], keys[row, 2])
        slot = find_slot(table, key)
        table[slot] = key
        rows[slot] = row


@njit(cache=True, nogil=True)
def _insert(points, start, size, table, rows, keys, counts, moments, is_dirty, n_cells):
    """Adds points from `start` on; returns where it stopped (the tables are full) and the number of cells."""
    for p in range(start, len(points)):
        i, j, k = int(np.floor(points[p, 0] / size)), int(np.floor(points[p, 1] / size)), int(np.floor(points[p, 2] / size))
        key = pack_cell(i, j, k)
        slot = find_slot(table, key)
        if table[slot] == EMPTY:
            if n_cells == len(counts):
                return p, n_cells
            table[slot] = key
            rows[slot] = n_cells
            keys[n_cells, 0], keys[n_cells, 1], keys[n_cells, 2] = i, j, k
            n_cells += 1
        row = rows[slot]
        # Moments about the cube's centre: exact far from the origin too.
        x, y, z = points[p, 0] - (i + 0.5) * size, points[p, 1] - (j + 0.5) * size, points[p, 2] - (k + 0.5) * size
        counts[row] += 1
        is_dirty[row] = True
        m = moments[row]
        m[0] += x
        m[1] += y
        m[2] += z
        m[3] += x * x
        m[4] += x * y
        m[5] += x * z
        m[6] += y * y
        m[7] += y * z
        m[8] += z * z
    return len(points), n_cells


@njit(cache=True, nogil=True)
def _make_gaussians(n_cells, size, min_points, flatness, min_variance, keys, counts, moments, is_dirty, means, precisions, is_gaussian):
    covariance = np.empty((3, 3))
    for row in range(n_cells):
        if not is_dirty[row]:
            continue
        is_dirty[row] = False
        n = counts[row]
        if n < min_points:
            continue
        m = moments[row]
        x, y, z = m[0] / n, m[1] / n, m[2] / n
        means[row, 0] = x + (keys[row, 0] + 0.5) * size
        means[row, 1] = y + (keys[row, 1] + 0.5) * size
        means[row, 2] = z + (keys[row, 2] + 0.5) * size
        f = 1.0 / (n - 1)
        covariance[0, 0] = (m[3] - n * x * x) * f
        covariance[0, 1] = (m[4] - n * x * y) * f
        covariance[0, 2] = (m[5] - n * x * z) * f
        covariance[1, 1] = (m[6] - n * y * y) * f
        covariance[1, 2] = (m[7] - n * y * z) * f
        covariance[2, 2] = (m[8] - n * z * z) * f
        covariance[1, 0], covariance[2, 0], covariance[2, 1] = covariance[0, 1], covariance[0, 2], covariance[1, 2]
        values, vectors = _eigen(covariance)
        largest = max(values[0], max(values[1], values[2]))
        smallest = max(flatness * largest, min_variance)
        for a in range(6):
            precisions[row, a] = 0.0
        for a in range(3):
            w = 1.0 / max(values[a], smallest)
            u, v, t = vectors[0, a], vectors[1, a], vectors[2, a]
            precisions[row, 0] += w * u * u
            precisions[row, 1] += w * u * v
            precisions[row, 2] += w * u * t
            precisions[row, 3] += w * v * v
            precisions[row, 4] += w * v * t
            precisions[row, 5] += w * t * t
        is_gaussian[row] = True


@njit(cache=True, nogil=True)
def _eigen(matrix):
    """Eigenvalues and vectors (columns) of a symmetric 3x3 matrix by Jacobi rotations; several times as fast as LAPACK here."""
    a = matrix.copy()
    v = np.eye(3)
    for _ in range(12):
        off = a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2] + a[1, 2] * a[1, 2]
        if off <= 1e-20 * (a[0, 0] * a[0, 0] + a[1, 1] * a[1, 1] + a[2, 2] * a[2, 2]) or off == 0.0:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                theta = (a[q, q] - a[p, p]) / (2 * a[p, q])
                t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1))
                c = 1 / np.sqrt(t * t + 1)
                s = t * c
                for k in range(3):
                    x, y = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * x - s * y, s * x + c * y
    return np.array([a[0, 0], a[1, 1], a[2, 2]]), v


@njit(cache=True, nogil=True)
def _thin(points, size, table, rows):
    sums = np.zeros((len(points), 3))
    counts = np.zeros(len(points), np.int64)
    n = 0
    for p in range(len(points)):
        key = pack_cell(int(np.floor(points[p, 0] / size)), int(np.floor(points[p, 1] / size)), int(np.floor(points[p, 2] / size)))
        slot = find_slot(table, key)
        if table[slot] == EMPTY:
            table[slot] = key
            rows[slot] = n
            n += 1
        row = rows[slot]
        counts[row] += 1
        for a in range(3):
            sums[row, a] += points[p, a]
    out = np.empty((n, 3))
    for row in range(n):
        for a in range(3):
            out[row, a] = sums[row, a] / counts[row]
    return out


# One thread: a pair takes milliseconds, and two threads that wait for each other on a busy machine take ten times as long.
@njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz"})
def _evaluate(points, rotation, translation, size, offsets, table, rows, means, precisions, is_gaussian, w, d2, with_derivatives):
    """Cost (negative score), gradient, Hessian, its positive part and the number of points in a Gaussian's reach.

    The perturbation is p' = exp(omega) R p + T + tau about the source's origin, so with y = R p the derivatives at zero are
    dp'/dtau = I, dp'/domega_i = e_i x y, d2p'/domega_i domega_j = (y_i e_j + y_j e_i) / 2 - y delta_ij.
    """
    # 0 cost, 1-6 gradient, 7-27 positive part of the Hessian, 28-48 the rest, 49 points in reach.
    total = np.zeros(50)
    u = np.empty(6)
    cj = np.empty((3, 6))
    for p in range(len(points)):
        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
        y0 = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz
        y1 = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz
        y2 = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz
        x0, x1, x2 = y0 + translation[0], y1 + translation[1], y2 + translation[2]
        i, j, k = int(np.floor(x0 / size)), int(np.floor(x1 / size)), int(np.floor(x2 / size))
        is_hit = False
        for o in range(len(offsets)):
            key = pack_cell(i + offsets[o, 0], j + offsets[o, 1], k + offsets[o, 2])
            slot = find_slot(table, key)
            if table[slot] == EMPTY:
                continue
            row = rows[slot]
            if not is_gaussian[row]:
                continue
            is_hit = True
            q0, q1, q2 = x0 - means[row, 0], x1 - means[row, 1], x2 - means[row, 2]
            c00, c01, c02 = precisions[row, 0], precisions[row, 1], precisions[row, 2]
            c11, c12, c22 = precisions[row, 3], precisions[row, 4], precisions[row, 5]
            g0, g1, g2 = c00 * q0 + c01 * q1 + c02 * q2, c01 * q0 + c11 * q1 + c12 * q2, c02 * q0 + c12 * q1 + c22 * q2
            e = w * np.exp(-0.5 * d2 * (q0 * g0 + q1 * g1 + q2 * g2))
            total[0] -= e
            if not with_derivatives or e < 1e-8 * w:
                continue
            f = e * d2
            # u = J' C q
            u[0], u[1], u[2] = g0, g1, g2
            u[3], u[4], u[5] = y1 * g2 - y2 * g1, y2 * g0 - y0 * g2, y0 * g1 - y1 * g0
            for a in range(6):
                total[1 + a] += f * u[a]
            # C J, columns of the rotation: C (e_i x y)
            cj[0, 0], cj[0, 1], cj[0, 2] = c00, c01, c02
            cj[1, 0], cj[1, 1], cj[1, 2] = c01, c11, c12
            cj[2, 0], cj[2, 1], cj[2, 2] = c02, c12, c22
            for a in range(3):
                s0, s1, s2 = cj[a, 0], cj[a, 1], cj[a, 2]
                cj[a, 3] = -y2 * s1 + y1 * s2
                cj[a, 4] = y2 * s0 - y0 * s2
                cj[a, 5] = -y1 * s0 + y0 * s1
            # J' C J, row of a rotation: (e_i x y)' (C J)
            at = 7
            for a in range(6):
                for b in range(a, 6):
                    if a < 3:
                        value = cj[a, b]
                    elif a == 3:
                        value = -y2 * cj[1, b] + y1 * cj[2, b]
                    elif a == 4:
                        value = y2 * cj[0, b] - y0 * cj[2, b]
                    else:
                        value = -y1 * cj[0, b] + y0 * cj[1, b]
                    total[at] += f * value
                    total[at + 21] -= f * d2 * u[a] * u[b]
                    at += 1
            # q' C d2p', only between rotations: (3,3) (3,4) (3,5) (4,4) (4,5) (5,5)
            dot = y0 * g0 + y1 * g1 + y2 * g2
            total[43] += f * (y0 * g0 - dot)
            total[44] += f * 0.5 * (y0 * g1 + y1 * g0)
            total[45] += f * 0.5 * (y0 * g2 + y2 * g0)
            total[46] += f * (y1 * g1 - dot)
            total[47] += f * 0.5 * (y1 * g2 + y2 * g1)
            total[48] += f * (y2 * g2 - dot)
        if is_hit:
            total[49] += 1
    gauss, newton = np.zeros((6, 6)), np.zeros((6, 6))
    at = 7
    for a in range(6):
        for b in range(a, 6):
            gauss[a, b] = gauss[b, a] = total[at]
            newton[a, b] = newton[b, a] = total[at] + total[at + 21]
            at += 1
    return total[0], total[1:7].copy(), newton, gauss, int(total[49])
