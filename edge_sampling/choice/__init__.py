"""Choosing an edge, and a point on it, as a viewer sees them."""
