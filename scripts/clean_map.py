"""The static map: the labelled map without phantoms and movable objects."""

import itertools
import logging
from collections.abc import Sequence

from streetscan.io.las import iterate_las, open_las_writer, read_crs
from streetscan.logs import logged
from streetscan.segmentation.cleaning import keep_classes

logger = logging.getLogger("streetscan.clean_map")


def main(map_paths: Sequence[str], static_path: str, keep: Sequence[str]) -> None:
    """
    Args:
        map_paths: LAZ files of label_map.
        static_path: LAZ file to write.
        keep: names of the classes that stay.
    """
    n_kept = 0
    clouds = itertools.chain.from_iterable(iterate_las(path) for path in map_paths)
    with open_las_writer(static_path, read_crs(map_paths[0])) as writer:
        for cloud in keep_classes(clouds, keep):
            writer.write(cloud)
            n_kept += len(cloud)
    logger.info("%d points kept", n_kept)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(map_paths=snakemake.input.maps, static_path=snakemake.output.static, **snakemake.params)
