"""Insert points into a voxel map, and ask for the planes near other points."""

import jax
import jax.numpy as jnp

from lio_jax import empty_map, insert, query_nearest

# a slope of 1 to 10, sampled at random
x, y = jax.random.uniform(jax.random.key(0), (2, 20_000), minval=-10.0, maxval=10.0)
points = jnp.stack([x, y, 0.1 * x], axis=1)
anchor, size = jnp.zeros(3, jnp.int32), jnp.array(1.0)

held = empty_map(capacity=2**14)
held, insertion = jax.jit(insert)(held, points, jnp.ones(len(points), bool), anchor, size, jnp.array(100.0))
planes = jax.jit(query_nearest)(held, points[:100], anchor, size, min_points=jnp.array(5.0))
print(f"{int(insertion.added.sum())} points in {int((held.centroid[:, 3] > 0).sum())} voxels")
print(f"{int(planes.valid.sum())} of 100 points have a plane; a normal: {planes.normal[0].round(3)}")
