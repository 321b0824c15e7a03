"""A keyframe's calibration on a toy street whose sensors' places are known, and what bad input ends in."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from toy_calibration import T_CAMERA_LIDAR, changed, toy_keyframe

from streetscan.calibration.alignment import AlignmentSettings, IcpSettings
from streetscan.calibration.keyframe_calibration import (
    CalibrationFailed,
    CalibrationSettings,
    KeyframeCalibration,
    _judge,
    calibrate_keyframe,
    choose_place,
    evidence_distance,
)
from streetscan.calibration.linear_projection import project_linear
from streetscan.calibration.objects import ObjectSettings
from streetscan.calibration.quality import QualitySettings, judge_gain
from streetscan.errors import BadInput
from streetscan.geometry import invert, rotation_angle, transform

SETTINGS = CalibrationSettings(final="motion", objects=ObjectSettings(range_m=30.0))


@pytest.fixture(scope="module")
def toy():
    return toy_keyframe()


@pytest.fixture(scope="module")
def made(toy):
    return calibrate_keyframe(toy.clouds, SETTINGS)


def test_the_mounting_is_found(made):
    assert made.status == "ok", made.reason
    error = invert(T_CAMERA_LIDAR) @ made.T_camera_lidar
    assert np.degrees(rotation_angle(error)) < 0.1
    assert np.linalg.norm(error[:3, 3]) < 0.03


def test_the_projection_of_the_raw_frame_hits_the_pixels(toy, made):
    true = toy.true_pixels
    seen = toy.clouds.view.contains(true)
    errors = np.abs(project_linear(made.projection, toy.clouds.points_lidar) - true)[seen]
    assert errors.mean(axis=0).max() < 1.0


def test_every_stage_is_kept_and_the_first_is_the_coarsest(toy, made):
    true = toy.true_pixels
    seen = toy.clouds.view.contains(true)
    errors = {name: np.nanmean(np.abs(project_linear(P, toy.clouds.points_lidar) - true)[seen]) for name, P in made.stages.items()}
    assert list(errors) == ["objects", "place", "icp", "curves", "motion"]
    assert errors["motion"] < errors["place"] < errors["objects"]


def test_edges_do_not_ruin_what_the_clouds_had_right(toy, made):
    straightened = calibrate_keyframe(toy.clouds, replace(SETTINGS, final="edges"))
    assert straightened.figures["bend_deg"] == 0
    np.testing.assert_array_equal(straightened.stages["edges"], straightened.stages["motion"])
    np.testing.assert_array_equal(straightened.T_camera_lidar, made.T_camera_lidar)


def test_a_cloud_that_is_two_percent_too_large_gives_the_same_mounting():
    made = calibrate_keyframe(changed(toy_keyframe(scale=1.02), scale_std=0.02), SETTINGS)
    assert made.status == "ok", made.reason
    assert made.figures["scale"] == pytest.approx(1 / 1.02, abs=0.004)
    assert np.linalg.norm((invert(T_CAMERA_LIDAR) @ made.T_camera_lidar)[:3, 3]) < 0.05


def test_a_scale_that_the_motion_tells_is_held(toy):
    """The surer the lidar's motion is of the scale, the less the clouds change it."""
    scales = [calibrate_keyframe(changed(toy_keyframe(scale=1.02), scale_std=std), SETTINGS).figures["scale"] for std in (0.01, 0.0)]
    assert abs(scales[1] - 1) < abs(scales[0] - 1)


@pytest.mark.parametrize("scale", [0.91, 0.95, 0.98, 1.02, 1.05, 1.09])
def test_a_cloud_of_another_scale_than_its_motion_tells_is_never_believed_elsewhere(scale):
    """Held at a wrong scale, ICP finds a place that looks right and is off by decimetres."""
    made = calibrate_keyframe(toy_keyframe(scale=scale).clouds, SETTINGS)
    is_right = made.T_camera_lidar is not None and np.linalg.norm((invert(T_CAMERA_LIDAR) @ made.T_camera_lidar)[:3, 3]) < 0.3
    assert made.status != "ok" or is_right


def test_what_is_far_off_does_not_judge_where_something_is_near(toy):
    settings = replace(SETTINGS, judged_m=12.0)
    near = calibrate_keyframe(toy.clouds, settings)
    assert np.hypot(*near.evidence[:, :2].T).max() < 13.0
    # Where nothing is near, what there is has to do.
    assert len(calibrate_keyframe(toy.clouds, replace(SETTINGS, judged_m=0.5)).evidence)


def test_without_motion_the_curves_give_the_projection(toy):
    made = calibrate_keyframe(changed(toy, motion=None), SETTINGS)
    assert "motion" not in made.stages
    np.testing.assert_array_equal(made.projection, made.stages["curves"])


