"""Whether a calibration is to be believed: the thesis' gates, a robust distance, and what image edges must show (see `edges`).

Source: Nagy (2020), 4.4.2 (N-231 to N-234).

ASSUME: the thesis accepts a Hausdorff distance of its clouds below 5 cm. The plain one, the farthest point of all, is metres in any
street, if only for what one sensor sees alone; it is reported, and the gate is the median distance of points on matched objects.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from streetscan.calibration.alignment import PlaneTarget

# What can be the matter with a keyframe's calibration, beside the statuses of its reconstruction.
STATUSES = {
    "ok": "accepted",
    "no_clouds": "the keyframe has no cloud in metres",
    "no_ground": "one of the clouds shows no ground to lay level",
    "too_few_objects": "too few objects in one of the clouds",
    "no_match": "the clouds lie on each other nowhere",
    "ambiguous": "at two places clouds and edges fit about as well",
    "not_converged": "ICP does not settle, or wants another scale than the clouds can have",
    "scale_open": "left free, the scale of the camera's cloud takes the lidar elsewhere",
    "no_projection": "too few points to fit a projection to",
    "uncertain": "the clouds leave open where the lidar is",
    "far_apart": "matched objects are too far from the camera's cloud",
    "no_edges": "image or lidar show no edges to check the calibration on",
    "edges_disagree": "edges in the image do not lie where the lidar sees them",
    "not_better": "the calibration in force fits at least as well",
}


@dataclass(frozen=True)
class QualitySettings:
    """Gates of a calibration.

    Attributes:
        min_objects: fewer matched objects tell nothing. ASSUME: one, for the distance to be measured on. The thesis asks for more than
            three columns around (N-234); on the training street keyframes with one and two were right.
        max_sigma_px: largest deviation across the image, on the mean of the points in view, that clouds and way leave open. On training and
            validation streets of two cities (seeds 1 and 11) 35 of 36 keyframes are found right (within 0.3 degrees and 20 cm), 34 of them
            with 7.6 and less.
        max_distance_m: largest median distance of points on matched objects from the camera's planes, with which 95 % of the right ones
            pass: of 22 in the second city one has more, 0.104, the next 0.077 and 0.071; of 13 in the first one has more than 0.055. Of 28
            calibrations there from starts drawn at random one that is 1.6 m off passes with 0.072.
        max_free_shift_m: by which the lidar moves at most when the scale of the camera's cloud, which its motion tells, is left to the
            clouds. A cloud of another scale than it is held at can look right, metres away. Right ones of the second city move by at most
            0.12, but for one, 18 cm off, that moves by 0.25.
        min_edge_margin_px: by which image edges must lie nearer to the lidar's edges than they do when the calibration is turned either
            way, over the shots of a keyframe. Of the 13 right ones of the first city eleven have 0.38 and more, those of the second 0.5.
            From starts drawn at random ICP ends at places that pass the gates above and are off by more than 25 cm: 16 of 19 have 0 and
            less, those with more are off by 38, 26 and 59 cm (0.31, 0.73, 0.92), and the right place then fits better.
        min_edge_margin_of_one_px: the same where there is one shot. On version 1 of the city right keyframes had 0.70 and more, wrong
            places up to 0.37.
        edge_turn_deg: by so much.
        max_edge_px: an image edge farther off is none.
        min_gain_m: by which the clouds must lie nearer, on the mean of points in view, than under the calibration in force. On validation
            keyframes the truth itself is bettered by up to 0.007 m, since the camera's cloud is not free of error.
    """

    min_objects: int = 1
    max_sigma_px: float = 9.5
    max_distance_m: float = 0.08
    max_free_shift_m: float = 0.3
    min_edge_margin_px: float = 0.35
    min_edge_margin_of_one_px: float = 0.5
    edge_turn_deg: float = 1.0
    max_edge_px: float = 12.0
    min_gain_m: float = 0.01

    def least_margin_px(self, n_shots: float) -> float:
        """The margin asked of edges over so many shots."""
        return self.min_edge_margin_px if n_shots > 1 else self.min_edge_margin_of_one_px


def plane_distances(points_sfm: np.ndarray, target: PlaneTarget, reach_m: float) -> np.ndarray:
    """Distances (N,) of points from the nearest plane of the camera's cloud; NaN where none is within reach."""
    distances, rows = target.tree.query(points_sfm, distance_upper_bound=reach_m)
    is_found = np.isfinite(distances)
    result = np.full(len(points_sfm), np.nan)
    rows = rows[is_found]
    result[is_found] = np.abs(np.einsum("ij,ij->i", points_sfm[is_found] - target.points[rows], target.normals[rows]))
    return result


def hausdorff_distance(a: np.ndarray, b: np.ndarray) -> float:
    """The plain Hausdorff distance of two clouds (N, 3) and (M, 3); NaN when one is empty."""
    if len(a) == 0 or len(b) == 0:
        return float("nan")
    return float(max(cKDTree(b).query(a)[0].max(), cKDTree(a).query(b)[0].max()))


def judge_gain(figures: Mapping[str, float], q: QualitySettings) -> dict[str, bool]:
    """Whether clouds and edges say that a calibration is better than the one in force by more than noise: each of them that has a say.

    ASSUME: where edges have corrected the way of the camera, its cloud is wrong and has no say; edges must gain then. Otherwise the clouds
    must, and edges must not lie farther by more than their noise. A calibration in force that has none of these edges in view is of another
    camera, which sees other surfaces; edges must gain then, too. Without any edge the clouds alone decide.

    Args:
        figures: `gain_m`, `gain_std_m`, `edge_gain_px`, `edge_gain_std_px`, `n_common_edges` and, where edges corrected, `bend_deg` of a
            keyframe.
        q: `min_gain_m`.
    """
    edge_noise, edges_tell = SURE * figures["edge_gain_std_px"], np.isfinite(figures["edge_gain_px"])
    if edges_tell and (figures.get("bend_deg", 0.0) != 0 or figures.get("n_common_edges", 1) == 0):
        return {"edges": bool(figures["edge_gain_px"] > edge_noise)}
    clouds = {"clouds": bool(figures["gain_m"] >= max(q.min_gain_m, SURE * figures["gain_std_m"]))}
    return clouds | ({"edges": bool(figures["edge_gain_px"] >= -edge_noise)} if edges_tell else {})


# A gain is one when it is so many of its deviations.
SURE = 2.0
