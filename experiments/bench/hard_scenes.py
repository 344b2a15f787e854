"""Scenes that deceive odometry: what moves, what does not reflect as it should, and what is missing."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from roads import road_scene
from scipy.spatial.transform import Rotation

from lio_jax.data.sequence import ImuData, LidarScan, Sequence
from lio_jax.data.trajectory import Trajectory
from lio_jax.sim.assembly import Traffic, assembled, upright
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.lidar import spinning_lidar
from lio_jax.sim.sequence import SimulatedSequence
from lio_jax.sim.traffic import car_boxes
from lio_jax.sim.worlds import Route, Scene, World

_STEP_S = 0.002


class Changed:
    """A recording whose scans are changed one by one."""

    def __init__(
        self, sequence: SimulatedSequence, change: Callable[[int, LidarScan], LidarScan | None]
    ) -> None:
        """Wrap a recording.

        Args:
            sequence: as it was.
            change: takes the number of a scan and the scan; None leaves the scan out.
        """
        self._sequence, self._change = sequence, change
        self.info, self.warnings_so_far = sequence.info, ()

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield the scans that are left."""
        for number, scan in enumerate(self._sequence.scans(start, count), start):
            changed = self._change(number, scan)
            if changed is not None:
                yield changed

    def imu(self) -> ImuData | None:
        """Return the inertial samples."""
        return self._sequence.imu()

    def gps(self) -> None:
        """Return None."""

    def truth(self) -> Trajectory:
        """Return the truth."""
        return self._sequence.truth()


class Carried(Changed):
    """A sensor at rest in a closed cabin that moves: the scans see the cabin, the IMU feels the motion."""

    def __init__(self, inside: SimulatedSequence, moving: SimulatedSequence) -> None:
        """Wrap two recordings of the same length.

        Args:
            inside: at rest in the cabin.
            moving: as the cabin moves; its scans are not used.
        """
        super().__init__(inside, lambda _, scan: scan)
        self._moving = moving

    def imu(self) -> ImuData | None:
        """Return what is felt."""
        return self._moving.imu()

    def truth(self) -> Trajectory:
        """Return the cabin's motion."""
        return self._moving.truth()


def passing_cars(seed: int) -> Sequence:
    """Return a vehicle that waits in the middle of a road while a dense stream of cars passes on both sides.

    The cars on the left drive at 8 to 10 m/s, those on the right at 9 to 14 m/s.
    """
    rng = np.random.default_rng([seed, 1])
    lanes = [(2.95, np.pi, rng.uniform(8, 10)), (-2.95, 0.0, rng.uniform(9, 14))]
    world = road_scene("street", 0.0, 1.0, seed).world
    return _standing(_with(world, [_stream(left, yaw, speed, rng) for left, yaw, speed in lanes]), seed)


def truck_pulls_away(seed: int) -> Sequence:
    """Return a vehicle that stands beside a truck, which hides half of the view and pulls away after 4 s."""
    time = np.arange(2048) * (60.0 / 2048)
    along = 0.6 * np.clip(time - 4, 0, 10) ** 2 + 12 * np.clip(time - 14, 0, None)
    path = np.column_stack([along + 1.0, np.full(len(time), 2.6), np.zeros(len(time))])
    truck = np.concatenate(
        [
            upright([-8.5, -1.25, 0.9], [5.5, 1.25, 4.0], 0.7),
            upright([6.0, -1.2, 0.4], [8.2, 1.2, 3.6], 0.5),
            upright([-8.0, -1.1, 0.1], [7.5, 1.1, 1.0], 0.15),
        ]
    )
    traffic = Traffic(path[None], np.zeros((1, len(time))), np.array([60.0]), np.zeros(3, np.int64), truck)
    return _standing(_with(road_scene("street", 0.0, 1.0, seed).world, [traffic]), seed)


def eight_beams_at_speed(seed: int) -> Sequence:
    """Return a drive from rest to 15 m/s through a street, with a sensor of 8 beams."""
    scene = road_scene("street", 0.0, 170.0, seed)
    points = np.array([[0.0, 0.0, 0.0], [210.0, 0.0, 0.0]])
    route = Route(points, closed=False, radius=5.0, speed=15.0, dynamics="car")
    return SimulatedSequence(Scene(scene.world, route), duration_s=12.0, seed=seed, beams=8, imu=ImuModel())


def lift(seed: int) -> Sequence:
    """Return a robot at rest in a closed lift, which rises by 14 m after 3 s, at most 1.6 m/s fast.

    The acceleration reaches 1 m/s^2. The sensor looks down by 45 deg and sees the floor.
    """
    return _in_lift(seed, (-45.0, 45.0))