def test_what_is_true_stays_in_force(toy):
    kept = calibrate_keyframe(changed(toy, T_initial=T_CAMERA_LIDAR), SETTINGS)
    assert kept.status == "not_better"
    assert abs(kept.figures["gain_m"]) < SETTINGS.quality.min_gain_m


def test_what_is_wrong_in_force_is_replaced(toy):
    for wrong in (transform([0.05, 0.1, 0], np.radians([0, 0, 1.0])), transform([0, 0, 0.1], np.radians([0, 1.0, 0]))):
        replaced = calibrate_keyframe(changed(toy, T_initial=T_CAMERA_LIDAR @ wrong), SETTINGS)
        assert replaced.status == "ok", replaced.reason
        assert replaced.figures["distance_before_m"] > replaced.figures["distance_after_m"] + SETTINGS.quality.min_gain_m


@pytest.mark.parametrize("yaw_deg", [5, 90, 180])
def test_that_of_another_camera_is_replaced(yaw_deg, toy):
    """A camera to the side or to the rear has none of the edges in view that the found one has."""
    other = T_CAMERA_LIDAR @ transform(rpy_rad=(0, 0, np.radians(yaw_deg)))
    made = calibrate_keyframe(changed(toy, T_initial=other), SETTINGS)
    assert made.status == "ok", made.reason
    assert (made.figures["n_common_edges"] == 0) == (yaw_deg > 45)


@pytest.mark.parametrize("wrong", [2 * np.eye(4), np.zeros((4, 4)), np.diag([1.0, 1, -1, 1])])
def test_what_is_in_force_must_be_a_turn_and_a_shift(wrong, toy):
    with pytest.raises(BadInput, match="is no rotation"):
        calibrate_keyframe(changed(toy, T_initial=wrong), SETTINGS)


def test_an_image_without_edges_does_not_confirm(toy):
    made = calibrate_keyframe(changed(toy, image=np.full_like(toy.clouds.image, 100)), SETTINGS)
    assert made.status == "no_edges"


def test_each_gate_refuses_what_is_beyond_its_limit(made):
    asked = {
        "too_few_objects": {"n_matched": 0},
        "far_apart": {"median_distance_m": 0.2},
        "uncertain": {"sigma_x_px": 20.0},
        "scale_open": {"free_shift_m": 2.0},
        "no_edges": {"edge_px": 12.0},
        "edges_disagree": {"edge_margin_px": -0.1},
    }
    fine = made.figures | {"edge_margin_px": 1.0}
    _judge(replace(made, figures=fine), QualitySettings())
    for status, beyond in asked.items():
        unknown = {name: np.nan for name in beyond if name != "n_matched"}
        for figures in (beyond, beyond | unknown):
            with pytest.raises(CalibrationFailed) as failure:
                _judge(replace(made, figures=fine | figures), QualitySettings())
            assert failure.value.status == status


def test_edges_that_lie_farther_keep_the_one_in_force():
    gain = {"gain_m": 0.03, "gain_std_m": 0.002, "edge_gain_std_px": 0.3}
    assert all(judge_gain(gain | {"edge_gain_px": 0.5}, QualitySettings()).values())
    assert judge_gain(gain | {"edge_gain_px": -1.0}, QualitySettings()) == {"clouds": True, "edges": False}
    too_little = gain | {"edge_gain_px": 1.0, "gain_m": 0.005}
    assert judge_gain(too_little, QualitySettings()) == {"clouds": False, "edges": True}
    assert not judge_gain(too_little | {"gain_m": np.nan}, QualitySettings())["clouds"]


def test_nothing_is_compared_with_a_transform_that_is_none(toy):
    with pytest.raises(BadInput, match="not finite"):
        calibrate_keyframe(changed(toy, T_initial=np.full((4, 4), np.nan)), SETTINGS)


def test_evidence_tells_a_shifted_mounting(made):
    good = evidence_distance(made.evidence, made.T_camera_stamp)
    assert evidence_distance(made.evidence, made.T_camera_stamp @ transform([0, 0.1, 0], (0, 0, np.radians(0.5)))) > 2 * good
    assert np.isnan(evidence_distance(np.empty((0, 9)), np.eye(4)))


@pytest.mark.parametrize(
    ("change", "status"),
    [
        (lambda c: {"points_lidar": c.points_lidar + np.float32([500, 0, 0])}, "too_few_objects"),
        (lambda c: {"points_sfm": c.points_sfm[:0], "is_dynamic_sfm": c.is_dynamic_sfm[:0]}, "too_few_objects"),
        (lambda c: {"is_static": np.zeros(len(c.is_static), bool)}, "too_few_objects"),
        # A cloud of images of some other place: nothing but one wall where there is a road.
        (lambda c: {"points_sfm": np.random.default_rng(0).uniform([-9, -3, 20], [9, 3, 20.1], (len(c.points_sfm), 3))}, "no_ground"),
    ],
)
def test_bad_input_is_a_status(toy, change, status):
    made = calibrate_keyframe(changed(toy, **change(toy.clouds)), SETTINGS)
    assert made.status == status
    assert made.reason
    assert made.projection is None


