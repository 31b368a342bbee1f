"""Edges chosen by cones of normals: the classical test for silhouettes, to compare the moments of planes with.

A node is rejected where the cone around its face normals, as seen over the whole of its bounding sphere, turns all
faces to the viewer, or all away. Otherwise it counts with its whole length, times the weights of distance, BSDF and
lobes that the choice by importance uses, too. An edge in a leaf is a node like any other: it passes by its cone, and
may turn out to be no silhouette once it is chosen.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import rimlight  # noqa: F401  # isort: skip (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np

from rimlight.edge_sampling.choice import sampling
from rimlight.edge_sampling.choice.edge_tree import EdgeTree, Node, Slot
from rimlight.edge_sampling.choice.importance import importance
from rimlight.edge_sampling.choice.views import View

#: Radians by which a cone is wider than its normals: rounding must not reject.
SLACK = 1e-3


def replacements() -> list[tuple[Any, str, Any]]:
    """What to replace so that edges are chosen by cones: (of what, attribute, by what)."""
    refit, node = EdgeTree.refit, EdgeTree.node

    def refit_with_cones(tree: EdgeTree, positions: mi.Float) -> None:
        refit(tree, positions)
        # The scenes of the benchmarks stand still: once is enough.
        if not hasattr(tree, "cones"):
            tree.cones = mi.Float(cones(tree).ravel())

    def node_with_cone(tree: EdgeTree, index: mi.UInt32, active: mi.Bool | bool = True) -> Node:
        found = node(tree, index, active)
        found.cone = dr.gather(mi.Vector4f, tree.cones, index, active)
        return found

    return [
        (EdgeTree, "refit", refit_with_cones),
        (EdgeTree, "node", node_with_cone),
        (sampling, "importance", _importance),
        (sampling, "edge_importance", _edge_importance),
    ]


def cones(tree: EdgeTree) -> np.ndarray:
    """(nodes, 4): around the face normals of each node, a unit vector and the largest angle to it, radians."""
    p, q = (np.array(packet, float).reshape(-1, 4)[:, :3] for packet in tree.slots[:2])
    normals, inner = np.stack([p, q], 1), tree.inner[0]
    first, count = map(np.array, tree.slots_of(dr.arange(mi.UInt32, tree.leaves) + tree.inner))
    below = {inner + k: normals[i : i + n].reshape(-1, 3) for k, (i, n) in enumerate(zip(first, count, strict=True))}
    children = np.array(tree.children(dr.arange(mi.UInt32, max(inner, 1)))).T
    found = np.zeros((inner + tree.leaves, 4), np.float32)
    # Children have larger numbers.
    for node in reversed(range(len(found))):
        if node < inner:
            below[node] = np.concatenate([below[child] for child in children[node]])
        n = below[node]
        axis = n.sum(0)
        axis /= max(np.linalg.norm(axis), 1e-9)
        cosine = np.where(n.any(1), n @ axis, 1).min()
        found[node] = *axis, np.arccos(np.clip(cosine, -1, 1))
    return found


def _importance(node: Node, view: View) -> mi.Float:
    lower, upper = mi.Vector3f(node.lower), mi.Vector3f(node.upper)
    d = 0.5 * (lower + upper) - view.p
    distance, radius = dr.norm(d), 0.5 * dr.norm(upper - lower)
    # Angles between the axis and the planes across the line of sight, and of the sphere as it is seen.
    off = dr.abs(dr.safe_asin(dr.dot(node.cone.xyz, d) / distance))
    sphere = dr.safe_asin(radius / distance)
    possible = (off <= node.cone.w + sphere + SLACK) | (distance <= radius)
    length = node.always + dr.select(possible, node.silhouettes, 0)
    # The weights alone: what is always a boundary passes all else.
    return importance(
        replace(node, silhouettes=mi.Float(0), always=length, plane_lower=[-1] * 4, plane_upper=[1] * 4),
        view,
    )


def _edge_importance(slot: Slot, view: View) -> mi.Float:
    n, m = (plane.xyz for plane in slot.planes)
    node = EdgeTree._single(slot)
    axis = (n + m) * dr.rsqrt(dr.maximum(dr.squared_norm(n + m), 1e-12))
    node.cone = mi.Vector4f(axis.x, axis.y, axis.z, dr.safe_asin(0.5 * dr.norm(n - m)))
    return _importance(node, view)
