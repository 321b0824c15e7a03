"""simulate_drive on the tiny city: the form every drive has, exact truth beside it, and a run that was stopped."""

import json
import re
from collections import Counter

import numpy as np
import pandas as pd
import pytest
import yaml
from mcap.reader import NonSeekingReader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial import cKDTree
from toy_recordings import ROOT, SCHEMA

from scripts.simulate_drive import main
from streetscan import geodesy, geometry
from streetscan.classes import FACADE, GROUND, PHANTOM
from streetscan.drive_sheets import write_drive_sheet
from streetscan.drives import read_drive_facts
from streetscan.errors import BadInput
from streetscan.extrinsics import extrinsics_at
from streetscan.frames import CameraImage, CameraModel, GpsFix, LidarFrame, Mounting
from streetscan.inspection import inspect_drive
from streetscan.io.images import decode_image
from streetscan.io.mcap import iterate_drive, iterate_lidar, read_camera_model, read_topics
from streetscan.io.trajectories import read_poses_csv, read_tum
from streetscan.simulation import drives
from streetscan.simulation.camera import pixel_rays, project
from streetscan.simulation.changes import Day
from streetscan.simulation.colouring import Cameras
from streetscan.simulation.layout import build_street
from streetscan.simulation.receiver import Receiver
from streetscan.simulation.recording import Errors, record_street, replay_pass
from streetscan.simulation.sensors import mobile_mapper

FACTS = ROOT / "config" / "drives" / "city_tiny_main_road.yaml"
TINY = yaml.safe_load((ROOT / "config" / "datasets" / "city_tiny.yaml").read_text())
STREET = TINY["simulation"]["street"] | {"length_m": TINY["parts"]["test"]["length_m"], "crs": TINY["crs"]}
CAMERA = {"xyz_m": [1.25, 0.08, 1.58], "rpy_deg": [0.6, 1.5, -0.8], "n_keyframes": 1, "window": 3, "time_offset_s": 0.004}
SMALL = {"width": 321, "height": 241, "focal_px": 250.0}
KNOCK = {"after_s": 0.21, "xyz_m": [0.1, -0.2, 0.1], "rpy_deg": [1.0, 2.0, -3.0]}


def run(folder, facts=FACTS, seed=1):
    folder.mkdir(exist_ok=True)
    main(facts, SCHEMA, folder, "tiny", STREET, seed, 1, folder / "drive.mcap", folder / "frames.csv", folder / "truth")
    return folder


def write_changed(path, **changes):
    facts = yaml.safe_load(FACTS.read_text())
    facts["simulation"] |= changes
    path.write_text(yaml.safe_dump(facts))
    return path


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return run(tmp_path_factory.mktemp("tiny"))


def test_frames_stamps_and_rings_are_a_velodynes(drive):
    table, frames = pd.read_csv(drive / "frames.csv"), list(iterate_lidar(drive / "drive.mcap"))
    assert (table["status"] == "ok").all()
    assert table["n_points"].tolist() == [len(f) for f in frames]
    assert 60_000 < table["n_points"].min() < table["n_points"].max() < 133_000
    start_ns = yaml.safe_load(FACTS.read_text())["start_time_s"] * 10**9
    assert [f.time_ns for f in frames] == [start_ns + 50_000_000 + k * 100_000_000 for k in range(6)]
    for frame in frames:
        assert -0.05 <= frame.time_offset_s.min() < -0.049
        assert 0.049 < frame.time_offset_s.max() <= 0.05
        # Azimuth 0 is met at the stamp, clockwise, each beam within its own offset.
        azimuths = np.degrees(np.arctan2(frame.points[:, 1], frame.points[:, 0]))
        assert np.degrees(np.abs(geometry.angle_difference(np.radians(azimuths), -2 * np.pi * 10 * frame.time_offset_s))).max() < 8
        assert frame.ring.max() == 63