def test_clouds_of_two_places_do_not_match(toy):
    other = toy_keyframe(seed=7)
    mirrored = other.clouds.points_sfm * [-1.0, 1, 1]
    keep = mirrored[:, 2] < 12
    made = calibrate_keyframe(changed(toy, points_sfm=mirrored[keep], is_dynamic_sfm=np.zeros(keep.sum(), bool)), SETTINGS)
    assert made.status != "ok"


def test_settings_are_checked():
    with pytest.raises(BadInput, match="choose one of curves, motion, edges"):
        CalibrationSettings(final="best")


def at_place(x_m: float, edge_px: float, status: str = "ok") -> KeyframeCalibration:
    """What came of beginning at a place."""
    return KeyframeCalibration(status, projection=np.eye(3, 4), T_camera_stamp=transform([x_m, 0, 0]), figures={"edge_px": edge_px})


def by_edges(a: KeyframeCalibration, b: KeyframeCalibration) -> bool:
    return a.figures["edge_px"] < b.figures["edge_px"]


def never(a: KeyframeCalibration, b: KeyframeCalibration) -> bool:
    return False


def test_of_the_places_that_pass_the_one_with_the_nearest_edges_is_chosen():
    tried = [at_place(0.0, 3.0), at_place(0.1, 2.0), at_place(2.0, 4.0, "far_apart")]
    chosen = choose_place(tried, by_edges)
    assert chosen is tried[1]
    assert (chosen.status, chosen.figures["n_places"], chosen.figures["n_rivals"]) == ("ok", 3, 0)


def test_a_second_place_that_fits_as_well_makes_it_ambiguous():
    chosen = choose_place([at_place(0.0, 2.0), at_place(4.0, 2.5)], never)
    assert (chosen.status, chosen.figures["n_rivals"]) == ("ambiguous", 1)
    assert chosen.reason == "4.0 m and 0.0 degrees away the clouds and edges fit as well"
    clear = choose_place([at_place(0.0, 2.0), at_place(4.0, 2.5)], by_edges)
    assert (clear.status, clear.figures["n_rivals"]) == ("ok", 0)


def test_where_no_place_passes_the_first_tells_why():
    tried = [at_place(0.0, 2.0, "far_apart"), at_place(4.0, 1.0, "uncertain")]
    assert choose_place(tried, never) is tried[0]


def test_a_place_the_clouds_leave_open_can_be_as_good():
    tried = [at_place(0.0, 2.0), at_place(4.0, 2.5, "uncertain"), at_place(9.0, 2.5, "far_apart")]
    assert (choose_place(tried, never).status, tried[0].figures["n_rivals"]) == ("ambiguous", 1)


def test_a_cloud_that_is_bent_is_compared_as_it_was_corrected():
    # The camera believes to go 0.5 degrees to the left, and takes depths from that.
    toy, bend = toy_keyframe(), np.radians(0.5)
    points, right = toy.clouds.points_sfm, toy.clouds.cameras_sfm[-1]
    believed = Rotation.from_rotvec([0, -bend, 0]).apply(right)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    ratio = np.linalg.norm(np.cross(rays, believed), axis=1) / np.linalg.norm(np.cross(rays, right), axis=1)
    near = (ratio > 0.8) & (ratio < 1.25)
    cameras = Rotation.from_rotvec([0, -bend, 0]).apply(toy.clouds.cameras_sfm)
    bent = changed(toy, points_sfm=(points * ratio[:, None])[near], is_dynamic_sfm=np.zeros(near.sum(), bool), cameras_sfm=cameras)
    icp = IcpSettings(bend_std_deg=2.0)
    made = calibrate_keyframe(replace(bent, T_initial=T_CAMERA_LIDAR), replace(SETTINGS, alignment=AlignmentSettings(icp=icp)))
    assert made.figures["bend_icp_deg"] == pytest.approx(-0.5, abs=0.2)
    # What is in force is the truth: the clouds say neither against it nor for it.
    assert abs(made.figures["gain_m"]) < 0.005


def test_a_way_is_used_where_firing_times_are_not_known(toy):
    made = calibrate_keyframe(changed(toy, time_offset_s=None), SETTINGS)
    assert abs(made.figures["way_off_deg"]) < 0.2
    assert made.figures["n_shots"] == 1


def test_equal_posts_at_equal_distances_are_refused():
    # Nothing but a road and posts, 2.5 m from each other along it: one spacing off, clouds and edges fit as well.
    toy = toy_keyframe(posts_m=2.5)
    made = calibrate_keyframe(toy.clouds, SETTINGS)
    assert made.status == "ambiguous", made.reason
    assert made.figures["n_rivals"] >= 1
