"""Labels and confidences of one group of a map's tiles, for its voxels and its points."""

from collections.abc import Sequence

from streetscan.io.label_tiles import write_label_tile
from streetscan.io.las import iterate_las, open_las_writer, read_crs
from streetscan.logs import logged
from streetscan.segmentation.devices import choose_device
from streetscan.segmentation.inference import label_points, parse_tiles
from streetscan.segmentation.labellers import load_labeller
from streetscan.segmentation.smoothing import Smoothing
from streetscan.voxels import VoxelGrid


def main(
    map_path: str, voxels_path: str, network_paths: Sequence[str], labelled_map_path: str, labelled_voxels_path: str,
    tiles: str, tile_m: float, n_turns: int, smoothing: dict | None, n_threads: int, device: str, expected: dict,
) -> None:  # fmt: skip
    """
    Args:
        map_path: LAZ file.
        voxels_path: its voxel grid.
        network_paths: weights.safetensors, or model.txt of a baseline, and settings.yaml.
        labelled_map_path: LAZ file to write: the points of the group's voxels, all fields kept, `label` and `confidence` added.
        labelled_voxels_path: `.npz` to write: rows into the grid, labels, confidence, labels before smoothing.
        tiles: the group, such as `0of9`.
        tile_m: edge of a tile.
        n_turns: quarter turns in which every voxel is looked at.
        smoothing: of `streetscan.segmentation.smoothing.Smoothing`; None: labels are each voxel's own.
        n_threads: threads; the result does not depend on it.
        device: where a network labels, cpu or cuda.
        expected: the settings they must have been made with (`c2cnn.Settings`, or `TreeSettings`; size_m is the grid's).
    """
    choose_device(device)  # before minutes of reading
    grid = VoxelGrid.load(voxels_path)
    labeller = load_labeller(network_paths, expected, grid.size_m, n_turns, Smoothing(**smoothing or {}), device)
    found = labeller(grid, tile_m, *parse_tiles(tiles), n_threads)
    with open_las_writer(labelled_map_path, read_crs(map_path)) as writer:
        for cloud in label_points(iterate_las(map_path), grid, found.rows, found.labels, found.confidence):
            writer.write(cloud)
    write_label_tile(labelled_voxels_path, *found)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(snakemake.input.map, snakemake.input.voxels, snakemake.input.network, *snakemake.output, **snakemake.params)