def test_points_and_true_poses_meet_the_street(drive):
    """Points carried into the map by the true trajectory lie on the meshes of their own instances."""
    facts = read_drive_facts(FACTS, SCHEMA)
    scene = build_street(split="test", seed=1, day=Day(**facts.simulation["day"]), time_span_s=(-10.0, 5.6), **STREET)
    times_s, T_map_vehicle = read_tum(drive / "truth" / "trajectory.tum")
    T_vehicle_lidar = np.array(yaml.safe_load((drive / "truth" / "truth.yaml").read_text())["mountings"]["T_vehicle_lidar"])
    frame = next(iterate_lidar(drive / "drive.mcap"))
    labels, instances = (np.load(drive / "truth" / kind / "000000.npy") for kind in ("labels", "instances"))
    fired = frame.time_ns / 1e9 + frame.time_offset_s.astype(np.float64)
    points = geometry.apply(geometry.interpolate_poses(fired, times_s, T_map_vehicle) @ T_vehicle_lidar, frame.points)
    mesh = scene.static
    for label in (GROUND, FACADE):
        corners = mesh.vertices[mesh.triangles[mesh.labels == label]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        _, near = cKDTree(corners.mean(axis=1)).query(points[labels == label], k=8)
        offsets = np.einsum("nkj,nkj->nk", points[labels == label][:, None] - corners[near, 0], normals[near])
        assert np.median(np.abs(offsets).min(axis=1)) < 0.02
    stand = set(np.unique(mesh.instances)) | {int(i) for a in scene.actors for i in np.unique(a.mesh.instances)}
    assert set(np.unique(instances)) <= stand


def test_truth_is_complete_and_in_the_form_of_imported_drives(drive):
    truth = drive / "truth"
    content = yaml.safe_load((truth / "truth.yaml").read_text())
    assert content["labels"]["ids"] == "streetscan"
    assert content["poses"]["frame"] == "map"
    _, _, poses = read_poses_csv(truth / "poses.csv")
    times_s, trajectory = read_tum(truth / "trajectory.tum")
    stamps = pd.read_csv(truth / "poses.csv")["time_s"].to_numpy()
    expected = geometry.interpolate_poses(stamps, times_s, trajectory) @ np.array(content["mountings"]["T_vehicle_lidar"])
    assert np.abs(expected[:, :3, 3] - poses[:, :3, 3]).max() < 1e-4
    assert geometry.rotation_angle(geometry.invert(expected) @ poses).max() < 1e-5
    for k, n in enumerate(pd.read_csv(drive / "frames.csv")["n_points"]):
        for kind in ("labels", "instances"):
            assert np.load(truth / kind / f"{k:06d}.npy").shape == (n,)
    objects = pd.read_csv(truth / "objects.csv")
    assert (objects["speed_mps"] > 1).any()
    assert objects.groupby("frame").size().nunique() == 1
    counts = json.loads((truth / "changes.json").read_text())
    assert counts["column"]["share_same"] == 1.0


def test_gps_is_wrong_but_not_absurd(drive):
    records = list(iterate_drive(drive / "drive.mcap"))
    fixes = [r for r in records if isinstance(r, GpsFix)]
    assert [m.child for m in records if isinstance(m, Mounting)] == ["lidar", "gps"]
    assert len(fixes) >= 2
    xy = geodesy.project([f.latitude_deg for f in fixes], [f.longitude_deg for f in fixes], TINY["crs"])
    _, _, poses = read_poses_csv(drive / "truth" / "poses.csv")
    distances, _ = cKDTree(poses[:, :2, 3]).query(xy)
    assert 0.1 < distances.max() < 11
    yaw = np.degrees(geometry.rpy_of_transform(poses[0])[2])
    heading = 90 - np.degrees(fixes[0].heading_rad)
    assert abs((heading - yaw + 180) % 360 - 180) < 16


def test_an_independent_reader_finds_every_message_and_checksum(drive):
    names, n_points = {}, []
    with (drive / "drive.mcap").open("rb") as stream:
        for schema, channel, _, message in NonSeekingReader(stream, True, [DecoderFactory()]).iter_decoded_messages():
            names[channel.topic] = schema.name
            if channel.topic == "/lidar":
                n_points.append(len(message.data) // message.point_stride)
                assert [f.name for f in message.fields] == ["x", "y", "z", "intensity", "time_offset_s", "ring"]
    assert names == {"/lidar": "foxglove.PointCloud", "/gps": "foxglove.LocationFix", "/tf": "foxglove.FrameTransform"}
    assert n_points == pd.read_csv(drive / "frames.csv")["n_points"].tolist()


def test_the_drives_file_tells_no_truth(drive):
    lidar = next(m for m in iterate_drive(drive / "drive.mcap") if isinstance(m, Mounting))
    truth = np.array(yaml.safe_load((drive / "truth" / "truth.yaml").read_text())["mountings"]["T_vehicle_lidar"])
    assert not np.allclose(lidar.T_parent_child, truth, atol=1e-3)


def test_a_drive_that_was_stopped_goes_on_and_comes_out_the_same(drive, tmp_path, monkeypatch):
    made = []

    def stop_after(n):
        def record(*arguments):
            if len(made) == n:
                raise KeyboardInterrupt
            made.append(arguments[3])
            return original(*arguments)

        return record

    original = drives.record_frame
    monkeypatch.setattr(drives, "record_frame", stop_after(4))
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path)
    assert not (tmp_path / "drive.mcap").exists()
    made.clear()
    monkeypatch.setattr(drives, "record_frame", stop_after(100))
    run(tmp_path)
    assert made == [4, 5]
    assert (tmp_path / "drive.mcap").read_bytes() == (drive / "drive.mcap").read_bytes()
    assert (tmp_path / "truth" / "objects.csv").read_bytes() == (drive / "truth" / "objects.csv").read_bytes()
    assert not (tmp_path / "drive.mcap.resume").exists()


def test_another_seed_is_another_drive(drive, tmp_path):
    other = run(tmp_path, write_changed(tmp_path / "f.yaml", n_frames=1), seed=2)
    a, b = (next(iterate_lidar(folder / "drive.mcap")) for folder in (drive, other))
    assert isinstance(a, LidarFrame)
    assert len(a) != len(b)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"place": "bridge"}, "place 'bridge' number 0 of a street that has 0"),
        ({"n_frames": 600}, "600 frames take 60.0 s"),
        ({"start_m": 200}, "start_m 200 on a line of 28 m"),
        ({"lidar": {"xyz_m": [0.8, 0, 1.4], "rpy_deg": [0, 0, 0]}}, "1.4 m above the road; put it above the vehicle's roof"),
        ({"lidar": {"xyz_m": [0.8, 0, 1.7], "rpy_deg": [0, 0, 0], "calibration": "two.yaml"}}, "two.yaml: 2 lasers; give the calibration"),
        ({"camera": CAMERA | {"settings": {"exposure_s": [8e-3, 5e-5]}}}, "exposure_s: .* shortest exposure first"),
        ({"camera": CAMERA | {"settings": {"distortion": [-0.35, 0, 0, 0]}}}, "shows nothing beyond 651 pixels"),
        ({"camera": CAMERA | {"shift": KNOCK | {"after_s": 0.6}}}, "camera.shift.after_s 0.6 in a drive of 0.6 s; let the camera be shift"),
        ({"camera": CAMERA | {"shift": KNOCK | {"after_s": 0}}}, "camera.shift.after_s: 0 is less than or equal to the minimum of 0"),
        ({"camera": CAMERA | {"shift": {"xyz_m": [0, 0, 0], "rpy_deg": [0, 0, 0]}}}, "camera.shift: 'after_s' is a required property"),
    ],
)
def test_an_impossible_drive_is_refused(changes, message, tmp_path):
    lasers = [{"laser_id": i, "rot_correction": 0.0, "vert_correction": 0.02 * i} for i in (0, 1)]
    (tmp_path / "two.yaml").write_text(yaml.safe_dump({"lasers": lasers}))
    with pytest.raises(BadInput, match=message):
        run(tmp_path, write_changed(tmp_path / "f.yaml", **changes))


