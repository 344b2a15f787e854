"""What each recipe needs from a recording, and what the recording lacks."""

from lio_jax.inspection.inertial import InertialSummary
from lio_jax.inspection.scans import ScanSummary
from lio_jax.recipes import RECIPES

_FEW_RINGS = 4


def missing(scans: ScanSummary, imu: InertialSummary | None, calibrated: bool) -> dict[str, list[str]]:
    """Return, for each recipe, one sentence for each thing that the recording lacks."""
    times = not scans.time_spreads or max(scans.time_spreads) == 0.0
    without_times = (
        ["point times: the motion within a sweep is not compensated"] if times and scans.sweep else []
    )
    inertial = []
    if imu is None:
        inertial.append("inertial samples: the motion is predicted by constant velocity")
    elif not calibrated:
        inertial.append("T_imu_lidar: taken as identity until params.extrinsics.* are given")
    rings = [] if len(scans.rings) >= _FEW_RINGS else ["rings: features are found along them"]
    wants = {
        "default": [*inertial, *without_times],
        "fast_lio2": [*inertial, *without_times],
        "lio_sam": [
            *(["inertial samples: it does not run without"] if imu is None else inertial),
            *rings,
            *without_times,
        ],
        "loam": [*rings, *without_times],
    }
    nothing = [] if any(scans.counts) else ["scans with points"]
    return {recipe: nothing + wants.get(recipe, [*inertial, *without_times]) for recipe in RECIPES}
