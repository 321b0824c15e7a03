"""The transform between two sets of objects by voting over dx, dy, dz and a turn about the vertical.

Source: Nagy (2020), 3.3.3.2 and 3.3.3.3 (N-114..N-120): a tall column goes with blobs at least twice as high as wide and deep,
furniture with blobs of 0.75 to 1.25 times its volume; every pair of counterparts votes, for every turn, for the shift that unites them.

The thesis' array of all shifts and turns has 111 million cells in its own window. Turns do not share votes, so one turn at a time is
voted on in an array of shifts alone, and only its best cells are kept: 0.6 MiB instead of 424. Every third turn is voted on first, which
the cells beside a peak make up for, and all turns near the best of them afterwards; and a pair votes only for turns that can bring
its objects together within the window.

Beyond the thesis: a cell is judged together with its neighbours, several peaks are kept, and each is moved to the place where most
objects agree (`consensus`), which is finer than a cell and tells how much better the best peak is than the next.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from streetscan.classes import COLUMN, FURNITURE
from streetscan.errors import BadInput
from streetscan.geometry import angle_difference
from streetscan.localization.keypoints import ObjectSet


@dataclass(frozen=True)
class Window:
    """The transforms that are searched, about a start; lengths in metres, angles in degrees.

    Attributes:
        turn_deg: largest turn to either side (thesis: 45); 180 is the full circle.
        shift_m: largest dx and dy to either side (thesis: 12).
        rise_m: largest dz (thesis: 2).
        turn_step_deg: step of the turn (thesis: 0.25).
        step_m: edge of a cell (thesis: 0.2).
    """

    turn_deg: float = 45.0
    shift_m: float = 12.0
    rise_m: float = 2.0
    turn_step_deg: float = 0.25
    step_m: float = 0.2

    def __post_init__(self):
        for name in ("shift_m", "rise_m", "turn_step_deg", "step_m"):
            if not getattr(self, name) > 0:
                raise BadInput(f"window.{name}", f"{getattr(self, name)} is not above 0", "give a positive number")
        if not 0 <= self.turn_deg <= 180:
            raise BadInput("window.turn_deg", f"{self.turn_deg} is not within 0..180", "give the largest turn in degrees")

    @property
    def turns_rad(self) -> np.ndarray:
        """(A,) the turns, evenly around 0; the full circle once."""
        n = round(self.turn_deg / self.turn_step_deg)
        steps = np.arange(-n, n + (0 if self.turn_deg == 180 else 1))
        return np.radians(steps * self.turn_step_deg)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells of dx, dy and dz."""
        n, m = round(self.shift_m / self.step_m), round(self.rise_m / self.step_m)
        return 2 * n + 1, 2 * n + 1, 2 * m + 1


@dataclass(frozen=True)
class Compatibility:
    """Which blobs may be which landmark.

    Attributes:
        column_ratio: least height over width and depth of a blob that may be a tall column (thesis: 2).
        min_volume_ratio, max_volume_ratio: of a blob that may be a piece of furniture (thesis: 0.75, 1.25).
        is_slim_furniture_tall: furniture as slim as a column (bollards, posts) goes with slim blobs too. ASSUME: a box 0.2 m wide has no
            volume to compare, since a row of points more doubles it.
    """

    column_ratio: float = 2.0
    min_volume_ratio: float = 0.75
    max_volume_ratio: float = 1.25
    is_slim_furniture_tall: bool = True


@dataclass
class Peak:
    """A transform that many pairs of objects agree on.

    Attributes:
        shift_m: (3,) dx, dy, dz.
        turn_rad: counter-clockwise about the vertical, applied before the shift.
        votes: of the cell and its neighbours, before `refine_peaks`.
        consensus: objects that agree, each counted by how well its keypoints fit (0 to 1); NaN before `refine_peaks`.
        pairs: (I, 2) int64 observed object and landmark of each agreeing pair.
        covariance: (4, 4) of dx, dy, dz (m) and turn (rad), from the scatter of the keypoints; NaN with fewer than 3 pairs.
    """

    shift_m: np.ndarray
    turn_rad: float
    votes: int
    consensus: float = np.nan
    pairs: np.ndarray = None
    covariance: np.ndarray = None


