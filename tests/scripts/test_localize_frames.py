"""localize_frames on a drive through the street of boxes, from every kind of start and with every method."""

import numpy as np
import pandas as pd
import pytest

from scripts import localize_frames
from streetscan.errors import BadInput
from streetscan.io.mcap import iterate_mcap
from streetscan.io.point_columns import LidarConventions
from streetscan.io.trajectories import read_tum
from streetscan.localization.location_tables import COLUMNS, read_locations
from streetscan.localization.reference import Reference
from streetscan.localization.settings import METHODS


def run(files, folder, method="voting", mode="gps", truth=None, **settings):
    """Run the step into a folder; its table."""
    outputs = {"poses_path": folder / "poses.csv", "tum_path": folder / "poses.tum"}
    outputs |= {"view_path": folder / "view.mcap", "pictures_folder": folder / "pictures"}
    inputs = {"drive_path": files.drive, "reference_path": files.reference, "landmarks_path": files.landmarks, "truth_path": truth}
    localize_frames.main(**inputs, **outputs, method=method, settings=settings, sequence={"mode": mode}, seed=1)
    return pd.read_csv(outputs["poses_path"])


def position_errors(table, files, prefix="found_"):
    return np.linalg.norm(table[[f"{prefix}{a}_m" for a in "xyz"]].to_numpy() - files.poses[table["frame"], :3, 3], axis=1)


def test_every_frame_has_a_row_and_an_empty_one_costs_no_other(localization_files, tmp_path):
    table = run(localization_files, tmp_path)
    assert tuple(table.columns) == COLUMNS
    assert table["status"].tolist() == ["ok", "ok", "no_points", "ok"]
    assert table.loc[2, ["x_m", "found_x_m", "vote_x_m"]].isna().all()
    whole = table[table["status"] == "ok"]
    assert position_errors(whole, localization_files).max() < 0.1
    times_s, poses = read_tum(tmp_path / "poses.tum")
    assert len(times_s) == 3
    assert np.allclose(poses[:, :3, 3], whole[["x_m", "y_m", "z_m"]], atol=1e-3)
    rows = read_locations(tmp_path / "poses.csv")
    assert np.allclose(rows[0].location.T_map_lidar[:3, 3], whole.loc[0, ["x_m", "y_m", "z_m"]].astype(float))
    assert (np.linalg.eigvalsh(rows[0].location.covariance) > 0).all()
    assert sorted(p.name for p in (tmp_path / "pictures").iterdir()) == [
        "after.png", "before.png", "ground.png", "landmarks.png", "objects.png",
    ]  # fmt: skip


def test_the_view_holds_the_map_the_scans_and_their_poses(localization_files, tmp_path):
    run(localization_files, tmp_path)
    records = list(iterate_mcap(tmp_path / "view.mcap", ("/map", "/lidar", "/tf"), LidarConventions()))
    clouds = [r for r in records if hasattr(r, "points")]
    reference = Reference.load(localization_files.reference, localization_files.landmarks)
    assert len(clouds) == 1 + 3
    assert np.array_equal(clouds[0].points, reference.static)
    assert sum(hasattr(r, "T_parent_child") for r in records) == 3


@pytest.mark.parametrize("mode", ["tracking", "none"])
def test_other_starts(localization_files, tmp_path, mode):
    table = run(localization_files, tmp_path, mode=mode)
    assert position_errors(table[table["status"] == "ok"], localization_files).max() < 0.1
    assert (table["status"] == "ok").sum() == 3


def test_even_starts_need_the_truth_and_lie_all_over_the_window(localization_files, tmp_path):
    table = run(localization_files, tmp_path, mode="even", truth=localization_files.truth)
    assert (table["status"] == "ok").sum() == 3
    offsets = table[["start_x_m", "start_y_m"]].to_numpy()[[0, 1, 3]] - localization_files.poses[[0, 1, 3], :2, 3]
    assert np.abs(offsets).max() > 3
    with pytest.raises(BadInput, match="even starts"):
        run(localization_files, tmp_path, mode="even")


@pytest.mark.parametrize("method", sorted(set(METHODS) - {"voting"}))
def test_every_reference_method_gives_rows(localization_files, tmp_path, method):
    table = run(localization_files, tmp_path, method=method)
    assert len(table) == 4
    assert table.loc[2, "status"] == "no_points"
    assert table.loc[[0, 1, 3], "found_x_m"].notna().all()


def test_the_vote_alone(localization_files, tmp_path):
    table = run(localization_files, tmp_path, is_refined=False)
    whole = table[table["status"] == "ok"]
    assert len(whole) == 3
    assert position_errors(whole, localization_files, "vote_").max() < 0.3
    assert table["overlap"].isna().all()


def test_a_map_without_a_reference_system_is_refused_when_the_drive_has_gps(localization_files, tmp_path):
    reference = Reference.load(localization_files.reference, localization_files.landmarks)
    reference.crs = None
    reference.save(tmp_path / "reference.npz")
    outputs = {"poses_path": tmp_path / "a.csv", "tum_path": tmp_path / "a.tum", "view_path": tmp_path / "a.mcap"}
    with pytest.raises(BadInput, match="no reference system"):
        localize_frames.main(
            localization_files.drive, tmp_path / "reference.npz", localization_files.landmarks, None, **outputs,
            pictures_folder=tmp_path / "a", method="voting", settings={}, sequence={}, seed=1,
        )  # fmt: skip
    assert not (tmp_path / "a.csv").exists()


def test_another_maps_reference_system_puts_the_drive_off_the_map(localization_files, tmp_path):
    reference = Reference.load(localization_files.reference, localization_files.landmarks)
    reference.crs = "EPSG:32633"
    reference.save(tmp_path / "reference.npz")
    outputs = {"poses_path": tmp_path / "a.csv", "tum_path": tmp_path / "a.tum", "view_path": tmp_path / "a.mcap"}
    localize_frames.main(
        localization_files.drive, tmp_path / "reference.npz", localization_files.landmarks, None, **outputs,
        pictures_folder=tmp_path / "a", method="voting", settings={}, sequence={}, seed=1,
    )  # fmt: skip
    table = pd.read_csv(tmp_path / "a.csv")
    assert set(table["status"]) == {"off_map", "no_points"}
    assert table["found_x_m"].isna().all()


def test_an_unknown_method_or_key_is_named(localization_files, tmp_path):
    with pytest.raises(BadInput, match="choose one of voting"):
        run(localization_files, tmp_path, method="guessing")
    with pytest.raises(BadInput, match=r"window\.shift"):
        run(localization_files, tmp_path, window={"shift": 3})