def lift_without_floor(seed: int) -> Sequence:
    """Return the same with a sensor that looks down by 25 deg: it sees the smooth walls alone."""
    return _in_lift(seed, (-25.0, 15.0))


def _in_lift(seed: int, elevation_deg: tuple[float, float]) -> Sequence:
    rng = np.random.default_rng([seed, 4])
    center = np.array([0.1, -0.2, 0.8])
    cabin = np.concatenate(
        [
            upright([-1.0, -1.2, 0.0], [1.0, 1.2, 2.3], rng.uniform(0.3, 0.8)),
            # handrail and panel
            upright([0.9, -1.0, 0.9], [1.0, 1.0, 0.95], 0.8),
            upright([-1.0, 0.7, 0.8], [-0.96, 1.0, 1.6], 0.6),
        ]
    )
    rest = _poses(np.zeros((10101, 3)))
    inside = SimulatedSequence(
        Scene(assembled(center, boxes=cabin), _nowhere()),
        spinning_lidar(32, 1024, elevation_deg=elevation_deg, min_range=0.3),
        duration_s=20.0,
        seed=seed,
        trajectory=rest,
        imu=ImuModel(),
    )
    time = np.arange(10101) * _STEP_S
    height = 1.6 * _twice_summed(_ramp(time, 3.0, 6.2) - _ramp(time, 11.75, 14.95))
    rising = SimulatedSequence(
        Scene(assembled(np.zeros(3)), _nowhere()),
        duration_s=20.0,
        seed=seed,
        trajectory=_poses(height[:, None] * [0.0, 0.0, 1.0]),
        imu=ImuModel(),
    )
    return Carried(inside, rising)


def long_tunnel(seed: int) -> Sequence:
    """Return a drive at 12 m/s through a tunnel whose middle 440 m are smooth."""
    return SimulatedSequence("tunnel", duration_s=50.0, seed=seed, imu=ImuModel())


def glass_hall(seed: int) -> Sequence:
    """Return a walk through a hall with a glass front, glass partitions and a view of trees outside."""
    rng = np.random.default_rng([seed, 6])
    start = np.array([-14.0, 0.0, 1.4])
    pillars = [[x, -2.0 + rng.uniform(-0.2, 0.2), 0.0, 0.25, 4.0, 0.6] for x in range(-14, 16, 7)]
    trees = [[rng.uniform(-30, 30), rng.uniform(8, 25), -0.3, 0.2, 5.0, 0.3] for _ in range(14)]
    boxes = np.concatenate(
        [
            upright([-18.0, -6.3, 0.0], [18.0, -6.0, 4.0], 0.6),
            upright([-18.3, -6.3, 0.0], [-18.0, 3.0, 4.0], 0.5),
            upright([18.0, -6.3, 0.0], [18.3, 3.0, 4.0], 0.5),
            upright([-18.3, -6.3, 4.0], [18.3, 3.3, 4.3], 0.7),
            upright([-18.3, -6.3, -0.3], [18.3, 3.3, 0.0], 0.4),
            *(upright([x, -5.8, 0.0], [x + 1.2, -5.2, 0.9], 0.5) for x in rng.uniform(-16, 15, 5)),
            upright([-40.0, 28.0, -0.3], [40.0, 30.0, 9.0], 0.4),
        ]
    )
    front = [[x, 3.0, 2.0, 1.49, 0.0, 0.0, 0.0, 0.0, 2.0, 0.2, 0.3] for x in np.arange(-16.5, 18, 3.0)]
    across = [[x, -4.0, 2.0, 0.0, 2.0, 0.0, 0.0, 0.0, 2.0, 0.1, 0.3] for x in (-8.0, 0.0, 8.0)]
    world = assembled(
        start,
        planes=[[0, 0, -0.3, 0, 0, 1, 0.3]],
        boxes=boxes,
        cylinders=[*pillars, *trees],
        glass=[*front, *across],
    )
    points = np.array([[0.0, 0.0, 0.0], [28.0, 0.6, 0.05]])
    route = Route(points, closed=False, radius=1.0, speed=1.2, dynamics="handheld")
    return SimulatedSequence(Scene(world, route), duration_s=20.0, seed=seed, imu=ImuModel())


def blocked_quarter(seed: int) -> Sequence:
    """Return a drive through a city where a board behind the sensor hides a quarter of each scan."""
    return Changed(
        SimulatedSequence("city", duration_s=20.0, seed=seed, imu=ImuModel()),
        lambda number, scan: _behind_board(number, scan),
    )


