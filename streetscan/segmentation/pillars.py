"""How much of what stands above and below a place is there: a wall goes on upwards where a bus ends.

Source: ours. A cube of 23 voxels sees 2.3 m: the foot of a facade and the side of a tram look alike in it.
"""

import numpy as np

from streetscan.voxels import pack_keys

# Side of the pillars and height of their slabs, and how high they are looked at, m.
_PILLAR_M, _TOP_M = 0.5, 12.0


def filled_shares(keys: np.ndarray, height_m: np.ndarray, size_m: float) -> np.ndarray:
    """Share of the slabs of 0.5 m, from the ground to 12 m, of the pillar through each voxel that hold a voxel.

    Pillars are 0.5 m wide (as many whole voxels as are next to that) and go with the keys, slabs with the ground. What is lower or
    higher fills no slab.

    Args:
        keys: (V, 3) integer voxel keys, in any order, each once.
        height_m: (V,) above the local ground.
        size_m: voxel edge.
    Returns:
        (V,) float32 in [0, 1].
    """
    n_slabs = round(_TOP_M / _PILLAR_M)
    pillars = np.zeros((len(keys), 3), np.int64)
    pillars[:, :2] = keys[:, :2] // max(round(_PILLAR_M / size_m), 1)
    packed, pillar_of = np.unique(pack_keys(pillars), return_inverse=True)
    slabs = np.floor(np.asarray(height_m, np.float64) / _PILLAR_M).astype(np.int64)
    is_counted = (slabs >= 0) & (slabs < n_slabs)
    filled = np.unique(pillar_of[is_counted] * n_slabs + slabs[is_counted])
    n_filled = np.bincount(filled // n_slabs, minlength=len(packed))
    return (n_filled[pillar_of] / n_slabs).astype(np.float32)
