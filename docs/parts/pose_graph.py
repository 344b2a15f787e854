"""Close a loop in a pose graph, and differentiate its solution by the weight of the loop."""

import jax
import jax.numpy as jnp
import jaxlie

from lio_jax import PoseGraph, solved_poses

jax.config.update("jax_enable_x64", True)

# a square of four sides of 10 m, whose corners are measured 0.02 rad too large; the last edge closes it
corner = jaxlie.SO3.from_z_radians(jnp.pi / 2 + 0.02)
sides = [jaxlie.SE3.from_rotation_and_translation(corner, jnp.array([10.0, 0, 0]))] * 4
poses = [jaxlie.SE3.identity()]
for side in sides:
    poses.append(poses[-1] @ side)
stacked = jax.tree.map(lambda *rows: jnp.stack(rows), *poses)
measured = jax.tree.map(lambda *rows: jnp.stack(rows), *sides, jaxlie.SE3.identity())


def end(loop_weight):
    """Return the last position, m, with 4 edges of odometry (kind 0) and one loop (kind 1)."""
    information = jnp.eye(6) * 100.0 * jnp.array([1.0, 1, 1, 1, loop_weight])[:, None, None]
    kind, fixed = jnp.array([0, 0, 0, 0, 1]), jnp.arange(5) == 0
    i, j = jnp.array([0, 1, 2, 3, 0]), jnp.array([1, 2, 3, 4, 4])
    return solved_poses(PoseGraph(stacked, i, j, measured, information, kind, fixed)).translation()[-1]


print(f"last position: {poses[-1].translation().round(4)} m by odometry, {end(0.1).round(4)} m with the loop")
print(f"derivative by the loop's weight: {jax.jacobian(end)(0.1).round(4)} m")
