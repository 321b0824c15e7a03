"""Traffic: vehicles, riders and walkers that follow one another along lanes, stop at red lights and at stops.

Lanes are lines; along each the followers keep the Intelligent Driver Model (Treiber, Hennecke and Helbing, 2000), the
leader's place being taken by the stop line while the light is red, or by the stop while passengers get on. So nobody
runs into the one ahead, queues form and dissolve, and one tram can be standing when the scanner meets its head and
moving when it meets its tail.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from streetscan.simulation import shapes, terrain
from streetscan.simulation.meshes import transform, with_instances
from streetscan.simulation.scene import Actor

_STEP_S = 0.1
_WARM_UP_S = 30.0
# Half lengths of those who walk and ride, strides, prams and dogs included.
_HALF_LENGTHS_M = {
    "person_walking": 0.75,
    "person_coat": 0.55,
    "person_backpack": 0.65,
    "person_child": 0.5,
    "person_umbrella": 0.7,
    "person_with_pram": 0.95,
    "person_with_dog": 1.45,
    "cyclist": 0.95,
    "scooter_rider": 0.6,
}
_SAMPLE_EVERY = 2  # of the simulated steps, one in so many becomes a sample of the path


@dataclass(frozen=True)
class Signal:
    """A traffic light with a fixed cycle: green from `phase_s` for `green_s` of every `cycle_s`."""

    cycle_s: float
    green_s: float
    phase_s: float

    def is_red(self, time_s: float) -> bool:
        """Whether one must stop at a time."""
        return (time_s - self.phase_s) % self.cycle_s >= self.green_s


@dataclass
class Lane:
    """One line of traffic.

    Attributes:
        place: maps distances along the lane (n,) to street coordinates s (n,), t (n,) and the heading relative to the axis.
        start_m, end_m: the stretch that has to be filled with traffic.
        names: base shapes that use it, with their shares.
        speed_mps: (least, most) desired speed.
        spacing_m: mean distance from one front to the next beyond the objects' own lengths.
        lights: (distance, signal) of stop lines.
        stop_m: where buses and trams stop, or None.
        height_m: of the lane's surface above the terrain.
        sideways_m: 1 sigma of a constant offset to the side.
        gap_m: least distance kept to the one ahead.
    """

    place: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
    start_m: float
    end_m: float
    names: dict[str, float]
    speed_mps: tuple[float, float]
    spacing_m: float
    lights: tuple[tuple[float, Signal], ...] = ()
    stop_m: float | None = None
    height_m: float = 0.0
    sideways_m: float = 0.0
    gap_m: float = 1.8


def follow(
    lengths_m: np.ndarray,
    fronts_m: np.ndarray,
    speeds_mps: np.ndarray,
    times_s: np.ndarray,
    lights: tuple[tuple[float, Signal], ...] = (),
    stop_m: float | None = None,
    dwells_s: np.ndarray | None = None,
    gap_m: float = 1.8,
) -> np.ndarray:
    """Fronts of a line of followers over time.

    Args:
        lengths_m: (n,) of the followers, the first one leading.
        fronts_m: (n,) where their fronts are at times_s[0], decreasing.
        speeds_mps: (n,) desired speeds.
        times_s: (K,) equally spaced.
        lights: stop lines and their signals.
        stop_m: where those with a positive entry in dwells_s (n,) stop for that long.
        gap_m: distance kept when standing.
    Returns:
        (K, n) fronts. No two overlap; nobody moves backwards.
    Source: Treiber, Hennecke, Helbing (2000), Congested traffic states in empirical observations, Eqs. 3-4.
    """
    n = len(lengths_m)
    x, v = np.array(fronts_m, float), np.array(speeds_mps, float)
    dwells = np.zeros(n) if dwells_s is None else np.array(dwells_s, float)
    desired = np.array(speeds_mps, float)
    # A walker reacts faster and accelerates less than a vehicle; both scale with the speed.
    reach_s, accelerate, brake = 1.0, np.minimum(1.6, 0.5 + 0.2 * desired), 2.2
    result = np.empty((len(times_s), n))
    result[0] = x
    for k in range(1, len(times_s)):
        dt = times_s[k] - times_s[k - 1]
        gap = np.full(n, 1e6)
        leader = np.array(desired)
        gap[1:] = x[:-1] - lengths_m[:-1] - x[1:]
        leader[1:] = v[:-1]
        for line, signal in lights:
            if signal.is_red(times_s[k]):
                distance = line - x
                # Who is past the line, or too near to stop at 4 m/s², drives on.
                must = (distance > 0) & (distance >= v**2 / 8) & (distance + gap_m < gap)
                gap[must], leader[must] = distance[must] + 0.5 * gap_m, 0.0
        if stop_m is not None:
            distance = stop_m - x
            must = (dwells > 0) & (distance > -1.0) & (distance + 1.0 >= v**2 / 8) & (distance + gap_m < gap)
            gap[must], leader[must] = np.maximum(distance[must], 0) + gap_m, 0.0
            waiting = (dwells > 0) & (np.abs(distance) < 1.5) & (v < 0.3)
            dwells[waiting] -= dt
        wished = gap_m + np.maximum(0, v * reach_s + v * (v - leader) / (2 * np.sqrt(accelerate * brake)))
        force = accelerate * (1 - (v / desired) ** 4 - (wished / np.maximum(gap, 0.1)) ** 2)
        v = np.clip(v + dt * np.maximum(force, -6.0), 0, None)
        # The last resort: never closer than 0.3 m.
        step = np.minimum(v * dt, np.maximum(0, gap - 0.3))
        v = np.where(step < v * dt, step / dt, v)
        x = x + step
        result[k] = x
    return result


def half_length_m(name: str) -> float:
    """Upper bound of how far a base shape that takes part in traffic reaches before and behind its origin."""
    return _HALF_LENGTHS_M.get(name) or shapes.HALF_SIZES_M[name][0]


def lane_actors(
    lane: Lane,
    axis: terrain.Axis,
    split: str,
    time_span_s: tuple[float, float],
    window_m: tuple[float, float],
    rng: np.random.Generator,
    first_instance: int,
) -> list[Actor]:
    """Everybody who is on a lane, within `window_m` along it, at any moment of the time span.

    Args:
        lane: the lane.
        axis: of the street.
        split: whose designs are drawn.
        time_span_s: seconds; before and after, an actor stands where it was at the span's ends.
        window_m: stretch of the lane; who never enters it is left out.
        rng: draws the traffic.
        first_instance: of the actors' ids, four to each.
    """
    start, end = time_span_s[0] - _WARM_UP_S, time_span_s[1]
    times = np.arange(start, end + _STEP_S, _STEP_S)
    names, shares = list(lane.names), np.array(list(lane.names.values()))
    fastest = lane.speed_mps[1]
    drawn, fronts = [], []
    front = lane.end_m + 20.0
    # Enough followers that the last ones only reach the start of the lane when the time is over.
    while front > lane.start_m - fastest * (times[-1] - times[0]):
        drawn.append(names[rng.choice(len(names), p=shares / shares.sum())])
        fronts.append(front)
        front -= 2 * half_length_m(drawn[-1]) + 0.6 * lane.gap_m + rng.exponential(lane.spacing_m)
    halves = np.array([half_length_m(name) for name in drawn])
    seeds = rng.integers(2**62, size=len(drawn))
    lengths, fronts = 2 * halves, np.array(fronts)
    speeds = rng.uniform(*lane.speed_mps, len(lengths))
    is_transit = np.array([name in shapes.BUSES + shapes.TRAMS for name in drawn])
    # Half of them stop.
    dwells = np.where(is_transit & (rng.random(len(lengths)) < 0.5), rng.uniform(5, 12, len(lengths)), 0.0)
    dwells[fronts > (lane.stop_m or np.inf)] = 0.0
    paths = follow(lengths, fronts, speeds, times, lane.lights, lane.stop_m, dwells, lane.gap_m)

    keep = np.flatnonzero(times >= time_span_s[0] - 1e-9)[::_SAMPLE_EVERY]
    keep = np.unique(np.append(keep, len(times) - 1))
    actors = []
    for i, name in enumerate(drawn):
        middle = paths[keep, i] - halves[i]
        inside = (middle > window_m[0]) & (middle < window_m[1])
        if not inside.any():
            continue
        own = np.random.default_rng(seeds[i])
        mesh = shapes.make_object(name, shapes.draw_design(split, own), own)
        s, t, turn = lane.place(middle)
        # Off the lane's line by a constant, to its left.
        offset = np.clip(own.normal(0, lane.sideways_m), -2 * lane.sideways_m, 2 * lane.sideways_m)
        s, t = s - offset * np.sin(turn), t + offset * np.cos(turn)
        slopes = np.array([axis.slope_at(s[j], t[j], float(turn[j])) for j in np.flatnonzero(inside)[:: max(1, inside.sum() // 8)]])
        body, _ = with_instances(transform(mesh, slope=tuple(slopes.mean(0))), first_instance + 4 * i)
        actors.append(Actor(body, times[keep], axis.to_map(s, t, lane.height_m), np.unwrap(axis.yaw_at(s) + turn)))
    return actors


def crossing_walkers(
    axis: terrain.Axis,
    s: float,
    signal: Signal,
    n: int,
    split: str,
    time_span_s: tuple[float, float],
    rng: np.random.Generator,
    first_instance: int,
) -> list[Actor]:
    """People who wait at the kerb of the zebra crossing at s, cross while the street's light is red, and stand again.

    Args:
        signal: the street's light; it is red for `cycle_s - green_s`, of which the last 3 s are too short to start.
    """
    kerb = terrain.KERB_M
    starts = np.arange(np.floor(time_span_s[0] / signal.cycle_s), np.ceil(time_span_s[1] / signal.cycle_s) + 1) * signal.cycle_s
    starts = starts + signal.phase_s + signal.green_s + 3.0
    starts = starts[(starts > time_span_s[0]) & (starts < time_span_s[1] + 5)]
    actors = []
    for i in range(n):
        # No prams and dogs: files are half a metre wide.
        name = shapes.WALKERS[rng.integers(5)]
        mesh = shapes.make_object(name, shapes.draw_design(split, rng), np.random.default_rng(int(rng.integers(2**62))))
        side, speed = rng.choice([-1, 1]), rng.uniform(1.2, 1.7)
        # One file for each, so that nobody walks through another; both ends lie between kerb and walkers' corridor.
        line = s - 1.3 + 2.6 * (i + 0.5) / n
        from_t, to_t = side * (kerb + rng.uniform(0.5, 1.5)), -side * (kerb + rng.uniform(0.5, 1.5))
        start = (starts[rng.integers(len(starts))] if len(starts) else time_span_s[1] + 10) + rng.uniform(0, 2)
        walk = np.linspace(from_t, to_t, 24)
        times = start + np.abs(walk - from_t) / speed
        yaw = float(axis.yaw_at(line)) + (np.pi / 2 if to_t > from_t else -np.pi / 2)
        height = np.where(np.abs(walk) > kerb, terrain.KERB_HEIGHT_M, 0.0)
        body, _ = with_instances(mesh, first_instance + 4 * i)
        actors.append(Actor(body, times, axis.to_map(np.full(24, line), walk, height), np.full(24, yaw)))
    return actors
