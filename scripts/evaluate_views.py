"""Pictures of a labelled map: labels, errors, intensity and colours from above and from eye level; volumes, failures, statistics."""

import logging
from collections.abc import Sequence
from pathlib import Path

from streetscan.benchmarks.figures import save_figure
from streetscan.benchmarks.views import draw_closely, draw_statistics, draw_views
from streetscan.io.arrays import load_npy
from streetscan.io.label_tiles import read_label_tiles
from streetscan.io.las import iterate_las
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.voxels import VoxelGrid

logger = logging.getLogger("streetscan.evaluate_views")


def main(
    map_path: str, voxels_path: str, prediction_paths: Sequence[str], truth_path: str | None, folder: str, width_px: int, reach_m: float,
    n_failures: int, k: int,
):  # fmt: skip
    """
    Args:
        map_path: LAZ file of the map.
        voxels_path: its voxel grid.
        prediction_paths: all parts of its label map, `.npz`.
        truth_path: the voxels' true labels, `.npy`; None for a map without truth.
        folder: to write `{predicted,true,errors}_{top,street}.png`, `{intensity,rgb}_{top,street}.jpg`, `class_shares.svg`,
            `reliability.svg`, `volumes.png`, `failures.png`, `failures.csv` into; without truth, intensity or colours what needs none.
        width_px: width of the pictures.
        reach_m: how far the eye sees.
        n_failures: failures that are shown.
        k: voxels an axis of a training volume.
    """
    grid = VoxelGrid.load(voxels_path)
    predicted, confidence = read_label_tiles(prediction_paths, len(grid))
    true = load_npy(truth_path, "label_voxels") if truth_path else None
    views = draw_views(grid, predicted, true, iterate_las(map_path), width_px, reach_m)
    closely, failures = draw_closely(grid, predicted, true, k, n_failures)
    for name, figure in (views | closely).items():
        # Noise of points does not compress as flat colours do.
        save_figure(figure, Path(folder) / f"{name}.{'jpg' if name.startswith(('intensity', 'rgb')) else 'png'}")
    for name, figure in draw_statistics(predicted, confidence, true).items():
        save_figure(figure, Path(folder) / f"{name}.svg")
    if failures is not None:
        save_tables({Path(folder) / "failures.csv": failures})
    logger.info("%d pictures of %d voxels", len(views) + len(closely), len(grid))


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        i, o = snakemake.input, snakemake.output
        main(i.map, i.voxels, i.predictions, i.get("truth") or None, o.folder, **snakemake.params)
