"""Objects of the label map as a GeoPackage layer."""

from collections.abc import Sequence

from streetscan.io.geopackage import write_layer
from streetscan.io.label_tiles import read_label_tiles
from streetscan.io.las import read_crs
from streetscan.logs import logged
from streetscan.segmentation.objects import extract_objects
from streetscan.voxels import VoxelGrid


def main(
    map_path: str, voxels_path: str, prediction_paths: Sequence[str], objects_path: str, class_names: Sequence[str], min_voxels: int
) -> None:
    """
    Args:
        map_path: LAZ file, for its reference system.
        voxels_path: its voxel grid.
        prediction_paths: all parts of its label map, `.npz`.
        objects_path: GeoPackage to write, layer `objects`.
        class_names, min_voxels: see `streetscan.segmentation.objects.extract_objects`.
    """
    grid = VoxelGrid.load(voxels_path)
    objects = extract_objects(grid, *read_label_tiles(prediction_paths, len(grid)), class_names, min_voxels)
    write_layer(objects_path, objects.to_frame(read_crs(map_path)), "objects")


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(
            map_path=snakemake.input.map,
            voxels_path=snakemake.input.voxels,
            prediction_paths=snakemake.input.predictions,
            objects_path=snakemake.output.objects,
            **snakemake.params,
        )