def find_compatible(observed: ObjectSet, landmarks: ObjectSet, kinds: np.ndarray, rule: Compatibility = Compatibility()) -> np.ndarray:
    """Pairs (P, 2) int64 of observed object and landmark that may be the same.

    Args:
        observed: Mo blobs.
        landmarks: Ml landmarks.
        kinds: (Ml,) uint8 COLUMN or FURNITURE.
        rule: see Compatibility.
    """
    sizes = observed.sizes_m
    is_tall = sizes[:, 2] >= rule.column_ratio * sizes[:, :2].max(axis=1, initial=0)
    volumes, own = observed.volumes_m3[:, None], landmarks.volumes_m3[None]
    is_alike = (volumes >= rule.min_volume_ratio * own) & (volumes <= rule.max_volume_ratio * own)
    is_column = kinds == COLUMN
    if rule.is_slim_furniture_tall:
        is_column = is_column | (landmarks.sizes_m[:, 2] >= rule.column_ratio * landmarks.sizes_m[:, :2].max(axis=1, initial=0))
    fits = (is_tall[:, None] & is_column[None]) | (is_alike & (kinds == FURNITURE)[None])
    return np.argwhere(fits)


def count_pairs(pairs: np.ndarray) -> int:
    """Most pairs that can be true at once: no blob and no landmark twice, at most the fewer of the two."""
    return int(min(len(np.unique(pairs[:, 0])), len(np.unique(pairs[:, 1])))) if len(pairs) else 0


