"""Plugin `prb_edge`: global illumination, with the derivative of visibility."""

from __future__ import annotations

import mitsuba as mi

from ._options import is_whole
from .edge_integrator import EdgeIntegrator


class PRBEdgeIntegrator(EdgeIntegrator):
    r"""
    .. _integrator-prb_edge:

    Path replay with edge sampling (:monosp:`prb_edge`)
    ---------------------------------------------------

    .. pluginparameters::

     * - max_depth
       - |int|
       - Longest path, in segments, as in ``path``: 1 shows emitters only, 2 adds direct illumination, and -1 stands for
         no limit. (Default: 6)

     * - rr_depth
       - |int|
       - From this depth on, paths end at random ("Russian roulette"). (Default: 5)

     * - sppc
       - |int|
       - Samples per pixel of the interior derivative. 0 switches it off; otherwise the ``spp`` argument of the render
         call overrides it. Default: that argument, or the sampler's ``sample_count``.

     * - sppp
       - |int|
       - Samples per pixel of the film boundary (visibility as seen from the sensor); likewise, but without a number
         in the scene at most 16 (width + height) for each sample per pixel.

     * - sppi
       - |int|
       - Samples per pixel of the boundaries at shading points (shadows, reflections in rough surfaces, the light that
         objects throw on each other); likewise.

     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no)

    Renders what ``path`` renders, and differentiates it with respect to what ``direct_edge`` differentiates. At
    ``max_depth`` 2 they are the same.

    **Interior.** The part of a path behind its first vertex is differentiated by path replay (Vicini et al. 2021):
    memory does not grow with the number of bounces. All its vertices are *material points*, which follow their surfaces
    (Zhang et al. 2020); the first is met by a ray that is fixed on the film.

    **Boundaries at shading points.** Each path keeps *one* of its vertices, chosen by a reservoir in proportion to
    throughput, and one edge as seen from there. What is seen past the edge is traced to ``max_depth``. Shadows on
    what the camera sees, hard ones too, are found from the lights.

    **Limits.** Those of ``direct_edge``, but for interreflections; what perfect mirrors and glass show is taken not to
    move, and part of what is seen through masks, with a warning. Where something that moves touches something else,
    and in corners of rooms when the camera moves, light that bounces between the two has a derivative of infinite
    variance; for some of these integrals, not even the mean of the absolute value is finite. There, single pixels are
    wrong by arbitrary amounts, and more samples help slowly or not at all.

    .. tabs::
        .. code-tab:: xml

            <integrator type="prb_edge">
                <integer name="max_depth" value="4"/>
            </integrator>

        .. code-tab:: python

            'type': 'prb_edge',
            'max_depth': 4
    """

    OPTIONS = (*EdgeIntegrator.OPTIONS, "max_depth", "rr_depth")

    def __init__(self, props: mi.Properties):
        who = props.plugin_name()
        max_depth, rr_depth = props.get("max_depth", 6), props.get("rr_depth", 5)
        if not is_whole(max_depth) or max_depth < -1:
            raise ValueError(f'{who}: "max_depth" must be a whole number >= 0, or -1 for no limit, got {max_depth}')
        if not is_whole(rr_depth) or rr_depth < 1:
            raise ValueError(f'{who}: "rr_depth" must be a whole number >= 1, got {rr_depth}')
        super().__init__(props, max_depth=max_depth, rr_depth=rr_depth)


mi.register_integrator("prb_edge", PRBEdgeIntegrator)
