"""Settings that follow from a recording: voxel sizes, the sensors' rings and columns, and their noise."""

import dataclasses
from collections.abc import Iterable
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.imu_checks import cleaned
from lio_jax.data.sequence import LidarScan, Sequence
from lio_jax.imu.allan import noise_in_motion
from lio_jax.lidar.params import RingConfig
from lio_jax.lidar.range_scatter import scattered_range_noise
from lio_jax.recipes import recipe_named
from lio_jax.run.scan_inputs import padded
from lio_jax.settings.settings import Settings, declared_settings, uses_imu

_NEAR_M, _SHARE = 10.0, 90
"""Surroundings are near if this percentage of the points is within this range, m.

That holds in rooms, corridors and stairs. On open ground the many returns next to a low sensor are not
enough.
"""
_LOOKED_AT = 3
"""Number of first scans; the first of them that has points decides."""
_OWN_BODY_M = 0.3
"""Nearer returns are of whoever carries the sensor."""


def fitted_to_surroundings(sequence: Sequence, settings: Settings) -> tuple[Settings, list[str]]:
    """Return settings with finer voxels if the surroundings are near, and a note on the change.

    Voxels and spacings are changed together: if the user sets one of them, none is changed.
    """
    near = recipe_named(settings.recipe).near_values
    together = {path for path in near if path.endswith(("voxel_size", "spacing"))}
    given = settings.given | (together if settings.given & together else set())
    free = [path for path in near if path not in given]
    if not free:
        return settings, []
    size = settings.values["map"]["voxel_size"]
    reach = _reach(sequence)
    if reach is None or reach >= _NEAR_M:
        return settings, []
    reason = f"surroundings are near ({_SHARE} % of the points within {reach:.1f} m)"
    for path in free:
        settings = settings.with_value(path, near[path], reason)
    chosen = ", ".join(f"{path.removeprefix('params.')} {near[path]:g}" for path in free)
    return settings, [f"{reason}: {chosen} m; for a street's values give params.map.voxel_size={size:g}."]


def _reach(sequence: Sequence) -> float | None:
    """Return the range that contains most points of the first scan with points, m."""
    for scan in sequence.scans(0, _LOOKED_AT):
        ranges = np.linalg.norm(scan.points, axis=1)
        ranges = ranges[np.isfinite(ranges) & (ranges > _OWN_BODY_M)]
        if len(ranges):
            return float(np.percentile(ranges, _SHARE))
    return None


_NOISE = {"params.imu.gyro_noise": "rad/s/sqrt(Hz)", "params.imu.accel_noise": "m/s^2/sqrt(Hz)"}
_MARGIN = 1.5
"""Factor of the noise that is found: errors of scale and alignment act as noise in motion."""
_QUIETEST = 1 / 30
"""Least noise as a share of the recipe's own value: a recording that shows less is not believed."""


def with_inertial_noise(sequence: Sequence, settings: Settings) -> tuple[Settings, list[str]]:
    """Return settings with the inertial sensor's white noise as the recording shows it, and a note on it.

    What was given stays. The recipe's own values are for a sensor of which nothing is known: they stay where
    the recording shows more noise, which is vibration, or where its samples are too few or too slow.
    """
    free = [path for path in _NOISE if path not in settings.given]
    if not recipe_named(settings.recipe).inertial_noise_from_recording or not uses_imu(settings) or not free:
        return settings, []
    recorded = sequence.imu()
    if recorded is None or not len(recorded.stamp_ns):
        return settings, []
    imu = cleaned(recorded, "IMU")[0]
    seconds = np.asarray((imu.stamp_ns - imu.stamp_ns[:1]) * 1e-9, np.float64)
    words = []
    for path in free:
        _, section, name = path.split(".")
        found = noise_in_motion(seconds, imu.gyro if name == "gyro_noise" else imu.accel)
        own = settings.values[section][name]
        if found is not None and _with_margin(found, own) < own:
            value = float(f"{_with_margin(found, own):.3g}")
            settings = settings.with_value(path, value, "the recording's inertial samples")
            words.append(f"{path.removeprefix('params.')} {value:g} {_NOISE[path]}")
    if not words:
        return settings, []
    return settings, [f"noise of the inertial samples, with a margin of {_MARGIN:g}: {', '.join(words)}."]


