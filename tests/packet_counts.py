"""Returns of Velodyne packets counted from their bytes, and what Nebula's driver leaves of them with the settings of its own tests.

Nebula's truth is one cloud per VelodyneScan message. It leaves out returns nearer or farther than its ranges, those between its
largest and its smallest azimuth (359 to 360 degrees: 0.3 %), and second returns equal to the first; the returns at the end of a
message that lie beyond its seam go to the next cloud.
"""

from dataclasses import dataclass

import numpy as np
import velodyne_decoder as vd
import yaml

_BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("returns", [("range", "<u2"), ("intensity", "u1")], 32)])
_DUAL = 57  # return mode in the packet's last but one byte


@dataclass(frozen=True)
class Driver:
    """Settings of Nebula's test of a sensor; azimuths in degrees, clockwise from forward."""

    unit_m: float
    min_range_m: float
    max_range_m: float
    first_deg: float
    last_deg: float


DRIVERS = {
    "vlp16": Driver(0.002, 0.3, 300, 0, 359),
    "vlp32c": Driver(0.004, 0.4, 50, 270, 90),
    "vls128": Driver(0.004, 0.3, 300, 0, 359),
}


def count_all(packet: np.ndarray) -> int:
    """Returns with a range, a second return equal to the first left out."""
    return int(_has_return(packet)[0].sum())


def kept_azimuths_deg(packet: np.ndarray, model: str) -> np.ndarray:
    """Azimuths of the returns Nebula keeps, in the order of the packet."""
    driver = DRIVERS[model]
    is_kept, blocks = _has_return(packet)
    ranges_m = blocks["returns"]["range"] * driver.unit_m
    is_kept &= (ranges_m > driver.min_range_m) & (ranges_m < driver.max_range_m)
    azimuths_deg = blocks["azimuth"].astype(int) / 100
    is_kept &= _is_within(azimuths_deg, driver)[:, None]
    returns_deg = np.broadcast_to(azimuths_deg[:, None], (12, 32))
    if model != "vlp32c":  # the driver of this one looks at the azimuths of blocks alone
        returns_deg = np.round(returns_deg + _turned_deg(azimuths_deg, model, packet[1204] == _DUAL), 2) % 360
        is_kept &= _is_within(returns_deg, driver)
    return returns_deg[is_kept]


def nebula_count(messages: list[list[np.ndarray]], index: int, model: str) -> int:
    """Points of Nebula's cloud of a message; the message before gives what lay beyond its seam."""
    n = sum(len(kept_azimuths_deg(p, model)) for p in messages[index]) - _n_beyond_seam(messages[index], model)
    return n + (_n_beyond_seam(messages[index - 1], model) if index else 0)


def _has_return(packet: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    blocks = np.frombuffer(packet[:1200].tobytes(), _BLOCK)
    ranges = blocks["returns"]["range"]
    has_return = ranges > 0
    if packet[1204] == _DUAL:
        has_return[1::2] &= ranges[1::2] != ranges[0::2]
    return has_return, blocks


def _is_within(azimuths_deg: np.ndarray, driver: Driver) -> np.ndarray:
    if driver.first_deg < driver.last_deg:
        return (azimuths_deg >= driver.first_deg) & (azimuths_deg <= driver.last_deg)
    return (azimuths_deg >= driver.first_deg) | (azimuths_deg <= driver.last_deg)


def _turned_deg(azimuths_deg: np.ndarray, model: str, is_dual: bool) -> np.ndarray:
    """What to add to a block's azimuth for each return (12, 32): the turn within the block, and the beam's own angle."""
    step = 1 + int(is_dual)
    turns_deg = np.zeros(12)
    turns_deg[:-step] = (azimuths_deg[step:] - azimuths_deg[:-step]) % 360
    # The driver predicts the turn of the last blocks from the one before; of one of them it takes 0.
    turns_deg[-step:] = turns_deg[-step - 1]
    turns_deg[11 - (step - 1 if model == "vlp16" else 4 * (step - 1))] = 0
    firing = np.arange(32)
    if model == "vlp16":
        return turns_deg[:, None] * (firing % 16 * 2.304 + firing // 16 * 55.296) / 110.592
    laser = firing + 32 * (np.arange(12) % 4)[:, None]
    group = laser // 8
    lasers = yaml.safe_load(vd.get_bundled_calibration("Alpha Prime.yml").to_string())["lasers"]
    own_deg = np.degrees([beam["rot_correction"] for beam in sorted(lasers, key=lambda beam: beam["laser_id"])])
    return turns_deg[:, None] * (group + group // 8) * 2.665 / 53.3 - own_deg[laser]


def _n_beyond_seam(packets: list[np.ndarray], model: str) -> int:
    """Returns at the very end of a message that lie within a quarter turn past azimuth 0."""
    if DRIVERS[model].first_deg:
        return 0
    is_past = kept_azimuths_deg(packets[-1], model) < 90
    return int(np.cumprod(is_past[::-1]).sum())
