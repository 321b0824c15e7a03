"""Landmarks of a map, and what else a frame is localized against: the ground and the points of what stands still."""

from collections.abc import Sequence

from streetscan.io.arrays import load_npy
from streetscan.io.geopackage import write_layer
from streetscan.io.label_tiles import read_label_tiles
from streetscan.io.las import iterate_las, read_crs
from streetscan.landmarks import LandmarkSettings, cluster_landmarks, mean_points
from streetscan.localization.reference import make_reference
from streetscan.logs import logged
from streetscan.voxels import VoxelGrid


def main(
    map_path: str, voxels_path: str, prediction_paths: Sequence[str], truth_path: str | None,
    layer_path: str, landmarks_path: str, reference_path: str, landmarks: dict, static_m: float,
) -> None:  # fmt: skip
    """
    Args:
        map_path, voxels_path: LAZ file and its voxel grid.
        prediction_paths: all parts of its label map, `.npz`; none for a raw map.
        truth_path: `.npy` with the voxels' true labels instead, or None.
        layer_path: GeoPackage to write, layer `landmarks`.
        landmarks_path, reference_path: `.npz` to write: the landmarks with their keypoints; ground and static points.
        landmarks: keys of LandmarkSettings.
        static_m: edge of the cubes the static points are averaged in.
    """
    grid, crs = VoxelGrid.load(voxels_path), read_crs(map_path)
    labels = read_label_tiles(prediction_paths, len(grid))[0] if prediction_paths else None
    labels = load_npy(truth_path, "label_voxels", len(grid)) if truth_path else labels
    means = mean_points(grid, (cloud.points for cloud in iterate_las(map_path, with_fields=False)))
    found = cluster_landmarks(means, grid.height_m, labels, LandmarkSettings(**landmarks))
    make_reference(grid, means, labels, found, crs, static_m).save(reference_path)
    found.save(landmarks_path)
    write_layer(layer_path, found.to_frame(crs), "landmarks")


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        inputs = {"map_path": snakemake.input.map, "voxels_path": snakemake.input.voxels}
        inputs |= {"prediction_paths": snakemake.input.predictions, "truth_path": snakemake.input.truth or None}
        o = snakemake.output
        main(**inputs, layer_path=o.layer, landmarks_path=o.landmarks, reference_path=o.reference, **snakemake.params)
