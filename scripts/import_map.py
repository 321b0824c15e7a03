"""A part of a real map as LAZ, its labels apart and in the nine classes."""

from streetscan.datasets import parse_facts
from streetscan.imports import import_map
from streetscan.logs import logged


def main(files: list[str], map: str, labels: str, facts: dict, stretch: tuple[float, float] = (0.0, 1.0)) -> None:
    """
    Args:
        files: the part's files, in the order of the map.
        map: LAZ to write, without labels.
        labels: `.npy` to write, (N,) uint8, 255 unlabelled.
        facts: the content of the data set's file.
        stretch: from which to which share of the files' longer horizontal side the part reaches.
    """
    import_map(parse_facts(facts), files, map, labels, stretch)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(
            files=snakemake.input.files,
            map=snakemake.output.map,
            labels=snakemake.output.labels,
            **snakemake.params,
        )
