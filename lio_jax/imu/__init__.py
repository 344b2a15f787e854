"""Inertial measurements: sampling, preintegration, propagation, poses at any time, and the first state."""