def vote(
    observed: ObjectSet, landmarks: ObjectSet, pairs: np.ndarray, n_keypoints: int, window: Window = Window(), n_peaks: int = 8
) -> list[Peak]:
    """The peaks of the vote.

    Args:
        observed: blobs about the start: origin at the sensor, axes turned as the start says, vertical as the map's.
        landmarks: about the same origin and axes.
        pairs: (P, 2) of `find_compatible`.
        n_keypoints: 1, 4, 8 or 16.
        window: what is searched.
        n_peaks: at most so many peaks are given, a metre or three degrees apart.
    Returns:
        peaks, the most voted for first; none without a pair.
    Source: Nagy (2020), 3.3.3.3.
    """
    if len(pairs) == 0:
        return []
    own, theirs = observed.keypoints(n_keypoints), landmarks.keypoints(n_keypoints)
    n_x, n_y, n_z = window.shape
    turns = window.turns_rad
    votes = np.zeros(n_x * n_y * n_z, np.uint16)
    n_votes = len(pairs) * own.shape[1] * own.shape[2]
    cells, high_cells = np.empty(n_votes, np.int32), np.empty((n_votes, 2), np.int32)
    reaches = _reaches(observed, landmarks, pairs, window.shift_m * np.sqrt(2))
    can_meet = np.abs(reaches[:, 0]) - reaches[:, 1] <= turns[-1] if window.turn_deg < 180 else reaches[:, 1] >= 0
    pairs, reaches = pairs[can_meet], reaches[can_meet]
    # How many quarter turns bring the boxes of a pair into line, but for the turn that is tried.
    quarters = (observed.yaws_rad[pairs[:, 0]] - landmarks.yaws_rad[pairs[:, 1]]) / (np.pi / 2)
    rest = theirs, pairs, quarters, reaches, turns
    stride = max(int(_COARSE_RAD / (turns[1] - turns[0]) + 1e-6), 1) if len(turns) > 1 else 1
    chosen = np.arange(0, len(turns), stride)
    best = _vote(own, *rest, chosen, n_x, n_y, n_z, window.step_m, votes, cells, high_cells)
    if stride > 1:
        leading = best[np.argsort(-best[:, 0], kind="stable")[:_N_LEADING], 4]
        chosen = np.unique(np.clip(leading[:, None] + np.arange(1 - stride, stride), 0, len(turns) - 1))
        best = _vote(own, *rest, chosen, n_x, n_y, n_z, window.step_m, votes, cells, high_cells)
    order = np.argsort(-best[:, 0], kind="stable")
    peaks: list[Peak] = []
    for row in order:
        votes, x, y, z, a = best[row]
        if votes <= 0 or len(peaks) == n_peaks:
            break
        shift = (np.array([x - n_x // 2, y - n_y // 2, z - n_z // 2])) * window.step_m
        if all(_is_apart(shift, turns[a], p.shift_m, p.turn_rad) for p in peaks):
            peaks.append(Peak(shift, float(turns[a]), int(votes)))
    return peaks


def _reaches(observed: ObjectSet, landmarks: ObjectSet, pairs: np.ndarray, shift_m: float) -> np.ndarray:
    """(P, 2) middle (within +-pi) and half width of the turns that can bring the two objects of a pair within a shift, radians.

    A half width of pi is every turn, one below 0 none.
    """
    own, theirs = (o.corners.mean(axis=(1, 2))[pairs[:, i], :2] for i, o in enumerate((observed, landmarks)))
    sizes = (np.hypot(*o.sizes_m[pairs[:, i], :2].T) for i, o in enumerate((observed, landmarks)))
    limit = shift_m + sum(sizes)
    a, b = np.hypot(*own.T), np.hypot(*theirs.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (a * a + b * b - limit * limit) / (2 * a * b)
    half = np.where(cosine < 1, np.arccos(np.clip(np.nan_to_num(cosine, nan=-1.0), -1, 1)), -1.0)
    middle = angle_difference(np.arctan2(theirs[:, 1], theirs[:, 0]), np.arctan2(own[:, 1], own[:, 0]))
    return np.stack([middle, half], axis=1)


# Turns about so many of the best cells are voted on again.
_N_LEADING = 8
# Step of the turns that are voted on first: at 30 m half of it is a cell.
_COARSE_RAD = np.radians(0.75)
_APART_M, _APART_RAD = 1.0, np.radians(3.0)


def _is_apart(shift_a, turn_a, shift_b, turn_b) -> bool:
    turned = abs((turn_a - turn_b + np.pi) % (2 * np.pi) - np.pi)
    return bool(np.hypot(*(shift_a - shift_b)[:2]) > _APART_M or turned > _APART_RAD)


# Best cells kept of each turn.
_PER_TURN = 4


@njit(cache=True, nogil=True)
def _vote(own, theirs, pairs, quarters, reaches, turns, chosen, n_x, n_y, n_z, step, votes, cells, high_cells):
    """Per turn the best cells: votes with neighbours, x, y, z, turn; the arrays are scratch, given and left empty."""
    n_columns, n_keypoints = own.shape[2], own.shape[1] * own.shape[2]
    best = np.zeros((len(chosen) * _PER_TURN, 5), np.int64)
    # Lengths in cells from here on, a row of numbers per axis: what is alike for all keypoints of a pair is done for all at once.
    turned = np.empty((own.shape[0], 3, n_keypoints))
    placed = _place(theirs, step)
    found = np.empty(n_keypoints, np.int32)
    half_x, half_y, half_z = n_x // 2 + 0.5, n_y // 2 + 0.5, n_z // 2 + 0.5
    for at, t in enumerate(chosen):
        c, s = np.cos(turns[t]), np.sin(turns[t])
        for m in range(own.shape[0]):
            for j in range(n_keypoints):
                layer, q = j // n_columns, j % n_columns
                x, y = own[m, layer, q, 0], own[m, layer, q, 1]
                turned[m, 0, j] = (c * x - s * y) / step - half_x
                turned[m, 1, j] = (s * x + c * y) / step - half_y
                turned[m, 2, j] = own[m, layer, q, 2] / step - half_z
        n = 0
        for p in range(len(pairs)):
            off = abs(turns[t] - reaches[p, 0])
            if min(off, 2 * np.pi - off) > reaches[p, 1]:
                continue
            # The column of the counterpart moves by as many; one or four columns, so that a bit mask wraps their numbers.
            quarter = int(np.rint(quarters[p] + turns[t] / (np.pi / 2))) & (n_columns - 1)
            ours, their = turned[pairs[p, 0]], placed[pairs[p, 1], quarter]
            for j in range(n_keypoints):
                x, y, z = their[0, j] - ours[0, j], their[1, j] - ours[1, j], their[2, j] - ours[2, j]
                # Written so that NaN, a keypoint that does not exist, fails.
                is_inside = (x >= 0) & (x < n_x) & (y >= 0) & (y < n_y) & (z >= 0) & (z < n_z)
                cell = (np.int32(x) * np.int32(n_y) + np.int32(y)) * np.int32(n_z) + np.int32(z)
                found[j] = cell if is_inside else np.int32(-1)
            # Without a branch: whether a keypoint is inside cannot be foreseen.
            for j in range(n_keypoints):
                cells[n] = found[j]
                n += found[j] >= 0
        n_high, highest, least = 0, 0, 0
        for i in range(n):
            number = votes[cells[i]] + 1
            votes[cells[i]] = number
            # The last vote of a cell that is high at the end makes it high among those before it.
            if number >= least:
                if number > highest:
                    highest, least = number, 2 * number // 3
                high_cells[n_high, 0], high_cells[n_high, 1] = cells[i], number
                n_high += 1
        # Only cells nearly as high as the highest can be the best with their neighbours.
        least = max(least, 1)
        kept = best[at * _PER_TURN : (at + 1) * _PER_TURN]
        for i in range(n_high):
            cell = high_cells[i, 0]
            # A cell is looked at once, at its last vote.
            if votes[cell] < least or votes[cell] != high_cells[i, 1]:
                continue
            x, y, z = cell // n_z // n_y, cell // n_z % n_y, cell % n_z
            total = 0
            for a in range(max(x - 1, 0), min(x + 2, n_x)):
                for b in range(max(y - 1, 0), min(y + 2, n_y)):
                    for d in range(max(z - 1, 0), min(z + 2, n_z)):
                        total += votes[(a * n_y + b) * n_z + d]
            _keep(kept, total, x, y, z, t)
        for i in range(n):
            votes[cells[i]] = 0
    return best


@njit(cache=True, nogil=True)
def _place(theirs, step):
    """Landmarks' keypoints (M, Q, 3, K) in cells, an axis a row, for each quarter turn by which their columns may move."""
    n_layers, n_columns = theirs.shape[1], theirs.shape[2]
    placed = np.empty((len(theirs), n_columns, 3, n_layers * n_columns))
    for m in range(len(theirs)):
        for quarter in range(n_columns):
            for layer in range(n_layers):
                for q in range(n_columns):
                    for axis in range(3):
                        column = (q + quarter) & (n_columns - 1)
                        placed[m, quarter, axis, layer * n_columns + q] = theirs[m, layer, column, axis] / step
    return placed


@njit(cache=True, nogil=True)
def _keep(kept, total, x, y, z, t):
    """Enter a cell among the best of its turn; of two that are neighbours the higher stays."""
    if total <= kept[-1, 0]:
        return
    at = len(kept) - 1
    for k in range(len(kept)):
        if kept[k, 0] > 0 and abs(kept[k, 1] - x) <= 3 and abs(kept[k, 2] - y) <= 3:
            if kept[k, 0] >= total:
                return
            at = k
            break
    while at > 0 and kept[at - 1, 0] < total:
        kept[at] = kept[at - 1]
        at -= 1
    kept[at, 0], kept[at, 1], kept[at, 2], kept[at, 3], kept[at, 4] = total, x, y, z, t


# Boxes with their middles farther apart have no corner in common; of blobs up to 8 m long, seen in part.
_NEAR_M = 5.0
# A pair agrees from this mean weight of its keypoints on.
_MIN_WEIGHT = 0.15


def refine_peaks(
    peaks: list[Peak], observed: ObjectSet, landmarks: ObjectSet, pairs: np.ndarray, n_keypoints: int, reach_m: float = 0.6
) -> list[Peak]:
    """Peaks at the place where most objects agree, best first; peaks that meet become one.

    Each blob holds on to the landmark that fits it best, and each keypoint pulls the less the farther it is off (Tukey's weight).

    Args:
        peaks: of `vote`.
        observed, landmarks, pairs, n_keypoints: as given to `vote`.
        reach_m: a keypoint farther off has no weight.
    """
    own, theirs = observed.keypoints(n_keypoints), landmarks.keypoints(n_keypoints)
    refined: list[Peak] = []
    for peak in peaks:
        pose, consensus, agreeing, covariance = _refine(
            own, observed.yaws_rad, theirs, landmarks.yaws_rad, pairs, *peak.shift_m, peak.turn_rad, reach_m
        )
        refined.append(Peak(pose[:3].copy(), float(pose[3]), peak.votes, float(consensus), agreeing, covariance))
    refined.sort(key=lambda p: -p.consensus)
    kept: list[Peak] = []
    for peak in refined:
        if all(_is_apart(peak.shift_m, peak.turn_rad, k.shift_m, k.turn_rad) for k in kept):
            kept.append(peak)
    return kept


@njit(cache=True, nogil=True)
def _refine(own, own_yaws, theirs, their_yaws, pairs, dx, dy, dz, turn, reach):
    n_layers, n_columns = own.shape[1], own.shape[2]
    n_keypoints = n_layers * n_columns
    n_objects = own.shape[0]
    best_pair, best_weight = np.full(n_objects, -1, np.int64), np.zeros(n_objects)
    pairs = _pairs_near(own, theirs, pairs, dx, dy, turn)
    covariance = np.full((4, 4), np.nan)
    for iteration in range(12):
        # The reach shrinks: at first the cell's own width counts, at the end what fits.
        r2 = (reach * max(1.6 - 0.15 * iteration, 1.0)) ** 2
        c, s = np.cos(turn), np.sin(turn)
        best_pair[:], best_weight[:] = -1, 0.0
        for p in range(len(pairs)):
            o, m = pairs[p, 0], pairs[p, 1]
            quarter = int(np.rint((own_yaws[o] + turn - their_yaws[m]) / (np.pi / 2))) if n_columns == 4 else 0
            total = 0.0
            for layer in range(n_layers):
                for q in range(n_columns):
                    k = (q + quarter) & (n_columns - 1)
                    ex = theirs[m, layer, k, 0] - (c * own[o, layer, q, 0] - s * own[o, layer, q, 1]) - dx
                    ey = theirs[m, layer, k, 1] - (s * own[o, layer, q, 0] + c * own[o, layer, q, 1]) - dy
                    ez = theirs[m, layer, k, 2] - own[o, layer, q, 2] - dz
                    e2 = ex * ex + ey * ey + ez * ez
                    if e2 < r2:
                        total += (1 - e2 / r2) ** 2
            if total / n_keypoints > best_weight[o]:
                best_weight[o], best_pair[o] = total / n_keypoints, p
        # Of two blobs at one landmark the one that fits better counts.
        for o in range(n_objects):
            for other in range(o):
                if best_pair[o] >= 0 and best_pair[other] >= 0 and pairs[best_pair[o], 1] == pairs[best_pair[other], 1]:
                    if best_weight[o] > best_weight[other]:
                        best_pair[other], best_weight[other] = -1, 0.0
                    else:
                        best_pair[o], best_weight[o] = -1, 0.0
        if iteration == 11:
            break
        # Weighted rigid fit in the plane, mean in height.
        w, ox, oy, oz, lx, ly, lz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        dot, cross = 0.0, 0.0
        for sweep in range(2):
            for o in range(n_objects):
                p = best_pair[o]
                if p < 0:
                    continue
                m = pairs[p, 1]
                quarter = int(np.rint((own_yaws[o] + turn - their_yaws[m]) / (np.pi / 2))) if n_columns == 4 else 0
                for layer in range(n_layers):
                    for q in range(n_columns):
                        k = (q + quarter) & (n_columns - 1)
                        ax, ay, az = own[o, layer, q, 0], own[o, layer, q, 1], own[o, layer, q, 2]
                        bx, by, bz = theirs[m, layer, k, 0], theirs[m, layer, k, 1], theirs[m, layer, k, 2]
                        e2 = (bx - (c * ax - s * ay) - dx) ** 2 + (by - (s * ax + c * ay) - dy) ** 2 + (bz - az - dz) ** 2
                        if not e2 < r2:
                            continue
                        g = (1 - e2 / r2) ** 2
                        if sweep == 0:
                            w += g
                            ox += g * ax
                            oy += g * ay
                            oz += g * az
                            lx += g * bx
                            ly += g * by
                            lz += g * bz
                        else:
                            ux, uy, vx, vy = ax - ox, ay - oy, bx - lx, by - ly
                            dot += g * (ux * vx + uy * vy)
                            cross += g * (ux * vy - uy * vx)
            if w <= 1e-9:
                break
            if sweep == 0:
                ox, oy, oz, lx, ly, lz = ox / w, oy / w, oz / w, lx / w, ly / w, lz / w
        if w <= 1e-9:
            break
        # A single object does not tell a turn.
        if dot * dot + cross * cross > 1.0:
            turn = np.arctan2(cross, dot)
        c, s = np.cos(turn), np.sin(turn)
        dx, dy, dz = lx - (c * ox - s * oy), ly - (s * ox + c * oy), lz - oz
    consensus, n = 0.0, 0
    agreeing = np.empty((n_objects, 2), np.int64)
    for o in range(n_objects):
        if best_weight[o] >= _MIN_WEIGHT:
            consensus += best_weight[o]
            agreeing[n] = pairs[best_pair[o]]
            n += 1
    if n >= 3:
        covariance = _covariance(own, own_yaws, theirs, their_yaws, agreeing[:n], dx, dy, dz, turn, reach)
    return np.array([dx, dy, dz, turn]), consensus, agreeing[:n].copy(), covariance


@njit(cache=True, nogil=True)
def _pairs_near(own, theirs, pairs, dx, dy, turn):
    """The pairs whose boxes come near each other under a transform."""
    c, s, n = np.cos(turn), np.sin(turn), 0
    near = np.empty_like(pairs)
    last_layer, last_column = own.shape[1] - 1, own.shape[2] - 1
    for p in range(len(pairs)):
        o, m = pairs[p, 0], pairs[p, 1]
        # The mean of two opposite corners is the middle of the box; a missing keypoint (NaN) keeps the pair.
        ox = (own[o, 0, 0, 0] + own[o, last_layer, last_column // 2 + last_column % 2, 0]) / 2
        oy = (own[o, 0, 0, 1] + own[o, last_layer, last_column // 2 + last_column % 2, 1]) / 2
        lx = (theirs[m, 0, 0, 0] + theirs[m, last_layer, last_column // 2 + last_column % 2, 0]) / 2
        ly = (theirs[m, 0, 0, 1] + theirs[m, last_layer, last_column // 2 + last_column % 2, 1]) / 2
        if not (lx - (c * ox - s * oy) - dx) ** 2 + (ly - (s * ox + c * oy) - dy) ** 2 > _NEAR_M * _NEAR_M:
            near[n] = pairs[p]
            n += 1
    return near[:n].copy()


@njit(cache=True, nogil=True)
def _covariance(own, own_yaws, theirs, their_yaws, agreeing, dx, dy, dz, turn, reach):
    """Of dx, dy, dz and turn: each agreeing object counts as one measurement, since its keypoints share what is wrong with it."""
    n_layers, n_columns = own.shape[1], own.shape[2]
    c, s = np.cos(turn), np.sin(turn)
    information, squares_xy, squares_z = np.zeros((4, 4)), 0.0, 0.0
    for i in range(len(agreeing)):
        o, m = agreeing[i, 0], agreeing[i, 1]
        quarter = int(np.rint((own_yaws[o] + turn - their_yaws[m]) / (np.pi / 2))) if n_columns == 4 else 0
        weight, ex, ey, ez, mx, my = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for layer in range(n_layers):
            for q in range(n_columns):
                k = (q + quarter) & (n_columns - 1)
                px, py = c * own[o, layer, q, 0] - s * own[o, layer, q, 1], s * own[o, layer, q, 0] + c * own[o, layer, q, 1]
                a, b, d = (
                    theirs[m, layer, k, 0] - px - dx,
                    theirs[m, layer, k, 1] - py - dy,
                    theirs[m, layer, k, 2] - own[o, layer, q, 2] - dz,
                )
                e2 = a * a + b * b + d * d
                if not e2 < reach * reach:
                    continue
                g = (1 - e2 / reach**2) ** 2
                weight += g
                ex += g * a
                ey += g * b
                ez += g * d
                mx += g * px
                my += g * py
        if weight <= 0:
            continue
        ex, ey, ez, mx, my = ex / weight, ey / weight, ez / weight, mx / weight, my / weight
        squares_xy += ex * ex + ey * ey
        squares_z += ez * ez
        information[0, 0] += 1
        information[1, 1] += 1
        information[2, 2] += 1
        information[0, 3] -= my
        information[1, 3] += mx
        information[3, 3] += mx * mx + my * my
    n = len(agreeing)
    # ASSUME: objects are known to 5 cm at best, in map and frame together.
    sigma2_xy = max(squares_xy / max(2 * n - 3, 1), 0.05**2)
    sigma2_z = max(squares_z / max(n - 1, 1), 0.05**2)
    information[0, :] /= sigma2_xy
    information[1, :] /= sigma2_xy
    information[2, 2] /= sigma2_z
    information[3, 3] /= sigma2_xy
    information[3, 0], information[3, 1] = information[0, 3], information[1, 3]
    if np.linalg.det(information) <= 0:
        return np.full((4, 4), np.nan)
    return np.linalg.inv(information)