def _with_margin(noise: float, own: float) -> float:
    """Return a noise with the margin, between a share of the recipe's own value and that value."""
    return min(max(_MARGIN * noise, _QUIETEST * own), own)


def with_given_noise(settings: Settings, gyro_noise: float, accel_noise: float) -> Settings:
    """Return settings with the inertial sensor's white noise as its calibration states it.

    As with noise that a recording shows, a margin is added, and the recipe's own values are bounds. Recipes
    that do not take their noise from the recording keep their own values, and so does what was given.

    Args:
        settings: of a recipe that uses inertial samples.
        gyro_noise: rad/s/sqrt(Hz).
        accel_noise: m/s^2/sqrt(Hz).
    """
    if not recipe_named(settings.recipe).inertial_noise_from_recording:
        return settings
    for path, noise in zip(_NOISE, (gyro_noise, accel_noise), strict=True):
        _, section, name = path.split(".")
        own = settings.values[section][name]
        if path not in settings.given:
            settings = settings.with_value(path, _with_margin(noise, own), "the sensor's calibration")
    return settings


_RANGE = "params.lidar.range_sigma"
_ROUGHNESS_M = 0.025
"""Standard deviation of a surface from the plane of its voxel, m, which neighbouring returns do not show."""
_FEWEST_RESIDUALS = 1000


def with_range_noise(settings: Settings, scans: Iterable[LidarScan]) -> tuple[Settings, list[str]]:
    """Return settings with the noise of the ranges as neighbouring returns show it, and a note on it.

    The noise is found where ranges of a ring scatter about planes; see
    :func:`lio_jax.lidar.range_scatter.range_scatter`. The roughness of surfaces is added, since points are
    matched with planes of voxels. What was given stays, and so does the recipe's own value where the scatter
    is larger, as in foliage, and where rings are unknown.

    Args:
        settings: settings of a run.
        scans: scans of the recording; the first ones with rings decide, mostly the first one alone.
    """
    recipe, lidar = recipe_named(settings.recipe), settings.params().lidar
    if not recipe.range_noise_from_recording or not uses_imu(settings) or _RANGE in settings.given:
        return settings, []
    with_rings = (scan for scan in islice(scans, _SCANS_WITH_RINGS) if (scan.ring >= 0).any())
    # one by one: a recording that breaks off early is read no further than needed
    inputs = (padded(scan, None, settings.config.lidar) for scan in with_rings)
    found = scattered_range_noise(inputs, lidar, _FEWEST_RESIDUALS)
    own = settings.values["lidar"]["range_sigma"]
    if found is None or np.hypot(found, _ROUGHNESS_M) >= own:
        return settings, []
    value = float(f"{np.hypot(found, _ROUGHNESS_M):.3g}")
    settings = settings.with_value(_RANGE, value, "the scatter of neighbouring returns")
    parts = f"noise of the ranges {found:.3g} m, with {_ROUGHNESS_M:g} m of surfaces"
    return settings, [f"{parts}: lidar.range_sigma {value:g} m."]


_LINE_STEP = 0.1
"""Largest median step of azimuth along a ring whose points follow each other, rad."""
_TURNING = 0.8
"""Share of the steps along a ring that have one sign where the beam turns about one axis."""
_FEWEST_POINTS = 20
"""Rings of fewer points do not count."""


def with_point_order(settings: Settings, scans: Iterable[LidarScan]) -> tuple[Settings, list[str]]:
    """Return settings for rings that swing to and fro, as a Livox's lines do, and a note on the change.

    Columns of equal azimuth would tear such rings apart: their points keep the order of the scan instead.

    Args:
        settings: settings of a run; what was given stays.
        scans: scans of the recording; the first one with rings decides.
    """
    features = getattr(settings.config, "features", None)
    by_azimuth = isinstance(features, RingConfig) and features.order == "azimuth"
    if not by_azimuth or "config.features.order" in settings.given:
        return settings, []
    signs = (_signs_along_rings(scan) for scan in islice(scans, _SCANS_WITH_RINGS))
    known = next((sign for sign in signs if sign is not None), None)
    if known is None or known > _TURNING:
        return settings, []
    reason = "rings swing to and fro as a Livox's do"
    settings = settings.with_value("config.features.order", "arrival", reason)
    return settings, [f"{reason}: config.features.order=arrival, their points keep the order of the scan."]


