"""The same statistics of a real street: a drive's frames merged at their true poses."""

from streetscan.drive_maps import place_frames
from streetscan.io.mcap import iterate_lidar
from streetscan.io.tables import save_tables
from streetscan.io.trajectories import read_poses_csv
from streetscan.logs import logged
from streetscan.simulation.realism import describe_map


def main(drive_path: str, poses_path: str, table_path: str, tile_m: float, tile_share: float, max_range_m: float) -> None:
    """
    Args:
        drive_path: drive.mcap.
        poses_path: truth/poses.csv of the drive.
        table_path: CSV to write: statistic, group, x, value, n.
        tile_m, tile_share, max_range_m: see `streetscan.simulation.realism.describe_map`.
    """
    _, times_s, poses = read_poses_csv(poses_path)
    clouds = ((cloud, None) for cloud in place_frames(iterate_lidar(drive_path), times_s, poses))
    track = poses[:, :3, 3]
    save_tables({table_path: describe_map(clouds, track[~(track != track).any(axis=1)], tile_m, tile_share, max_range_m)})


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(snakemake.input.drive, f"{snakemake.input.truth}/poses.csv", snakemake.output.table, **snakemake.params)
