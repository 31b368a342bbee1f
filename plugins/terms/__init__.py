"""The terms of a derivative: one interior term, and one for each kind of boundary.

A term says what it costs (`planned`), and makes film samples (`samples`), of which only the gradient counts. Terms add
up in the order of `TERMS` (`order.py`); each draws its random numbers by a seed of its own (`sampling.py`).
"""
