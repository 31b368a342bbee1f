"""Plugin `prb_edge`: global illumination, with the derivative of visibility."""

from __future__ import annotations

import mitsuba as mi

from ._edge_integrator import EdgeIntegrator


class PRBEdgeIntegrator(EdgeIntegrator):
    """(to be written)"""

    def __init__(self, props: mi.Properties):
        max_depth, rr_depth = props.get("max_depth", 6), props.get("rr_depth", 5)
        super().__init__(props, max_depth=max_depth, rr_depth=rr_depth)


mi.register_integrator("prb_edge", PRBEdgeIntegrator)
