"""Whether a found pose is to be believed.

Beyond the thesis, whose vote always has a maximum. A pose that is wrong and called `ok` is the worst of all outcomes, so each way to be
fooled has its test: too little to go by, another place that fits as well, a frame that does not lie on the map.
"""

from dataclasses import dataclass
from math import isnan

VERDICTS = {
    "ok": "localized",
    "ambiguous": "another place fits about as well, or too few objects agree on this one",
    "too_few_objects": "too few objects in the frame or landmarks in range to decide",
    "off_map": "the start or the pose is not on the map, or the frame does not lie on it",
    "no_points": "the frame holds no point with finite coordinates",
    "no_ground": "no ground is seen, so there is no vertical",
    "no_start": "neither a position nor a pose before it is known",
}


@dataclass(frozen=True)
class VerdictSettings:
    """Limits of the verdict.

    Attributes:
        min_objects: fewer objects that could be landmarks cannot decide.
        min_inliers: fewer objects that agree are chance.
        min_consensus: least consensus of the vote.
        min_margin: least lead of the best peak of the vote over the next, as a share of it.
        min_fit: least fit of the frame to the map.
        min_agreed_fit: ... at a pose of the vote on which objects agree with `min_agreed_consensus`.
        min_agreed_consensus: see `min_agreed_fit`.
        min_plane_margin: least lead of the best place over the next in the search by points, as a share of it.

    ASSUME: on the city's train and validation streets right poses fit by 0.27 and more where most of what stands in the frame is on the map
    and the map does not end within sight; where a third is, by 0.23, with a consensus of 7.5 and more. On another street, with its lamps
    and trees at the same distances, poses fit by 0.24 and less; those of the vote with a consensus above 6 by 0.21 and less.
    At right poses objects agree with a consensus of 4.0 and a lead of 0.36 and more; where the true pose is beyond the window, by chance,
    with 4.2 and 0.24 at most.
    """

    min_objects: int = 3
    min_inliers: int = 4
    min_consensus: float = 3.0
    min_margin: float = 0.3
    min_fit: float = 0.26
    min_agreed_fit: float = 0.22
    min_agreed_consensus: float = 7.0
    min_plane_margin: float = 0.08


@dataclass
class Evidence:
    """What the verdict goes by.

    Attributes:
        is_on_map: the pose lies on the map.
        n_objects: most pairs of object and landmark that could be true at once.
        n_inliers, consensus, margin: of the vote's peak the pose comes from; the margin is its lead over the next as a share.
        fit: how well the frame's points lie on the surfaces of the map (`Refined.fit`); NaN when points are not used.
        plane_margin: lead over the next place in the search by points, as a share; NaN when the pose comes from the vote.
    """

    is_on_map: bool
    n_objects: int
    n_inliers: int = 0
    consensus: float = 0.0
    margin: float = 0.0
    fit: float = float("nan")
    plane_margin: float = float("nan")


def is_agreed(evidence: Evidence, settings: VerdictSettings = VerdictSettings()) -> bool:
    """Whether the objects alone decide on the pose."""
    e, s = evidence, settings
    enough = e.n_objects >= s.min_objects and e.n_inliers >= s.min_inliers
    return enough and e.consensus >= s.min_consensus and e.margin >= s.min_margin


def judge(evidence: Evidence, settings: VerdictSettings = VerdictSettings()) -> str:
    """A key of VERDICTS."""
    e, s = evidence, settings
    is_clear = isnan(e.plane_margin) and e.consensus >= s.min_agreed_consensus
    min_fit = s.min_agreed_fit if is_clear else s.min_fit
    # Said so that a fit that was not measured refuses nothing.
    if not e.is_on_map or e.fit < min_fit:
        return "off_map"
    if e.plane_margin >= s.min_plane_margin or is_agreed(e, s):
        return "ok"
    return "too_few_objects" if e.n_objects < s.min_objects else "ambiguous"
