"""Height of the local ground, estimated from the points alone, and height above it.

Source: Nagy (2020), 2.4.1 (N-016): "subtracting the actual ground height from the geo-referenced height". The thesis
does not say where the ground height comes from. ASSUME progressive morphological opening of the lowest surface, as in
Zhang et al. (2003) and Pingel et al. (2013, SMRF): linear in the cells, and it needs neither labels nor a trajectory.
Three things differ: the surface is opened as residual of a robust trend, so that slopes stay whole up to the border
of the map; small patches below everything around them (mixed pixels, reflections) are dropped first; and a cell's
height comes from all points near its lowest level instead of the very lowest.

One surface per place: below a bridge the street is the ground and the deck has its clearance as height; a deck with
nothing measured below it, and wider than the largest object, is ground itself.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, sparse

from streetscan.voxels import VoxelGrid

# Large maps are worked in blocks, each with the ground around it, so that memory follows the streets and not their bounding box.
_BLOCK_M = 1000.0
_HALO_M = 100.0
# The trend: planes over blocks of this edge, fitted within about two blocks.
_TREND_BLOCK_M = 8.0
_TREND_SIGMA_BLOCKS = 2.0
_TREND_ROUNDS = 8
# A block's level is this quantile of its cells' lowest heights: reflections below ground fill less of a block.
_TREND_QUANTILE = 0.1
# What the trend can be wrong by: ground farther from it is not used to fill holes before the opening.
_PLAUSIBLE_M = 1.0
# Rises above the opened ground up to this height are looked at again.
_LOW_RISE_M = 0.5
# What noise adds to the height difference of neighbouring cells.
_NOISE_M = 0.03
# Patches below ground are looked for in pits up to this width.
_PIT_M = 5.0
# Added to the blocks' scatter (in blocks squared) when planes are fitted.
_RIDGE = 0.02
# Points this near the surface count as ground, round by round: noise, grass, at first the slope within a cell.
_BANDS_M = (0.15, 0.08, 0.04)


@dataclass
class GroundRaster:
    """Ground heights on a regular raster.

    Attributes:
        origin: (2,) float64, metres, frame `map`: the corner of cell (0, 0).
        cell_m: edge of a cell.
        heights_m: (nx, ny) float64 heights at the cells' centres, frame `map`, everywhere defined.
        is_measured: (nx, ny) bool, True where points of the ground were seen and False where it is interpolated.
    """

    origin: np.ndarray
    cell_m: float
    heights_m: np.ndarray
    is_measured: np.ndarray

    def heights_at(self, points: np.ndarray) -> np.ndarray:
        """(N,) float64 ground heights below (N, >=2) positions in `map`; bilinear, constant beyond the raster."""
        at = (np.asarray(points, np.float64)[:, :2] - self.origin) / self.cell_m - 0.5
        return ndimage.map_coordinates(self.heights_m, at.T, order=1, mode="nearest")


def add_heights(grid: VoxelGrid, *, cell_m: float, max_object_m: float, max_slope: float, step_m: float, min_patch_m2: float) -> VoxelGrid:
    """The grid with `height_m`: each voxel's mean height minus the ground height below its centre.

    Args:
        grid: the voxels of the map.
        cell_m, max_object_m, max_slope, step_m, min_patch_m2: see `estimate_ground`.
    Returns:
        a grid with the same voxels.
    """
    height = np.full(len(grid), np.nan)
    if len(grid) == 0:
        return grid
    xy = grid.centres[:, :2]
    corner = xy.min(axis=0)
    ij = np.floor((xy - corner) / _BLOCK_M).astype(np.int64)
    n_columns = int(ij[:, 1].max()) + 1
    block = ij[:, 0] * n_columns + ij[:, 1]
    for number in np.flatnonzero(np.bincount(block)):
        low = corner + np.array(divmod(int(number), n_columns)) * _BLOCK_M
        near = ((xy >= low - _HALO_M) & (xy < low + _BLOCK_M + _HALO_M)).all(axis=1)
        points = np.c_[xy[near], grid.mean_z_m[near]]
        ground = estimate_ground(
            points,
            grid.counts[near],
            cell_m=cell_m,
            max_object_m=max_object_m,
            max_slope=max_slope,
            step_m=step_m,
            min_patch_m2=min_patch_m2,
        )
        inside = block == number
        height[inside] = grid.mean_z_m[inside] - ground.heights_at(xy[inside])
    return replace(grid, height_m=height.astype(np.float32))


def estimate_ground(
    points: np.ndarray,
    counts: np.ndarray | None = None,
    *,
    cell_m: float,
    max_object_m: float,
    max_slope: float,
    step_m: float,
    min_patch_m2: float,
) -> GroundRaster:
    """The ground below a point cloud.

    Args:
        points: (N, 3) float64, metres, frame `map`, N >= 1; voxel centres with mean heights will do.
        counts: (N,) how many measurements each stands for; one each by default.
        cell_m: edge of a raster cell.
        max_object_m: width of the largest thing that stands on the ground and hides it (the narrower side counts).
        max_slope: how much steeper than its surroundings the ground may be (rise over run). The slope of the
            surroundings themselves is not limited.
        step_m: height of the largest step that is still ground, such as a kerb; lower surfaces of things must be higher.
        min_patch_m2: a patch more than `2 step_m` below its surroundings and smaller than this is a measuring error.
    Returns:
        the raster; holes below cars, trees and houses are interpolated, beyond the map the trend goes on.
    """
    points = np.asarray(points, np.float64)
    weights = np.ones(len(points)) if counts is None else np.asarray(counts, np.float64)
    origin = np.floor(points[:, :2].min(axis=0) / cell_m) * cell_m
    index = np.floor((points[:, :2] - origin) / cell_m).astype(np.int64)
    shape = tuple(index.max(axis=0) + 1)
    cell = np.ravel_multi_index(tuple(index.T), shape)
    base = points[:, 2].min()
    z = points[:, 2] - base

    lowest, trend = _lowest_without_errors(cell, z, shape, cell_m, step_m, min_patch_m2)
    is_ground = _open_progressively(lowest - trend, cell_m, max_object_m, max_slope, step_m)
    is_ground = _readmit_smooth(lowest - trend, is_ground, max_slope * cell_m + _NOISE_M)
    # The trend follows the ground once more, now without the cells on things that pulled at the first one.
    trend = _fit_trend(np.where(is_ground, lowest, np.nan), cell_m)
    # The median takes single cells out that a stray point has set; kerbs stay.
    level = trend + ndimage.median_filter(fill_holes(np.where(is_ground, lowest - trend, np.nan)), size=3, mode="nearest")
    raster = GroundRaster(origin, cell_m, level + base, is_ground)
    # From the lowest points to the middle of those near the surface. The first surface lies at the low side of a slope;
    # the last bands keep the feet of walls out.
    for band_m in _BANDS_M:
        raster.heights_m += fill_holes(_mean_offsets(points, weights, cell, raster, band_m))
    return raster


def _mean_offsets(points: np.ndarray, weights: np.ndarray, cell: np.ndarray, raster: GroundRaster, band_m: float) -> np.ndarray:
    """Mean height over the raster, per measured cell, of the points within `band_m` of it; NaN elsewhere."""
    offset = points[:, 2] - raster.heights_at(points)
    is_near = (np.abs(offset) <= band_m) & raster.is_measured.reshape(-1)[cell]
    size = raster.heights_m.size
    total = np.bincount(cell[is_near], weights[is_near], minlength=size)
    sums = np.bincount(cell[is_near], weights[is_near] * offset[is_near], minlength=size)
    with np.errstate(invalid="ignore"):
        return (sums / total).reshape(raster.heights_m.shape)


def _lowest_without_errors(
    cell: np.ndarray, z: np.ndarray, shape: tuple[int, int], cell_m: float, step_m: float, min_patch_m2: float
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest heights per cell (NaN where empty), small patches below everything around dropped, and their trend."""
    alive = np.ones(len(z), bool)
    # Each round takes one layer of stray points off; more than a few layers under one cell is no stray.
    for _ in range(4):
        lowest = np.full(shape, np.inf)
        np.minimum.at(lowest.reshape(-1), cell[alive], z[alive])
        lowest[np.isinf(lowest)] = np.nan
        trend = _fit_trend(lowest, cell_m)
        error = _small_patches_below(lowest, trend, cell_m, 2 * step_m, min_patch_m2)
        if not error.any():
            break
        doubtful = error.reshape(-1)[cell] & (z <= lowest.reshape(-1)[cell] + step_m)
        if not (alive & ~doubtful).any():
            break
        alive &= ~doubtful
    return lowest, trend