def test_a_drive_in_another_reference_system_than_its_street_is_refused(tmp_path):
    facts = yaml.safe_load(FACTS.read_text()) | {"crs": "EPSG:32634"}
    (tmp_path / "f.yaml").write_text(yaml.safe_dump(facts))
    with pytest.raises(BadInput, match="crs EPSG:32634 of a street in EPSG:23700"):
        run(tmp_path, tmp_path / "f.yaml")


def test_a_drive_without_its_section_is_refused(tmp_path):
    facts = yaml.safe_load(FACTS.read_text())
    del facts["simulation"]
    (tmp_path / "f.yaml").write_text(yaml.safe_dump(facts))
    with pytest.raises(BadInput, match="'simulation' is a required property"):
        read_drive_facts(tmp_path / "f.yaml", SCHEMA)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("filmed")
    facts = write_changed(folder / "f.yaml", n_frames=4, camera=CAMERA | {"settings": SMALL, "previews_per_s": 0})
    return run(folder, facts)


@pytest.fixture(scope="module")
def knocked(tmp_path_factory):
    """The same drive, with a camera that was moved between the second and the third image."""
    folder = tmp_path_factory.mktemp("knocked")
    camera = CAMERA | {"settings": SMALL, "previews_per_s": 0, "shift": KNOCK}
    return run(folder, write_changed(folder / "f.yaml", n_frames=4, camera=camera))


