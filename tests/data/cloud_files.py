"""Write files of points byte by byte, as the formats' descriptions state them."""

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lio_jax.data.sequence import LidarScan
from tests.data import bags

_PCD_TYPES = {"f": "F", "u": "U", "i": "I"}
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "u4": "uint", "i4": "int"}


def packed(cloud: np.ndarray) -> np.ndarray:
    """Return a structured array without padding between its fields."""
    names = cloud.dtype.names or ()
    plain = np.zeros(cloud.shape, [(name, cloud.dtype[name]) for name in names])
    for name in names:
        plain[name] = cloud[name]
    return plain


def pcd_bytes(cloud: np.ndarray, data: str = "binary", rows: int = 1) -> bytes:
    """Return a PCD file, https://pointclouds.org/documentation/tutorials/pcd_file_format.html."""
    cloud = packed(cloud)
    names = cloud.dtype.names or ()
    kinds = [cloud.dtype[name] for name in names]
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\n"
        "VERSION 0.7\n"
        f"FIELDS {' '.join(names)}\n"
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}\n"
        f"TYPE {' '.join(_PCD_TYPES[kind.kind] for kind in kinds)}\n"
        f"COUNT {' '.join('1' for _ in names)}\n"
        f"WIDTH {len(cloud) // rows}\nHEIGHT {rows}\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(cloud)}\nDATA {data}\n"
    ).encode()
    if data == "ascii":
        return header + _text(cloud)
    if data == "binary":
        return header + cloud.tobytes()
    # one field after another, then LZF: a control byte n below 32 announces n + 1 literal bytes
    columns = b"".join(np.ascontiguousarray(cloud[name]).tobytes() for name in names)
    parts = (columns[at : at + 32] for at in range(0, len(columns), 32))
    pressed = b"".join(bytes([len(part) - 1]) + part for part in parts)
    return header + struct.pack("<II", len(pressed), len(columns)) + pressed


def ply_bytes(cloud: np.ndarray, form: str = "binary_little_endian", prefix: str = "") -> bytes:
    """Return a PLY file with a face element behind the points; ``prefix`` stands before extra fields."""
    cloud = packed(cloud)
    lines = ["ply", f"format {form} 1.0", "comment made for a test", f"element vertex {len(cloud)}"]
    for name in cloud.dtype.names or ():
        kind = _PLY_TYPES[cloud.dtype[name].str[1:]]
        lines.append(f"property {kind} {name if name in 'xyz' else prefix + name}")
    lines += ["element face 0", "property list uchar int vertex_indices", "end_header"]
    header = ("\n".join(lines) + "\n").encode()
    if form == "ascii":
        return header + _text(cloud)
    order = "<" if form == "binary_little_endian" else ">"
    return header + cloud.astype(cloud.dtype.newbyteorder(order)).tobytes()


def _text(cloud: np.ndarray) -> bytes:
    rows = (" ".join(repr(value.item()) for value in row) for row in cloud)
    return "".join(f"{row}\n" for row in rows).encode()


def write_pcd_folder(path: Path, scans: Iterable[LidarScan]) -> Path:
    """Write one file for each scan with the fields of a Velodyne driver; the stamp is the name, in ns."""
    path.mkdir()
    for scan in scans:
        seen = bags.Sweep(scan.points, scan.time, scan.ring, scan.intensity)
        cloud = bags.fill(bags.VELODYNE, seen, scan.time)
        (path / f"{scan.stamp_ns}.pcd").write_bytes(pcd_bytes(cloud))
    return path
