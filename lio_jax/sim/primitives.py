"""The shapes a world is made of, many of a kind in one pytree of arrays."""

import equinox as eqx
from jaxtyping import Array, Float


class Planes(eqx.Module):
    """Infinite planes."""

    point: Float[Array, "n 3"]
    """Any point of the plane, m."""
    normal: Float[Array, "n 3"]
    """Unit normal."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "Planes":
        """Return them displaced."""
        return Planes(self.point + by, self.normal, self.reflectivity)


class Grounds(eqx.Module):
    """Height fields without end: z = height + sum of amplitude sin(wave . (x, y) + phase)."""

    height: Float[Array, " n"]
    """Mean, m."""
    amplitude: Float[Array, "n waves"]
    """Positive, m."""
    wave: Float[Array, "n waves 2"]
    """Wave vectors, rad/m."""
    phase: Float[Array, "n waves"]
    """rad."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "Grounds":
        """Return them displaced."""
        phase = self.phase - self.wave[..., 0] * by[0] - self.wave[..., 1] * by[1]
        return Grounds(self.height + by[2], self.amplitude, self.wave, phase, self.reflectivity)


class Boxes(eqx.Module):
    """Upright boxes, turned about the vertical."""

    center: Float[Array, "n 3"]
    """m."""
    half_size: Float[Array, "n 3"]
    """Half the edge lengths along the box's own axes, m."""
    yaw: Float[Array, " n"]
    """Rotation world from box about +z, rad."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "Boxes":
        """Return them displaced."""
        return Boxes(self.center + by, self.half_size, self.yaw, self.reflectivity)


class TiltedBoxes(eqx.Module):
    """Boxes in any attitude."""

    center: Float[Array, "n 3"]
    """m."""
    half_size: Float[Array, "n 3"]
    """Half the edge lengths along the box's own axes, m."""
    rotation: Float[Array, "n 3 3"]
    """Rotation matrix world from box."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "TiltedBoxes":
        """Return them displaced."""
        return TiltedBoxes(self.center + by, self.half_size, self.rotation, self.reflectivity)


class Cylinders(eqx.Module):
    """Upright solid cylinders."""

    base: Float[Array, "n 3"]
    """Centre of the lower cap, m."""
    radius: Float[Array, " n"]
    """m."""
    height: Float[Array, " n"]
    """m."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "Cylinders":
        """Return them displaced."""
        return Cylinders(self.base + by, self.radius, self.height, self.reflectivity)


class Spheres(eqx.Module):
    """Balls, such as the crowns of trees."""

    center: Float[Array, "n 3"]
    """m."""
    radius: Float[Array, " n"]
    """m."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def moved(self, by: Float[Array, "3"]) -> "Spheres":
        """Return them displaced."""
        return Spheres(self.center + by, self.radius, self.reflectivity)
