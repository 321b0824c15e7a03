"""Point density against the distance from a tripod, of its own panorama and of a mobile mapper's map of the same street."""

import pandas as pd

from streetscan.io.las import iterate_labelled_las
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.simulation.layout import build_street
from streetscan.simulation.realism import density_around
from streetscan.simulation.recording import tripod_positions
from streetscan.simulation.sensors import StaticScanner


def main(
    static: tuple[str, str], mobile: tuple[str, str], table_path: str, simulation: dict, split: str, length_m: float, seed: int,
    max_range_m: float,
) -> None:  # fmt: skip
    """
    Args:
        static, mobile: paths of the map and of its points' labels, of each scanner.
        table_path: CSV to write: scanner, statistic, group, x, value, n.
        simulation: settings of the static scan.
        split, length_m, seed: of the street.
        max_range_m: how far from the first tripod.
    """
    street, scanner = simulation["street"] | {"length_m": length_m}, dict(simulation["static_scanner"])
    spacing_m = scanner.pop("spacing_m")
    scene = build_street(split=split, seed=seed, block=0, **street)
    position = tripod_positions(scene, street, 0, spacing_m)[0]
    first_turn_s = (0.0, StaticScanner(**scanner).panorama_s)
    tables = {
        "static": density_around(iterate_labelled_las(*static), position, max_range_m, first_turn_s),
        "mobile": density_around(iterate_labelled_las(*mobile), position, max_range_m),
    }
    save_tables({table_path: pd.concat([t.assign(scanner=name) for name, t in tables.items()], ignore_index=True)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(snakemake.input.static, snakemake.input.mobile, snakemake.output.table, **snakemake.params)
