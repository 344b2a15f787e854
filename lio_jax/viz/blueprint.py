"""How a recording looks at first sight: the world large, and beside it what tells whether to trust it."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import rerun.blueprint as rrb

RAW, ADDED = "world/lidar/raw", "world/added"
"""Entities that are there to be turned on: they lie over the compensated scan and over the map."""
PLOTS = {
    "match": "metrics/match",
    "state": "metrics/state",
    "times": "metrics/times",
}
"""Views of scalars by name."""


def default_blueprint() -> "rrb.Blueprint":
    """Return the layout of a run."""
    import rerun.blueprint as rrb

    hidden = rrb.EntityBehavior(visible=False)
    world = rrb.Spatial3DView(origin="world", name="world", overrides={RAW: hidden, ADDED: hidden})
    plots = [
        rrb.TimeSeriesView(origin=f"{origin}/{group}", name=title)
        for origin, group, title in (
            (PLOTS["match"], "residual_m", "residual [m]"),
            (PLOTS["match"], "points", "points matched"),
            (PLOTS["match"], "nis", "NIS"),
            (PLOTS["state"], "gyro_bias", "gyroscope bias and sigma [rad/s]"),
            (PLOTS["state"], "accel_bias", "accelerometer bias and sigma [m/s^2]"),
            (PLOTS["times"], "", "times [ms]"),
        )
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            world,
            rrb.Tabs(
                rrb.Vertical(*plots[:3], name="match"),
                rrb.Vertical(*plots[3:5], name="biases"),
                rrb.Vertical(plots[5], name="times"),
            ),
            column_shares=[3, 1],
        ),
        rrb.TimePanel(timeline="scan", state="collapsed"),
        collapse_panels=True,
    )
