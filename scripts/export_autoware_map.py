"""A static map as Autoware loads it: PCD tiles and their metadata."""

from pathlib import Path

from streetscan.io.autoware import write_autoware_map
from streetscan.io.las import iterate_las
from streetscan.logs import logged


def main(static_path: str | Path, folder: str | Path, tile_m: float) -> None:
    """
    Args:
        static_path: LAZ file of clean_map, or any other.
        folder: gets `<x>_<y>.pcd` and `pointcloud_map_metadata.yaml`.
        tile_m: edge of a tile.
    """
    write_autoware_map(folder, iterate_las(static_path), tile_m, static_path)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(snakemake.input.static, snakemake.output.folder, **snakemake.params)