def test_a_shift_is_told_as_the_camera_looked_before():
    shift = drives.CameraShift(after_s=5.0, xyz_m=(0.5, 0.0, 0.1), rpy_deg=(0.0, 10.0, 90.0))
    to_the_left = drives.CameraMount(xyz_m=(1.0, 2.0, 3.0), rpy_deg=(0.0, 0.0, 90.0), shift=shift)
    before, after = (to_the_left.T_vehicle_camera_at(t) for t in (4.999, 5.0))
    assert np.array_equal(before, to_the_left.T_vehicle_camera)
    np.testing.assert_allclose(before[:3, 2:].T, [[0, 1, 0], [1, 2, 3]], atol=1e-12)
    # Forward was to the vehicle's left; now it looks back, ten degrees downwards.
    np.testing.assert_allclose(after[:3, 2:].T, [[-np.cos(np.radians(10)), 0, -np.sin(np.radians(10))], [1, 2.5, 3.1]], atol=1e-12)


def test_truth_has_both_places_of_a_knocked_camera(filmed, knocked):
    of_filmed, of_knocked = (yaml.safe_load((folder / "truth" / "truth.yaml").read_text()) for folder in (filmed, knocked))
    place = of_knocked["extrinsics"]
    shift = place.pop("shift")
    assert of_knocked == of_filmed
    assert shift["from_image_time_ns"] == round((yaml.safe_load(FACTS.read_text())["start_time_s"] + 0.21 + 0.004) * 1000) * 10**6
    images, others = ([r for r in iterate_drive(f / "drive.mcap") if isinstance(r, CameraImage)] for f in (knocked, filmed))
    assert [i.time_ns >= shift["from_image_time_ns"] for i in images] == [False, False, True]
    # Until then the drive is the same to the last bit.
    assert [a.data == b.data for a, b in zip(images, others, strict=True)] == [True, True, False]
    _, stamps, T_map_camera = read_poses_csv(knocked / "truth" / "camera_poses.csv")
    times_s, trajectory = read_tum(knocked / "truth" / "trajectory.tum")
    T_map_lidar = geometry.interpolate_poses(stamps - 0.004, times_s, trajectory) @ np.array(of_knocked["mountings"]["T_vehicle_lidar"])
    for image, lidar, camera in zip(images, T_map_lidar, T_map_camera, strict=True):
        assert np.abs(geometry.invert(camera) @ lidar - extrinsics_at(place | {"shift": shift}, image.time_ns)).max() < 1e-4
    moved = np.array(place["T_camera_lidar"]) @ geometry.invert(np.array(shift["T_camera_lidar"]))
    # In the camera's axes, which are right, down and ahead.
    assert moved[:3, 3] == pytest.approx([0.2, -0.1, 0.1])
    assert np.degrees(geometry.rotation_angle(moved)) == pytest.approx(np.sqrt(1 + 4 + 9), abs=0.05)
    assert "shift" not in yaml.safe_load((filmed / "truth" / "truth.yaml").read_text())["extrinsics"]