def _signs_along_rings(scan: LidarScan) -> float | None:
    """Return the median over rings of the share of azimuth's steps that have the more frequent sign.

    None where no ring has enough points that follow each other.
    """
    shares = []
    in_order = np.argsort(scan.time, kind="stable")
    azimuth = np.arctan2(scan.points[in_order, 1], scan.points[in_order, 0])
    ring = scan.ring[in_order]
    for number in np.unique(ring[ring >= 0]):
        steps = np.diff(azimuth[ring == number])
        steps = np.remainder(steps + np.pi, 2 * np.pi) - np.pi
        if len(steps) >= _FEWEST_POINTS and np.median(np.abs(steps)) < _LINE_STEP:
            shares.append(max(np.mean(steps > 0), np.mean(steps < 0)))
    return float(np.median(shares)) if shares else None


_SCANS_WITH_RINGS = 10
"""Number of first scans: a single scan may miss the upper beams, and the first one may be incomplete."""
_SLACK = 1.125
"""Factor for scans whose rings are longer than those of the first scans."""
_SURFACE_SHARE = 0.625
"""Share of a scan's points; surface points beyond it are thinned evenly."""
_MOST_SURFACE_POINTS = 49152


def with_sensor_sizes(settings: Settings, scans: Iterable[LidarScan]) -> tuple[Settings, list[str]]:
    """Return settings without a size of 0 in ``config.features``, and a sentence on the chosen sizes.

    Args:
        settings: settings of a run.
        scans: scans of the recording; the largest of the first ones decides.
    """
    features = getattr(settings.config, "features", None)
    if not isinstance(features, RingConfig):
        return settings, []
    open_sizes = [name for name in ("rings", "columns", "surface_points") if getattr(features, name) == 0]
    if not open_sizes:
        return settings, []
    fitting = _fitting(
        list(islice((scan.ring for scan in scans if len(scan.points)), _SCANS_WITH_RINGS)), features
    )
    chosen = dataclasses.replace(features, **{name: getattr(fitting, name) for name in open_sizes})
    section: dict[str, Any] = {"features": chosen}
    config = dataclasses.replace(settings.config, **section)
    words = ", ".join(f"config.features.{name}={getattr(chosen, name)}" for name in open_sizes)
    return dataclasses.replace(settings, config=config), [f"Sizes by the first scans: {words}."]


def ring_count(scans: Iterable[LidarScan]) -> int:
    """Return the number of rings in the first scans that have points; 0 where no point has a ring."""
    rings = islice((scan.ring for scan in scans if len(scan.points)), _SCANS_WITH_RINGS)
    return max((int(ring.max()) + 1 for ring in rings), default=0)


def notes_on_rings(settings: Settings, scans: Iterable[LidarScan]) -> list[str]:
    """Return a sentence for each list with a number per ring that has not as many as the scans have rings.

    Args:
        settings: settings of a run.
        scans: scans of the recording; the first ones are counted where there is such a list.
    """
    declared = declared_settings(settings.recipe)
    paths = [path for path in declared if declared[path].declared.per_ring]
    lengths = {path: len(settings.values[path.split(".")[1]][path.split(".")[2]]) for path in paths}
    if not any(lengths.values()):
        return []
    rings = ring_count(scans)
    return [
        f"{path} has {length} numbers and the first scans have {rings} rings: the numbers are those of rings "
        f"0 to {length - 1}{', the other rings have none' if length < rings else ''}."
        for path, length in lengths.items()
        if length not in (0, rings)
    ]


def _fitting(rings_of_points: list[NDArray[np.int32]], features: RingConfig) -> RingConfig:
    known = [ring[ring >= 0] for ring in rings_of_points if (ring >= 0).any()]
    if not known:
        return RingConfig()
    most = max(int(ring.max()) for ring in known) + 1
    counts = np.max([np.bincount(ring, minlength=most) for ring in known], axis=0)
    rings = features.rings or _rounded_up(len(counts), 8)
    longest = int(_SLACK * counts[:rings].max())
    return RingConfig(
        rings=rings,
        columns=max(_rounded_up(longest, 64), 4 * features.neighbours),
        surface_points=min(_rounded_up(int(_SURFACE_SHARE * counts.sum()), 2048), _MOST_SURFACE_POINTS),
    )


def _rounded_up(value: int, step: int) -> int:
    return -(-max(value, 1) // step) * step
