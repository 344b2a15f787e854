"""Gradients of whole recordings, objectives, and parameters tuned by them."""
