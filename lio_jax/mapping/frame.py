"""World axes from a corner of the map's grid near the sensor: where float32 is precise."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int32

from lio_jax.core.geometry import rotation_matrix


class Frame(eqx.Module):
    """World axes from a corner of the map's grid near the sensor."""

    anchor: Int32[Array, "3"]
    """The voxel whose lower corner is the origin."""
    origin: Float[Array, "3"]
    """That corner, m in world."""

    def place(
        self, points: Float[Array, "k 3"], T_world_lidar: jaxlie.SE3
    ) -> tuple[Float[Array, "k 3"], Float[Array, "k 3"]]:
        """Return points of the lidar frame in world axes, from the sensor and from the origin, m."""
        R, shift = self.placing(T_world_lidar, points.dtype)
        # column by column: on a CPU XLA computes the product of many points in a kernel of its own, which
        # takes longer than these sums in the kernel that uses them
        x, y, z = (points[:, axis] for axis in range(3))
        arm = [R[axis, 0] * x + R[axis, 1] * y + R[axis, 2] * z for axis in range(3)]
        placed = [column + shift[axis] for axis, column in enumerate(arm)]
        return jnp.stack(arm, -1), jnp.stack(placed, -1)

    def placing(
        self, T_world_lidar: jaxlie.SE3, dtype: jnp.dtype
    ) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """Return the turn into world axes, and the way from the sensor to the origin, m."""
        R = rotation_matrix(T_world_lidar.rotation())
        return R.astype(dtype), (T_world_lidar.translation() - self.origin).astype(dtype)
