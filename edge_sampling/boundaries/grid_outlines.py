"""Outlines of grids of signed distances on the film, and creases between their voxels.

Triangles tell only about where these are (`geometry/grids.py`). So they are looked for on the film, by bisection. A
second place, a little farther along, tells their tangent: that of the triangles is off by as much as the voxels are
coarse, and with it the part of a velocity that counts, which is the one across the outline.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from .film_outlines import Chosen, FilmOutlines, Found, Placed

#: How often the distance is halved in which the outline of a grid is known to be; and what is left of it where both
#: sides are looked at.
HALVINGS, REST = 8, 1 / 64

#: How far along the visible part of a curve in a triangle the second place is. (A whole number of 1/4096: see
#: `Horizons.point`.)
ALONG = 1 / 16

#: Gives rays at film positions, and the surfaces that they meet.
Look = Callable[[Any, Any], tuple[Any, Any]]  # (needs no variant to be set)


def on_grids(
    outlines: FilmOutlines,
    at: Placed,
    look: Look,
    chosen: Chosen,
    found: Found,
    u: mi.Point2f,
    p: mi.Point3f,
    n_dl: mi.Vector2f,
    reach: mi.Float,
    active: mi.Bool,
) -> tuple[mi.Point2f, mi.Float | float, mi.Vector2f, mi.Vector2f, mi.Bool]:
    """Points of the film boundary, with those of grids moved to where the outline, or the crease, is.

    u, p : the points, on the film and in the world. n_dl : see `BoundaryPoints`. reach : how far from u they may be,
        pixels.

    Returns
    -------
    u, n_dl : of all points. n : unit normals on the film, in which direction to look beside them; where an outline runs
        back, against n dl. rest : at which part of `reach`. active : are they there?
    """
    edges = outlines.edges
    if edges is None or not edges.grids.any:
        return u, 1.0, dr.normalize(n_dl), n_dl, active
    outline = chosen.is_horizon & outlines.horizons.is_of_grid(chosen.face)
    of_grid = outline | (chosen.is_edge & edges.grids.are(chosen.edge))
    # Normals are continuous from triangle to triangle, which the tangents of their curves are not.
    n = dr.normalize(n_dl)
    across = lambda found: reach * dr.select(outline, dr.normalize(found.facing), n)
    w, there = _search(outlines, at, look, chosen, found, u, p, across(found), outline, active & of_grid)
    active = active & (there | ~of_grid)

    # ---------------------- The tangent there ----------------------

    beyond = replace(chosen, along=chosen.along + dr.select(chosen.along < 0.5, ALONG, -ALONG))
    other = outlines.find(at, beyond)
    q = dr.detach(outlines.point(at, beyond, other))
    v = at.projection.film(q, at.aperture_sample).position()
    x, known = _search(outlines, at, look, beyond, other, v, q, across(other), outline, active & there & other.valid)
    # As much longer as what was sampled.
    tangent = (x - w) * (dr.dot(found.along_film, v - u) / dr.squared_norm(v - u))
    turned = mi.Vector2f(-tangent.y, tangent.x) / chosen.density
    turned = dr.mulsign(turned, dr.dot(n_dl, mi.Vector2f(-found.along_film.y, found.along_film.x)))
    length = dr.norm(turned)
    known &= dr.isfinite(length) & (length > 0)
    n = dr.select(known, dr.mulsign(turned, dr.dot(turned, n_dl)) / length, n)
    return dr.select(there, w, u), dr.select(there, mi.Float(REST), 1), n, dr.select(known, turned, n_dl), active


def _search(
    outlines: FilmOutlines,
    at: Placed,
    look: Look,
    chosen: Chosen,
    found: Found,
    u: mi.Point2f,
    p: mi.Point3f,
    offset: mi.Vector2f,
    outline: mi.Bool,
    active: mi.Bool,
) -> tuple[mi.Point2f, mi.Bool]:
    """Where an outline or a crease is, between u − offset and u + offset; and is there one?

    outline : mi.Bool, is it an outline?
    """
    edges, horizons = outlines.edges, outlines.horizons

    def side(part, active):
        """What is met there: nothing (0), the grid (1), or which side of a crease (1, 2)."""
        ray, si = look(u + part * offset, active)
        side = edges.side_of_crease(at.positions, at.normals, chosen.edge, found.t, p, si)
        surface = horizons.meets_grid(chosen.face, p, found.normal, ray, si)
        return dr.select(outline, dr.select(surface, mi.UInt32(1), 0), side)

    one = dr.full(mi.Float, 1, dr.width(u))
    first, last = side(-one, active), side(one, active)
    there = active & dr.select(outline, (first == 1) & (last == 0), edges.grids.parts(chosen.edge, first, last))

    def halve(k, low, high):
        middle = 0.5 * (low + high)
        same = side(middle, there) == first
        return k + 1, dr.select(same, middle, low), dr.select(same, high, middle)

    state = (dr.zeros(mi.UInt32, dr.width(u)), -one, one)
    _, low, high = dr.while_loop(state, lambda k, *_: there & (k < HALVINGS), halve, label="outlines of grids")
    return u + 0.5 * (low + high) * offset, there
