"""The map a mobile mapper, or a static scanner, makes of one street of the simulated city; its truth apart."""

import logging

from streetscan.logs import logged
from streetscan.simulation.colouring import Cameras
from streetscan.simulation.layout import GENERATOR_VERSION
from streetscan.simulation.receiver import Receiver
from streetscan.simulation.recording import Errors, record_static_street, record_street, write_map
from streetscan.simulation.sensors import StaticScanner, mobile_mapper

logger = logging.getLogger("streetscan.simulate_city")


def main(map_path: str, labels_path: str, instances_path: str, settings: dict, split: str, part: dict, seed: int) -> None:
    """
    Args:
        map_path: LAZ to write, with intensity, time_s, rgb (of a mobile mapper), return_number and n_returns; no truth.
        labels_path: `.npy` (N,) uint8 to write: the class of each point's object.
        instances_path: `.npy` (N,) uint32 to write: the object.
        settings: `street` (of `layout.build_street`), `scanners` (of `sensors.mobile_mapper`), `receiver`, `cameras`, `errors`
            (of the classes of these names) and `n_rounds`, drives per direction; or `street`, `static_scanner` (`spacing_m` of its
            positions and what differs from `sensors.StaticScanner`) and `receiver`.
        split: the street's name: train, validation, test or all.
        part: `length_m` of this street.
        seed: of the city and of everything random in its recording.
    """
    street = settings["street"] | {"length_m": part["length_m"]}
    logger.info("generator version %d", GENERATOR_VERSION)
    receiver = Receiver(**settings["receiver"])
    if "static_scanner" in settings:
        scanner = dict(settings["static_scanner"])
        spacing_m = scanner.pop("spacing_m")
        records = record_static_street(split, seed, street, StaticScanner(**scanner), receiver, spacing_m)
    else:
        parts = receiver, Cameras(**settings["cameras"]), Errors(**settings["errors"])
        records = record_street(split, seed, street, mobile_mapper(**settings["scanners"]), *parts, settings["n_rounds"])
    write_map(records, map_path, labels_path, instances_path)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(*snakemake.output, **snakemake.params)
