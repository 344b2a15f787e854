"""Inertial measurements: sampling, preintegration, strapdown propagation, pose at any time."""
