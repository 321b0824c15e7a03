"""The frames of a simulated drive beside those of a real one: returns per beam, distances, rings on the road."""

from streetscan.io.atomic import atomic_path
from streetscan.io.mcap import iterate_lidar
from streetscan.io.tables import save_tables
from streetscan.logs import logged
from streetscan.simulation.lidar_realism import compare_figures, describe_frames, draw_comparison


def main(
    drive: str,
    reference: str,
    scores: str,
    picture: str,
    names: list[str],
    sensor_heights_m: list[float],
    min_range_m: float,
    max_range_m: float,
) -> None:
    """
    Args:
        drive, reference: drive.mcap of both.
        scores, picture: to write, `.csv` and `.png`.
        names: of both drives.
        sensor_heights_m: of both lidars above the road.
        min_range_m, max_range_m: points outside are left out of both.
    """
    limits = min_range_m, max_range_m
    figures = [describe_frames(iterate_lidar(p), h, *limits) for p, h in zip((drive, reference), sensor_heights_m, strict=True)]
    table = compare_figures(*figures)
    save_tables({scores: table})
    with atomic_path(picture) as partial:
        draw_comparison(table, *names).savefig(partial, format="png", dpi=110)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(**dict(snakemake.input.items()), **dict(snakemake.output.items()), **snakemake.params)
