"""Rotation matrices in few array operations.

Every array operation of a program becomes a kernel that is compiled for itself, whatever its size: nine
expressions on scalars take longer to compile than one on a matrix. And they are jitted within the program,
because what is called so often takes long to trace.
"""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

_ENTRY = np.array([[0, 2, 1], [2, 0, 0], [1, 0, 0]], np.int32)
_SIGN = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]], np.int32)


def skew(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Return the matrix whose product with w is ``vector`` x w."""
    return jnp.take(vector, _ENTRY, axis=-1, mode="clip") * _SIGN


@jax.jit
def rotation_matrix(rotation: jaxlie.SO3) -> Float[Array, "*b 3 3"]:
    """Return the matrix of a quaternion (w, v), whatever its length.

    ``R = (2 w^2 / n - 1) I + 2 / n (v v' + w V)`` with V the cross product with v and n = w^2 + v'v.
    """
    wxyz = rotation.wxyz
    twice = (2 / jnp.sum(wxyz**2, -1))[..., None, None]
    w, v = wxyz[..., :1, None], wxyz[..., 1:]
    return (twice * w**2 - 1) * np.eye(3, dtype=wxyz.dtype) + twice * (
        v[..., :, None] * v[..., None, :] + w * skew(v)
    )
