"""A simulated street that shares no geometry with ``lio_jax.sim``: triangle meshes, a ray caster, splines.

The package's own simulator intersects analytic solids in JAX. Here trimesh holds the world as triangles,
Embree finds the triangle that a ray meets, and scipy's splines give pose, angular rate and specific force.
"""