def _small_patches_below(lowest: np.ndarray, trend: np.ndarray, cell_m: float, depth_m: float, min_patch_m2: float) -> np.ndarray:
    """Cells of small connected patches that lie deeper than `depth_m` below the low level of the 5 x 5 m around them."""
    residual = lowest - trend
    window = 2 * round(_PIT_M / 2 / cell_m) + 1
    # The closing fills pits narrower than the window up to their rim.
    rim = ndimage.minimum_filter(ndimage.maximum_filter(np.where(np.isnan(residual), -np.inf, residual), window), window)
    is_low = np.where(np.isnan(residual), np.inf, residual) < np.minimum(rim, 0.0) - depth_m
    patches, n_patches = ndimage.label(is_low, structure=np.ones((3, 3)))
    area_m2 = np.bincount(patches.reshape(-1), minlength=n_patches + 1)[patches] * cell_m**2
    return is_low & (area_m2 < min_patch_m2)


def _open_progressively(residual: np.ndarray, cell_m: float, max_object_m: float, max_slope: float, step_m: float) -> np.ndarray:
    """Cells of the ground: no opening up to the largest object's width lowers them by more than a step or the slope allows."""
    is_seen = ~np.isnan(residual)
    # Empty cells take the nearest height that can be ground, or else a crown at the border would have no ground beside it.
    is_plausible = is_seen & (np.abs(np.nan_to_num(residual, nan=np.inf)) <= _PLAUSIBLE_M)
    source = is_plausible if is_plausible.any() else is_seen
    nearest = ndimage.distance_transform_edt(~source, return_distances=False, return_indices=True)
    surface = np.where(is_seen, residual, residual[tuple(nearest)])
    is_ground = is_seen
    largest = max(1, int(np.ceil(max_object_m / 2 / cell_m)))
    for radius in sorted({min(r, largest) for r in (1, 2, 3, 4, 6, 8, *range(12, largest + 4, 4))}):
        # Beyond the border lies the trend, or else nothing could be removed there.
        opened = np.minimum(ndimage.grey_opening(surface, size=(2 * radius + 1, 2 * radius + 1), mode="constant", cval=0.0), surface)
        is_ground = is_ground & (surface - opened <= max(step_m, max_slope * radius * cell_m))
        surface = opened
    return is_ground if is_ground.any() else is_seen