def bend_without_scans(seed: int) -> Sequence:
    """Return a drive at 8 m/s in a bend of 60 m radius, without scans from 9 s to 14 s."""
    time = np.arange(round(20.1 / _STEP_S)) * _STEP_S
    along = _twice_summed(_ramp(time, 1.5, 5.5) * 8.0)
    heading = along / 60.0
    # the chord of an arc
    chord = along * np.sinc(heading / 2 / np.pi)
    places = np.column_stack([chord * np.cos(heading / 2), chord * np.sin(heading / 2), np.zeros(len(time))])
    places[:, 2] = 0.01 * np.sin(2 * np.pi * 1.3 * time) * np.clip(along, 0, 1)
    turned = Rotation.from_rotvec(heading[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    sequence = SimulatedSequence(
        road_scene("street", 1 / 60.0, float(along[-1]), seed),
        duration_s=20.0,
        seed=seed,
        trajectory=_poses(places, turned),
        imu=ImuModel(),
    )
    return Changed(sequence, lambda number, scan: None if 90 <= number < 140 else scan)


def dropped_robot(seed: int) -> Sequence:
    """Return a robot that drives off a ledge of 0.3 m, falls freely and is stopped within 60 ms.

    The shock reaches 7 g. In the fall the robot pitches by 8 deg, and the shock turns it back.
    """
    rng = np.random.default_rng([seed, 9])
    time = np.arange(round(15.1 / _STEP_S)) * _STEP_S
    along = _twice_summed(_ramp(time, 1.5, 2.5) * 1.0)
    falls = time[np.argmax(along > 3.0)]
    landing, shock, g = 0.245, 0.06, 9.80665
    free = np.clip((time - falls) / 0.01, 0, 1) * (time < falls + landing)
    push = np.sin(np.pi * np.clip((time - falls - landing) / shock, 0, 1))
    acceleration = -g * free + push * g * free.sum() / push.sum()
    height = _twice_summed(acceleration)
    until = np.clip((time - falls) / (landing + shock), 0, 1)
    pitch = np.deg2rad(8.0) * np.sin(np.pi * until) ** 2
    places = np.column_stack([along, np.zeros(len(time)), height])
    start = np.array([-8.0, 0.0, 0.9])
    blocks = [
        upright([x, y, 0.0], [x + w, y + 0.8, h], 0.5)
        for x, y, w, h in zip(
            rng.uniform(-9, 9, 8),
            rng.choice([-4.5, 3.5], 8) + rng.uniform(-0.5, 0.5, 8),
            rng.uniform(0.4, 2.0, 8),
            rng.uniform(0.5, 2.2, 8),
            strict=True,
        )
    ]
    world = assembled(
        start,
        boxes=np.concatenate(
            [
                upright([-12.0, -6.0, 0.0], [12.0, 6.0, 3.5], rng.uniform(0.3, 0.8)),
                upright([-12.0, -3.0, 0.0], [-5.3, 3.0, 0.3], 0.5),
                *blocks,
            ]
        ),
        cylinders=[[4.0, 2.2, 0.0, 0.3, 3.5, 0.6], [-2.0, -2.4, 0.0, 0.3, 3.5, 0.6]],
    )
    turned = Rotation.from_rotvec(pitch[:, None] * [0.0, 1.0, 0.0]).as_matrix()
    return SimulatedSequence(
        Scene(world, _nowhere()),
        duration_s=15.0,
        seed=seed,
        trajectory=_poses(places, turned),
        imu=ImuModel(),
    )


HARD_SCENES: dict[str, Callable[[int], Sequence]] = {
    "cars pass": passing_cars,
    "a truck pulls away": truck_pulls_away,
    "8 beams at 15 m/s": eight_beams_at_speed,
    "a lift": lift,
    "a lift, no floor seen": lift_without_floor,
    "a long tunnel": long_tunnel,
    "glass": glass_hall,
    "a quarter blocked": blocked_quarter,
    "5 s without scans": bend_without_scans,
    "a dropped robot": dropped_robot,
    "drone over a field": lambda seed: _world(seed, world="field"),
    "stairs": lambda seed: _world(seed, world="stairs"),
    "8 beams in a street": lambda seed: _world(seed, world="street", beams=8),
    "8 beams in a city": lambda seed: _world(seed, world="city", beams=8),
    "office by hand, 4 rad/s": lambda seed: _world(seed, world="office", swing_rate=4.0),
}
"""Recordings by name and seed."""


def _world(seed: int, **arguments: Any) -> SimulatedSequence:
    return SimulatedSequence(duration_s=20.0, seed=seed, imu=ImuModel(), **arguments)


def _standing(world: World, seed: int) -> SimulatedSequence:
    return SimulatedSequence(
        Scene(world, _nowhere()),
        duration_s=20.0,
        seed=seed,
        trajectory=_poses(np.zeros((10101, 3))),
        imu=ImuModel(),
    )


def _nowhere() -> Route:
    """Return the route of a scene whose motion is given."""
    return Route(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), False, 1.0, 1.0, "car")


def _with(world: World, traffics: list[Traffic]) -> World:
    """Return a road with traffic; its origin is 1.5 m above the ground."""
    steps = max(one.path.shape[1] for one in traffics)
    assert all(one.path.shape[1] == steps for one in traffics)
    shifts = np.cumsum([0, *(len(one.path) for one in traffics)])
    joined = Traffic(
        np.concatenate([one.path for one in traffics]),
        np.concatenate([one.yaw for one in traffics]),
        np.concatenate([one.period for one in traffics]),
        np.concatenate([one.body + shift for one, shift in zip(traffics, shifts[:-1], strict=True)]),
        np.concatenate([one.boxes for one in traffics]),
    )
    return World(world.solids, assembled([0.0, 0.0, 1.5], traffic=joined).movers)


_REACH, _PIECES = 120.0, 60
"""Half of the way of a passing car, beyond which the sensor sees nothing, m, and its pieces."""


def _stream(left: float, yaw: float, speed: float, rng: np.random.Generator) -> Traffic:
    """Return a stream of cars and trucks on a lane; each returns below the ground, out of range."""
    along = np.linspace(-_REACH, _REACH, _PIECES + 1) * np.cos(yaw)
    under = np.full(3, -50.0)
    path = np.column_stack(
        [
            np.concatenate([along, along[[-1, -1, 0]]]),
            np.full(_PIECES + 4, left),
            np.concatenate([np.zeros(_PIECES + 1), under]),
        ]
    )
    gaps = np.cumsum(rng.integers(4, 8, 16))
    starts = gaps[gaps < len(path) - 4]
    paths = np.array([np.roll(path, -start, axis=0) for start in starts])
    period = len(path) * 2 * _REACH / _PIECES / speed
    rows, body = [], []
    for number in range(len(starts)):
        if rng.uniform() < 0.25:
            boxes = upright([-4.0, -1.15, 0.5], [4.0, 1.15, 3.4], rng.uniform(0.3, 0.8))
        else:
            length, height, shade = rng.uniform([3.8, 1.4, 0.1], [4.8, 1.8, 0.9])
            boxes = car_boxes(
                np.zeros((1, 3)), np.zeros(1), np.array([length]), np.array([height]), np.array([shade])
            )
        rows.append(boxes)
        body += [number] * len(boxes)
    return Traffic(
        paths,
        np.full(paths.shape[:2], yaw),
        np.full(len(starts), period),
        np.array(body, np.int64),
        np.concatenate(rows),
    )


def _behind_board(number: int, scan: LidarScan) -> LidarScan:
    """Return a scan whose rays to the rear meet a board 0.7 m behind the sensor."""
    points = np.asarray(scan.points, np.float64)
    hidden = np.abs(points[:, 1]) < -points[:, 0]
    ranges = np.linalg.norm(points, axis=1)
    rays = points / ranges[:, None]
    noise = np.random.default_rng(number).normal(0, 0.02, len(points))
    met = -0.7 / np.where(hidden, rays[:, 0], -1.0) + noise
    nearer = hidden & (met < ranges)
    return replace(scan, points=np.where(nearer[:, None], met[:, None] * rays, points).astype(np.float32))


def _ramp(time: NDArray[np.float64], begin: float, end: float) -> NDArray[np.float64]:
    """Return a smooth acceleration from ``begin`` to ``end`` s that sums up to 1 m/s, m/s^2."""
    share = np.clip((time - begin) / (end - begin), 0, 1)
    return 2 * np.sin(np.pi * share) ** 2 / (end - begin)


def _twice_summed(acceleration: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the way after each step."""
    velocity = np.concatenate([[0.0], np.cumsum(acceleration[1:] + acceleration[:-1]) * _STEP_S / 2])
    return np.concatenate([[0.0], np.cumsum(velocity[1:] + velocity[:-1]) * _STEP_S / 2])


def _poses(places: NDArray[np.float64], rotations: NDArray[np.float64] | None = None) -> Trajectory:
    """Return a motion through positions (n, 3) m at equal steps, in the world's axes if no rotations are
    given."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    if rotations is not None:
        poses[:, :3, :3] = rotations
    return Trajectory(np.round(np.arange(len(places)) * _STEP_S * 1e9).astype(np.int64), poses)
