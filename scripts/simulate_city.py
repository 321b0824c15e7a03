"""The map a mobile mapper makes of one street of the simulated city; its truth apart."""

from streetscan.logs import logged
from streetscan.simulation.colouring import Cameras
from streetscan.simulation.receiver import Receiver
from streetscan.simulation.recording import Errors, record_street, write_map
from streetscan.simulation.sensors import mobile_mapper


def main(map_path: str, labels_path: str, instances_path: str, settings: dict, split: str, part: dict, seed: int) -> None:
    """
    Args:
        map_path: LAZ to write, with intensity, time_s, rgb, return_number and n_returns; no truth.
        labels_path: `.npy` (N,) uint8 to write: the class of each point's object.
        instances_path: `.npy` (N,) uint32 to write: the object.
        settings: `street` (of `layout.build_street`), `scanners` (of `sensors.mobile_mapper`), `receiver`, `cameras`, `errors`
            (of the classes of these names) and `n_rounds`, drives per direction.
        split: the street's name: train, validation, test or all.
        part: `length_m` of this street.
        seed: of the city and of everything random in its recording.
    """
    street = settings["street"] | {"length_m": part["length_m"]}
    parts = Receiver(**settings["receiver"]), Cameras(**settings["cameras"]), Errors(**settings["errors"])
    records = record_street(split, seed, street, mobile_mapper(**settings["scanners"]), *parts, settings["n_rounds"])
    write_map(records, map_path, labels_path, instances_path)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(*snakemake.output, **snakemake.params)