def test_images_stand_in_windows_at_the_full_rate():
    mount = drives.CameraMount(**CAMERA)
    times = mount.image_times(6.0)
    numbers = [round(t * 28 - 0.5) for t, _ in times]
    # A window of 3 in the middle of 6 s, and one preview in each second; only the window's images follow one another.
    assert [n for n in numbers if 80 < n < 90] == [82, 83, 84]
    assert {14, 42, 70, 98, 126, 154} <= set(numbers)
    assert len(numbers) == 9
    assert [n for n, (_, follows) in zip(numbers, times, strict=True) if follows] == [83, 84]
    every = drives.CameraMount(**CAMERA | {"is_full_rate": True}).image_times(6.0)
    assert len(every) == 168
    assert sum(follows for _, follows in every) == 167
    # A drive over before the first image has none.
    assert drives.CameraMount(**CAMERA | {"rate_hz": 2.0, "previews_per_s": 5.0}).image_times(0.4) == []


def test_images_masks_and_lidar_agree_through_the_true_extrinsics(filmed):
    """Lidar points carried to the moment of an image by the true poses fall on pixels of their own object."""
    images = [r for r in iterate_drive(filmed / "drive.mcap") if isinstance(r, CameraImage)]
    truth = yaml.safe_load((filmed / "truth" / "truth.yaml").read_text())
    _, stamps, T_map_camera = read_poses_csv(filmed / "truth" / "camera_poses.csv")
    assert len(images) == 3
    assert stamps == pytest.approx([i.time_ns / 1e9 for i in images], abs=1e-6)
    assert np.diff(stamps) == pytest.approx([1 / 28] * 2, abs=1e-6)
    times_s, trajectory = read_tum(filmed / "truth" / "trajectory.tum")
    offset_s = truth["extrinsics"]["time_offset_s"]
    at_image = geometry.interpolate_poses(stamps - offset_s, times_s, trajectory)
    T_vehicle_camera, T_vehicle_lidar = (np.array(truth["mountings"][f"T_vehicle_{s}"]) for s in ("camera", "lidar"))
    assert np.abs(at_image @ T_vehicle_camera - T_map_camera).max() < 1e-4
    assert np.allclose(np.array(truth["extrinsics"]["T_camera_lidar"]), geometry.invert(T_vehicle_camera) @ T_vehicle_lidar)

    model = read_camera_model(filmed / "drive.mcap")
    frames = list(iterate_lidar(filmed / "drive.mcap"))
    image = images[1]
    row = int(np.argmin([abs(f.time_ns - image.time_ns) for f in frames]))
    frame, instances = frames[row], np.load(filmed / "truth" / "instances" / f"{row:06d}.npy")
    fired = geometry.interpolate_poses(frame.time_ns / 1e9 + frame.time_offset_s.astype(np.float64), times_s, trajectory)
    points = geometry.apply(geometry.invert(T_map_camera[1]), geometry.apply(fired @ T_vehicle_lidar, frame.points))
    pixels = project(points, model)
    inside = np.isfinite(pixels).all(axis=1) & (np.abs(pixels - [160, 120]) < [159, 119]).all(axis=1) & (points[:, 2] < 20)
    u, v = np.round(pixels[inside]).astype(int).T
    with np.load(filmed / "truth" / "masks" / "000001.npz") as mask:
        seen, shape = mask["instances"][v, u], mask["labels"].shape
    assert shape == (241, 321)
    assert inside.sum() > 3000
    # The camera sees past edges where the lidar does not; most of what both see is the same.
    assert (seen == instances[inside]).mean() > 0.85
    assert decode_image(image).shape == (241, 321, 3)


