"""The shapes of a world: each class holds many shapes of one kind in one pytree of arrays."""

import equinox as eqx
from jaxtyping import Array, Float


class Planes(eqx.Module):
    """Planes without boundary."""

    point: Float[Array, "n 3"]
    """Any point of the plane, world frame, m."""
    normal: Float[Array, "n 3"]
    """Unit normal, world frame."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "Planes":
        """Return the planes displaced by ``by`` (m)."""
        return Planes(self.point + by, self.normal, self.reflectivity)


class Grounds(eqx.Module):
    """Height fields without boundary: z = height + sum of amplitude sin(wave . (x, y) + phase)."""

    height: Float[Array, " n"]
    """Mean height, m."""
    amplitude: Float[Array, "n waves"]
    """Amplitude of each wave, positive, m."""
    wave: Float[Array, "n waves 2"]
    """Wave vectors, rad/m."""
    phase: Float[Array, "n waves"]
    """Phase of each wave at the origin, rad."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "Grounds":
        """Return the height fields displaced by ``by`` (m)."""
        phase = self.phase - self.wave[..., 0] * by[0] - self.wave[..., 1] * by[1]
        return Grounds(self.height + by[2], self.amplitude, self.wave, phase, self.reflectivity)


class Boxes(eqx.Module):
    """Upright boxes, turned about the vertical."""

    center: Float[Array, "n 3"]
    """Centre of each box, world frame, m."""
    half_size: Float[Array, "n 3"]
    """Half the edge lengths along the box's own axes, m."""
    yaw: Float[Array, " n"]
    """Rotation world from box about +z, rad."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "Boxes":
        """Return the boxes displaced by ``by`` (m)."""
        return Boxes(self.center + by, self.half_size, self.yaw, self.reflectivity)


class TiltedBoxes(eqx.Module):
    """Boxes in any attitude."""

    center: Float[Array, "n 3"]
    """Centre of each box, world frame, m."""
    half_size: Float[Array, "n 3"]
    """Half the edge lengths along the box's own axes, m."""
    rotation: Float[Array, "n 3 3"]
    """Rotation matrix world from box."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "TiltedBoxes":
        """Return the boxes displaced by ``by`` (m)."""
        return TiltedBoxes(self.center + by, self.half_size, self.rotation, self.reflectivity)


class Cylinders(eqx.Module):
    """Upright solid cylinders."""

    base: Float[Array, "n 3"]
    """Centre of the lower cap, world frame, m."""
    radius: Float[Array, " n"]
    """Radius of each cylinder, m."""
    height: Float[Array, " n"]
    """Height of each cylinder, m."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "Cylinders":
        """Return the cylinders displaced by ``by`` (m)."""
        return Cylinders(self.base + by, self.radius, self.height, self.reflectivity)


class Spheres(eqx.Module):
    """Balls, for example the crowns of trees."""

    center: Float[Array, "n 3"]
    """Centre of each ball, world frame, m."""
    radius: Float[Array, " n"]
    """Radius of each ball, m."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "Spheres":
        """Return the balls displaced by ``by`` (m)."""
        return Spheres(self.center + by, self.radius, self.reflectivity)


class Panes(eqx.Module):
    """Rectangular panes of glass."""

    center: Float[Array, "n 3"]
    """Centre of each pane, world frame, m."""
    along: Float[Array, "n 3"]
    """Half of one edge, world frame, m."""
    up: Float[Array, "n 3"]
    """Half of the other edge, perpendicular to the first, world frame, m."""
    mirror: Float[Array, " n"]
    """Share of the light that is mirrored head-on, 0 to 1; 0.08 for a plain pane, with its two faces."""
    missing: Float[Array, " n"]
    """Share of the rays that pass the pane and never come back, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "Panes":
        """Return the panes displaced by ``by`` (m)."""
        return Panes(self.center + by, self.along, self.up, self.mirror, self.missing)
