"""Poses of any odometry, inertial samples and GPS fixes in one smoother of the whole recording."""
