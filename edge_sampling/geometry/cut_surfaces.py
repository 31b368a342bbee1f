"""Spheres, cylinders, disks and planes by their signed distance, and points that lie on two of them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import drjit as dr
import mitsuba as mi
import numpy as np

from .cylinder_rounding import blur

#: Pieces of a whole turn. Of a sphere, half as many from pole to pole.
TURN = 64

#: How far within cylinders and disks a curve must be, relative to them, so that what only touches them does not count;
#: and how far beyond them it is looked for, if the other shape is known by its triangles alone.
WITHIN, BEYOND = 1e-4, 0.02

#: Least sine between two analytic shapes that cut each other: where they come closer to a tangent, the triangles of one
#: may cut the other, though they only touch.
STEEP = 0.06

#: Steps of Newton's method.
STEPS = 3


class Kind(IntEnum):
    """What a surface is. The plane is that of a triangle."""

    PLANE = 0
    SPHERE = 1
    DISK = 2
    CYLINDER = 3


KINDS = {"Sphere": Kind.SPHERE, "Disk": Kind.DISK, "Cylinder": Kind.CYLINDER}


@dataclass
class Surface:
    """Surfaces with their frames: the origin, and three axes. Of a plane, two vectors in it will do."""

    kind: mi.UInt32
    o: mi.Vector3d
    x: mi.Vector3d
    y: mi.Vector3d
    z: mi.Vector3d

    def is_a(self, kind: Kind) -> mi.Bool:
        return self.kind == int(kind)

    def distance(self, p: mi.Vector3d) -> tuple[mi.Float64, mi.Vector3d]:
        """Signed distance of points from the surface, and its gradient: the normal, of unit length."""
        d = p - self.o
        axis = dr.normalize(self.z)
        d -= dr.select(self.is_a(Kind.CYLINDER), axis * dr.dot(axis, d), 0)
        flat = self.is_a(Kind.PLANE) | self.is_a(Kind.DISK)
        normal, radius, length = dr.normalize(dr.cross(self.x, self.y)), dr.norm(self.x), dr.norm(d)
        return dr.select(flat, dr.dot(normal, d), length - radius), dr.select(flat, normal, d / length)

    def blur(self, start: mi.Vector3d) -> mi.Float64:
        """How far beside it rays from a point may find a cylinder: scene units. 0 for other surfaces."""
        off = dr.cross(start - self.o, dr.normalize(self.z))
        radius = dr.sqrt(dr.maximum(dr.squared_norm(self.x), dr.squared_norm(self.y)))
        return dr.select(self.is_a(Kind.CYLINDER), blur(radius, dr.squared_norm(off)), 0)

    def local(self, p: mi.Vector3d) -> mi.Vector3d:
        """Points in the frame."""
        d, of_x, of_y = p - self.o, dr.cross(self.y, self.z), dr.cross(self.z, self.x)
        of_z = dr.cross(self.x, self.y)
        return mi.Vector3d(dr.dot(d, of_x), dr.dot(d, of_y), dr.dot(d, of_z)) / dr.dot(self.x, of_x)

    def world(self, p: mi.Vector3d) -> mi.Vector3d:
        return self.o + self.x * p.x + self.y * p.y + self.z * p.z

    def within(self, p: mi.Vector3d) -> mi.Float64:
        """Positive where the surface has not ended yet."""
        q = self.local(p)
        disk = 1 - WITHIN - dr.norm(mi.Vector2d(q.x, q.y))
        cylinder = dr.minimum(q.z - WITHIN, 1 - WITHIN - q.z)
        return dr.select(self.is_a(Kind.DISK), disk, dr.select(self.is_a(Kind.CYLINDER), cylinder, 1))


def nearest(p: mi.Vector3d, first: Surface, second: Surface) -> mi.Vector3d:
    """The point of two surfaces that is close to p."""
    for _ in range(STEPS):
        (g, n), (h, m) = first.distance(p), second.distance(p)
        c = dr.dot(n, m)
        det = dr.maximum(1 - c * c, STEEP**2)
        p = p + n * ((c * h - g) / det) + m * ((c * g - h) / det)
    return p


def across(a: mi.Vector3d, b: mi.Vector3d, t: mi.Float64, surfaces: list[Surface]) -> tuple[mi.Vector3d, mi.Vector3d]:
    """The point of two surfaces in the plane across a chord, through its point t; and its derivative."""
    e = b - a
    p, tangent = a + t * e, e
    for _ in range(STEPS + 1):
        (g, n), (h, m) = (s.distance(p) for s in surfaces)
        along = dr.cross(n, m)
        det = dr.dot(e, along)
        usable = dr.abs(det) > 0
        inverse = dr.select(usable, dr.rcp(dr.select(usable, det, 1)), 0)
        p = p - (dr.cross(m, e) * g + dr.cross(e, n) * h) * inverse
        tangent = dr.select(usable, along * (dr.squared_norm(e) * inverse), e)
    return p, tangent


def trim(ends: list[mi.Vector3d], surfaces: list[Surface]) -> mi.Bool:
    """Let pieces end where one of their surfaces does; is anything left?"""
    left = mi.Bool(True)
    for s in surfaces:
        for _ in range(STEPS):
            f = [s.within(p) for p in ends]
            t = dr.clip(f[0] / (f[0] - f[1]), 0, 1)
            p, _ = across(*ends, t, surfaces)
            left &= (f[0] > 0) | (f[1] > 0)
            ends[:] = (
                dr.select((mine < 0) & (theirs > 0), p, q) for q, mine, theirs in zip(ends, f, f[::-1], strict=True)
            )
    return left


def triangles(kind: Kind) -> tuple[np.ndarray, np.ndarray]:
    """A shape in its own frame, as triangles: vertices (V, 3), faces (F, 3)."""
    rows = TURN // 2 if kind == Kind.SPHERE else 1
    φ, v = np.meshgrid(2 * np.pi * np.arange(TURN) / TURN, np.arange(rows + 1) / rows)
    if kind == Kind.SPHERE:
        r, z = np.where(v < 1, np.sin(np.pi * v), 0), np.cos(np.pi * v)
    elif kind == Kind.CYLINDER:
        r, z = np.ones_like(v), (1 + 2 * BEYOND) * v - BEYOND
    else:
        r, z = v / np.cos(np.pi / TURN), np.zeros_like(v)
    vertices = np.stack([r * np.cos(φ), r * np.sin(φ), z], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(TURN), np.arange(rows))
    a, b = TURN * j + i, TURN * j + (i + 1) % TURN
    quads = np.stack([a, b, b + TURN, a, b + TURN, a + TURN], -1)
    return vertices, quads.reshape(-1, 3)