def _readmit_smooth(residual: np.ndarray, is_ground: np.ndarray, max_rise_m: float) -> np.ndarray:
    """Ground cells and the low rises that join them without a step: humps and banks the opening has cut off.

    Things on the ground begin with a step; a rise from cell to cell of no more than `max_rise_m` has none.
    """
    may_be = is_ground | (residual - fill_holes(np.where(is_ground, residual, np.nan)) <= _LOW_RISE_M)
    cell = np.arange(residual.size).reshape(residual.shape)
    pairs = []
    for a, b in ((np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:])):
        joined = may_be[a] & may_be[b] & (np.abs(residual[a] - residual[b]) <= max_rise_m)
        pairs.append((cell[a][joined], cell[b][joined]))
    first, second = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    graph = sparse.coo_array((np.ones(len(first), bool), (first, second)), shape=(cell.size, cell.size))
    _, patch = sparse.csgraph.connected_components(graph, directed=False)
    has_ground = np.zeros(patch.max() + 1, bool)
    has_ground[patch[is_ground.reshape(-1)]] = True
    return may_be & has_ground[patch].reshape(residual.shape)


def _fit_trend(heights: np.ndarray, cell_m: float) -> np.ndarray:
    """A smooth surface through the low parts of a raster with holes, continued as planes beyond them.

    Each block gives one height, low among its cells but at the place where it was found, so that a slope is no error.
    Round by round the planes turn to the lower blocks: crowns and roofs lie above them and lose their weight.
    """
    factor = max(1, round(_TREND_BLOCK_M / cell_m))
    x, y = np.nonzero(~np.isnan(heights))
    z = heights[x, y]
    # One ring more than the raster's blocks, for interpolation up to the border.
    shape = tuple(-(-n // factor) + 2 for n in heights.shape)
    block = np.ravel_multi_index((x // factor + 1, y // factor + 1), shape)
    order = np.lexsort((z, block))
    first = np.flatnonzero(np.diff(block[order], prepend=-1))
    n_cells = np.diff(first, append=len(order))
    pick = order[first + np.int64(_TREND_QUANTILE * (n_cells - 1))]
    block, z = block[pick], z[pick]
    bx, by = (x[pick] + 0.5) / factor + 0.5, (y[pick] + 0.5) / factor + 0.5

    weight = np.ones(len(z))
    for scale_m in np.geomspace(4.0, 0.5, _TREND_ROUNDS):
        height, slope_x, slope_y = _fit_planes(block, bx, by, z, weight, shape)
        row, column = np.unravel_index(block, shape)
        above = z - height[row, column] - slope_x[row, column] * (bx - row) - slope_y[row, column] * (by - column)
        weight = 1 / (1 + (np.maximum(above, 0) / scale_m) ** 2) ** 2
    return _upsample(height, heights.shape, factor, ring=1)


def _fit_planes(
    block: np.ndarray, bx: np.ndarray, by: np.ndarray, z: np.ndarray, weight: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per block the height at its centre and the slopes of the weighted plane through the neighbouring blocks' heights."""

    def gather(values: np.ndarray) -> np.ndarray:
        image = np.bincount(block, weight * values, minlength=shape[0] * shape[1]).reshape(shape)
        return ndimage.gaussian_filter(image, _TREND_SIGMA_BLOCKS, mode="constant", truncate=6.0)

    one = np.ones_like(z)
    mean_z = np.average(z, weights=weight)
    dz = z - mean_z
    s, sx, sy, sz = gather(one), gather(bx), gather(by), gather(dz)
    sxx, sxy, syy, sxz, syz = gather(bx * bx), gather(bx * by), gather(by * by), gather(bx * dz), gather(by * dz)
    # About the weighted mean, so that the plane's height and its slopes separate.
    total = np.maximum(s, np.finfo(float).tiny)
    mx, my, mz = sx / total, sy / total, sz / total
    # A little ridge: where the blocks lie in one line the slope across is unknown and taken as level.
    cxx, cyy, cxy = sxx / total - mx * mx + _RIDGE, syy / total - my * my + _RIDGE, sxy / total - mx * my
    cxz, cyz = sxz / total - mx * mz, syz / total - my * mz
    determinant = cxx * cyy - cxy * cxy
    slope_x, slope_y = (cyy * cxz - cxy * cyz) / determinant, (cxx * cyz - cxy * cxz) / determinant
    row, column = np.indices(shape)
    height = mz + slope_x * (row - mx) + slope_y * (column - my) + mean_z
    # Blocks too far from any height hold no points; their neighbours' plane level does.
    is_far = s < 1e-12
    if is_far.any():
        nearest = tuple(ndimage.distance_transform_edt(is_far, return_distances=False, return_indices=True))
        height, slope_x, slope_y = height[nearest], slope_x[nearest], slope_y[nearest]
    return height, slope_x, slope_y


def fill_holes(values: np.ndarray) -> np.ndarray:
    """A raster whose NaN cells are interpolated smoothly from the others (push-pull over a pyramid, linear cost); all NaN gives 0."""
    is_hole = np.isnan(values)
    if not is_hole.any():
        return values
    if is_hole.all():
        return np.zeros_like(values)
    padded = np.pad(np.where(is_hole, 0.0, values), [(0, n % 2) for n in values.shape])
    known = np.pad((~is_hole).astype(float), [(0, n % 2) for n in values.shape])
    blocks = (padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
    n_known = known.reshape(blocks).sum(axis=(1, 3))
    with np.errstate(invalid="ignore"):
        coarse = padded.reshape(blocks).sum(axis=(1, 3)) / n_known
    return np.where(is_hole, _upsample(fill_holes(coarse), values.shape, 2), values)


def _upsample(coarse: np.ndarray, shape: tuple[int, int], factor: int, ring: int = 0) -> np.ndarray:
    """Bilinear interpolation of cell-centred values onto `factor` times finer cells; `ring` cells surround the fine raster."""
    for axis, n in enumerate(shape):
        at = np.clip((np.arange(n) + 0.5) / factor - 0.5 + ring, 0, coarse.shape[axis] - 1)
        low = np.minimum(at.astype(np.int64), max(coarse.shape[axis] - 2, 0))
        high = np.minimum(low + 1, coarse.shape[axis] - 1)
        weight = (at - low).reshape((-1, 1) if axis == 0 else (1, -1))
        coarse = (1 - weight) * coarse.take(low, axis) + weight * coarse.take(high, axis)
    return coarse
