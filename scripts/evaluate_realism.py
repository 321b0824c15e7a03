"""Statistics of a map, simulated or real, by which maps can be compared."""

import pandas as pd

from streetscan.io.las import iterate_labelled_las, iterate_las
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.simulation.realism import describe_map, probe_street


def main(
    map_path: str, truth_path: str | None, table_path: str, simulation: dict | None, split: str, length_m: float | None, seed: int,
    tile_m: float, tile_share: float, max_range_m: float, n_pulses: int,
) -> None:  # fmt: skip
    """
    Args:
        map_path: LAZ file.
        truth_path: its points' labels, `.npy`; None for a map without.
        table_path: CSV to write: statistic, group, x, value, n.
        simulation: settings of the data set's simulation; None for a real map, whose silent pulses and track nobody knows.
        split, length_m, seed: of the simulated street.
        tile_m, tile_share, max_range_m: see `describe_map`.
        n_pulses: pulses tried for the return rate.
    """
    track, rates = None, None
    if simulation and "scanners" in simulation:
        track, rates = probe_street(split, seed, length_m, simulation, n_pulses)
    clouds = iterate_labelled_las(map_path, truth_path) if truth_path else ((cloud, None) for cloud in iterate_las(map_path))
    table = describe_map(clouds, track, tile_m, tile_share, max_range_m)
    save_tables({table_path: pd.concat([table, rates], ignore_index=True) if rates is not None else table})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(snakemake.input.map, snakemake.input.get("truth") or None, snakemake.output.table, **snakemake.params)