@pytest.mark.parametrize("drive_of", ["filmed", "knocked"])
def test_an_image_shows_what_its_own_camera_pose_sees(drive_of, request):
    """Pixel by pixel what the rays of the written pose meet at the moment the stamp stands for, neither 4 ms earlier nor later."""
    filmed = request.getfixturevalue(drive_of)
    facts = read_drive_facts(filmed / "f.yaml", SCHEMA)
    recording = drives.SimulatedRecording(facts, "tiny", STREET, 1, filmed, filmed / "again", 1)
    _, stamps, T_map_camera = read_poses_csv(filmed / "truth" / "camera_poses.csv")
    offset_s = yaml.safe_load((filmed / "truth" / "truth.yaml").read_text())["extrinsics"]["time_offset_s"]
    pixels = np.stack(np.meshgrid(np.arange(2, 321, 3), np.arange(2, 241, 3)), axis=-1).reshape(-1, 2)
    rays = np.column_stack([pixel_rays(pixels, read_camera_model(filmed / "drive.mcap")), np.ones(len(pixels))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for k, (stamp, T) in enumerate(zip(stamps, T_map_camera, strict=True)):
        time_s = stamp - offset_s - facts.start_time_s
        origins, times = np.tile(T[:3, 3], (len(rays), 1)), np.full(len(rays), time_s)
        hits = recording._caster.cast(origins, (rays @ T[:3, :3].T).astype(np.float32), times)
        with np.load(filmed / "truth" / "masks" / f"{k:06d}.npz") as mask:
            seen = mask["instances"][pixels[:, 1], pixels[:, 0]]
        assert (seen == np.where(hits.faces >= 0, recording._caster.instances[hits.faces], 0)).mean() > 0.998


@pytest.mark.parametrize("drive_of", ["filmed", "knocked"])
def test_the_page_lays_a_frame_on_its_image_as_it_was_at_that_moment(drive_of, request):
    """What stands still comes to where the image's own pose sees it; as fired it is as far off as the car drove in between."""
    filmed = request.getfixturevalue(drive_of)
    inspection = inspect_drive(filmed / "drive.mcap", filmed / "frames.csv", filmed / "truth")
    _, stamps, T_map_camera = read_poses_csv(filmed / "truth" / "camera_poses.csv")
    assert inspection.image_times_s["camera"] == pytest.approx(stamps, abs=1e-6)
    times_s, trajectory = read_tum(filmed / "truth" / "trajectory.tum")
    T_vehicle_lidar = np.array(yaml.safe_load((filmed / "truth" / "truth.yaml").read_text())["mountings"]["T_vehicle_lidar"])
    for row, images in inspection.images.items():
        frame, number = inspection.pictured[row], int(np.argmin(np.abs(stamps - images["camera"].time_ns * 1e-9)))
        fired = geometry.interpolate_poses(frame.time_ns / 1e9 + frame.time_offset_s.astype(np.float64), times_s, trajectory)
        in_map = geometry.apply(fired @ T_vehicle_lidar, frame.points)
        expected = geometry.apply(geometry.invert(T_map_camera[number]), in_map)
        near = (expected[:, 2] > 2) & (np.linalg.norm(expected, axis=1) < 20)
        carried, is_carried = inspection.points_at_image(row, "camera")
        off_m = [
            np.linalg.norm(geometry.apply(inspection.T_camera_lidar_at(row, "camera"), p)[near] - expected[near], axis=1)
            for p in (carried, frame.points)
        ]
        assert is_carried
        assert near.sum() > 10_000
        assert off_m[0].max() < 0.02 < np.median(off_m[1])


def test_frames_say_whether_they_have_an_image_and_the_file_does_not_tell_where_the_camera_is(filmed):
    table = pd.read_csv(filmed / "frames.csv")
    assert set(table["image_status"]) == {"ok", "not_rendered"}
    assert [m.child for m in iterate_drive(filmed / "drive.mcap") if isinstance(m, Mounting)] == ["lidar", "gps"]


MAPPING = ROOT / "config" / "drives" / "city_mapping.yaml"


def write_mapping(path):
    """The mapping vehicle's drive in the tiny city, with small pictures."""
    facts = yaml.safe_load(MAPPING.read_text())
    simulation = facts["simulation"] | {"dataset": "city_tiny", "n_frames": 7}
    for mount in simulation["cameras"].values():
        mount["settings"] |= {"width": 121, "height": 161, "focal_px": mount["settings"]["focal_px"] / 8}
    path.write_text(yaml.safe_dump(facts | {"simulation": simulation}))
    return path


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mapped")
    return run(folder, write_mapping(folder / "f.yaml"))


def test_the_mapping_vehicle_looks_all_round():
    drive = drives.read_simulation(read_drive_facts(MAPPING, SCHEMA).simulation)
    T = np.array([mount.T_vehicle_camera for mount in drive.cameras.values()])
    assert len(T) == 6
    np.testing.assert_allclose(T[0, :3, 2], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(T[:5, :3, 2].sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(T[5, :3, 2], [0, 0, 1], atol=1e-12)
    # The ring's images are upright: down in the picture is down in the world.
    np.testing.assert_allclose(T[:5, :3, 1], np.tile([0, 0, -1], (5, 1)), atol=1e-12)


def test_six_cameras_have_topics_and_truth_of_their_own(mapped):
    names = [f"camera_{i}" for i in (1, 2, 3, 4, 5, "up")]
    topics = {f"/{name}/{kind}" for name in names for kind in ("image", "calibration")}
    assert topics <= set(read_topics(mapped / "drive.mcap"))
    records = list(iterate_drive(mapped / "drive.mcap", read_topics(mapped / "drive.mcap")))
    images = [r for r in records if isinstance(r, CameraImage)]
    assert {r.camera for r in records if isinstance(r, CameraModel)} == {i.camera for i in images} == set(names)
    # Methods that want the one camera of a drive do not get one of six.
    assert not [r for r in iterate_drive(mapped / "drive.mcap") if isinstance(r, CameraImage | CameraModel)]
    places = yaml.safe_load((mapped / "truth" / "truth.yaml").read_text())["cameras"]
    assert list(places) == names
    for name in names:
        of_camera = [i for i in images if i.camera == name]
        _, stamps, poses = read_poses_csv(mapped / "truth" / name / "camera_poses.csv")
        assert stamps == pytest.approx([i.time_ns / 1e9 for i in of_camera], abs=1e-6)
        assert len(poses) == len(list((mapped / "truth" / name / "masks").glob("*.npz"))) == 1
        assert decode_image(of_camera[0]).shape == (161, 121, 3)
    # The camera that looks up sees sky, the others the street.
    shares = {}
    for name in names:
        with np.load(mapped / "truth" / name / "masks" / "000000.npz") as mask:
            shares[name] = (mask["labels"] == GROUND).mean()
    assert shares["camera_up"] == 0
    assert min(shares[name] for name in names[:5]) > 0.1


def test_the_mapping_vehicle_hides_what_its_roof_hides(mapped, drive):
    """The van is longer and wider than the car: its lidar sees the road from farther on, ahead and to the sides."""
    nearest = {}
    for name, folder in (("van", mapped), ("car", drive)):
        frame = next(iterate_lidar(folder / "drive.mcap"))
        road = frame.points[np.load(folder / "truth" / "labels" / "000000.npy") == GROUND]
        ahead = (np.abs(road[:, 1]) < 0.5) & (road[:, 0] > 0)
        nearest[name] = road[ahead, 0].min()
    assert nearest["van"] > nearest["car"] + 2


def test_the_page_of_six_cameras_shows_them_all(mapped):
    inspection = inspect_drive(mapped / "drive.mcap", mapped / "frames.csv", mapped / "truth")
    assert inspection.changes is None
    assert [len(of_frame) for of_frame in inspection.images.values()] == [6]
    write_drive_sheet(mapped / "sheet.html", "mapped", "six", "ours", inspection)
    page = (mapped / "sheet.html").read_text()
    assert all(f"<td>camera_{name}</td>" in page for name in (1, 2, 3, 4, 5, "up"))
    assert int(re.search(r"camera_up, (\d+) lidar points in them", page)[1]) > 10_000


def test_the_mapping_drive_is_the_first_pass_of_the_map_in_its_own_world(mapped):
    scene, trajectory = replay_pass("test", 1, STREET, 0)
    records = record_street("test", 1, STREET, mobile_mapper(100.0, 20_000.0), Receiver(), Cameras(), Errors(drift_m=0.0, attitude_deg=0.0))
    first = next(iter(records))
    inside = first.cloud.fields["time_s"] < 0.5
    reach = np.linalg.norm(first.cloud.points[inside] - trajectory.at(np.array([0.25]))[0], axis=1)
    # The map's own first points lie about the vehicle, and its moving objects are those the drive's truth lists.
    assert np.percentile(reach, 20) < 6
    times_s, poses = read_tum(mapped / "truth" / "trajectory.tum")
    expected, _ = trajectory.at(times_s - times_s[0])
    assert np.abs(expected - poses[:, :3, 3]).max() < 1e-3
    objects = pd.read_csv(mapped / "truth" / "objects.csv")
    seen = set(np.unique(first.instances[first.labels == PHANTOM]))
    assert seen <= set(objects["instance"]) <= {int(a.mesh.instances[0]) for a in scene.actors}
    assert pd.read_csv(mapped / "truth" / "changes.csv").empty


@pytest.mark.parametrize(
    ("key", "value"),
    [("day", {"number": 3}), ("speed_kmh", 20), ("start_m", 5), ("number", 1), ("traffic_density", 0.3), ("blocks", [0, 1])],
)
def test_a_mapping_drive_is_the_maps_own(key, value, tmp_path):
    facts = yaml.safe_load(MAPPING.read_text())
    facts["simulation"][key] = value
    (tmp_path / "f.yaml").write_text(yaml.safe_dump(facts))
    with pytest.raises(BadInput, match=rf"simulation\.{key}.* at place 'mapping'"):
        read_drive_facts(tmp_path / "f.yaml", SCHEMA)


def test_the_mapping_drive_meets_the_traffic_of_a_map_driven_twice():
    """How often the map's vehicle drives decides who else is there."""
    street = STREET | {"n_rounds": 2}
    scene, trajectory = replay_pass("test", 1, street, 0)
    once, _ = replay_pass("test", 1, STREET, 0)
    mapped = build_street(split="test", seed=1, block=0, **street)
    times = np.array([1.0])
    places, of_map, of_once = (sorted(a.pose_at(times)[0][0].tolist() for a in s.actors) for s in (scene, mapped, once))
    assert places == of_map != of_once
    assert trajectory.start_s == 0


def test_time_left_knows_that_an_image_takes_longer_than_a_frame():
    progress = drives._Progress(Counter(frame=11, image=2, fix=100))
    progress.step("frame", 20.0)  # the first compiles
    for _ in range(4):
        progress.step("frame", 0.5)
    progress.step("image", 6.0)
    progress.step("fix", 0.0)
    assert progress.left_s == pytest.approx(6 * 0.5 + 6.0)
    # What a run that was stopped had made takes no time, and tells nothing of what is left.
    resumed = drives._Progress(Counter(frame=11))
    for _ in range(9):
        resumed.step("frame", None)
    resumed.step("frame", 0.5)
    assert resumed.left_s == pytest.approx(0.5)
