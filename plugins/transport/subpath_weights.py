"""Weights of bidirectional paths: the power heuristic over all ways to make a path, by two numbers a vertex.

A path of k segments may be made in k + 1 ways: by s vertices from the light and t from the camera, s + t = k + 1. With
p_s its density in each, the weight of a sample that was made with s is

    w_s = p_s² / Σ_i p_i²                                         (Veach 1997, equation 9.13, with β = 2)

Neighbours p_{s±1} / p_s differ in one vertex, so the sum over the ways in which one subpath would have been shorter is
found while it grows: by two numbers for its last vertex (van Antwerpen 2011; Georgiev 2012, "Implementing vertex
connection and merging"). Both are kept as roots of sums of squares, so that they do not leave single precision.

Densities are by solid angle (seen from the vertex before) or by area; random ends of paths (Russian roulette) count
nowhere, and the ratio of the two densities of a perfect mirror, there and back, counts as 1: weights need not be those
of the densities, but one and the same function of the path, however it was made.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Shorter:
    """The last vertex x of a subpath, and the ways to make it otherwise. (A Dr.Jit structure: not frozen.)

    one : density with which x is found in a connection, over that with which the subpath finds it; 0: never, since x or
        the vertex before is a perfect mirror.
    more : of the ways in which the subpath would end before x: root of the sum of the squares of the densities, over
        that of the subpath, but for a factor of the density with which the vertex before x is found from x.
    """

    one: mi.Float
    more: mi.Float

    def at(self, distance: mi.Float, cosine: mi.Float) -> Shorter:
        """Once it is known where the vertex is: from densities by solid angle to those by area.

        distance : from the vertex before; 1 where that is at infinity. cosine : at the vertex, > 0.
        """
        return Shorter(self.one * dr.square(distance) / cosine, self.more / cosine)

    def beyond(self, cosine: mi.Float, pdf: mi.Float, back: mi.Float, mirrored: mi.Bool) -> Shorter:
        """For the next vertex, before it is known where it is.

        cosine : of the direction that was sampled, at this vertex.
        pdf : its density. back : density of the way back, from there to the vertex before, when it is sampled here.
        mirrored : was it sampled from a perfect mirror?
        """
        more = dr.select(mirrored, cosine * self.more, cosine / pdf * self.shorter(back))
        return Shorter(dr.select(mirrored, 0, dr.rcp(pdf)), more)

    def shorter(self, back: mi.Float) -> mi.Float:
        """Root of the sum of squares of all ways in which the other subpath finds this vertex, too, over the density by
        area with which it does. back : density with which it finds the vertex before from here, by solid angle."""
        return root_of_squares(self.one, self.more * back)


def root_of_squares(a: mi.Float, b: mi.Float) -> mi.Float:
    """√(a² + b²)."""
    return dr.sqrt(dr.square(a) + dr.square(b))


def weight(*ratios: mi.Float) -> mi.Float:
    """Weight of a sample: 1 / (1 + Σ ratio²).

    ratios : of the other ways' densities to that of this sample: roots of sums of squares.
    """
    return dr.rcp(1 + sum(dr.square(r) for r in ratios))
