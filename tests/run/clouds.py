"""Read what the package only writes."""

import numpy as np


def read_ply(path):
    """Return the (n, 3) points of a binary PLY, by the format's own description."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    magic, form, element, *properties = head.decode("ascii").splitlines()
    assert (magic, form) == ("ply", "format binary_little_endian 1.0")
    assert properties == ["property float x", "property float y", "property float z"]
    kind, name, count = element.split()
    assert (kind, name) == ("element", "vertex")
    assert len(body) == 12 * int(count)
    return np.frombuffer(body, "<f4").reshape(-1, 3)
