"""Plugin `prb_edge`: global illumination, with the derivative of visibility."""

from __future__ import annotations

import mitsuba as mi

from ._edge_integrator import EdgeIntegrator


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
       - Samples per pixel of the film boundary (visibility as seen from the sensor); likewise.

     * - sppi
       - |int|
       - Samples per pixel of the boundaries at shading points (shadows, reflections in rough surfaces, the light that
         objects throw on each other); likewise.

     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no)

    Renders what ``path`` renders, and differentiates it with respect to what ``direct_edge`` differentiates. At
    ``max_depth`` 2 the two agree, and ``direct_edge`` is the cheaper one.

    **Interior.** The part of a path behind its first vertex is differentiated by path replay (Vicini et al. 2021):
    memory does not grow with the number of bounces. Three rules say what is held fixed. A surface that scatters is met
    by a *fixed ray*, wherever it moves. As seen from a vertex that moves, the next one that scatters is *fixed in
    space*. Of an emitter, the *material point* that emits is fixed, so that a light takes its samples along. So the
    derivative at one vertex needs no other vertex to move (Worchel et al. 2025).

    **Boundaries at shading points.** Each path keeps *one* of its vertices, chosen by a reservoir in proportion to
    throughput, and one edge as seen from there. The light on both sides of the edge is traced to ``max_depth``. Shadows
    that lights of finite size cast on what the camera sees are found from the lights, too.

    **Limits.** Those of ``direct_edge``, but for interreflections. Missing, with a warning: the motion of geometry that
    perfect mirrors and glass show, at all depths beyond 2 (a rough surface may see it in a mirror, or the camera by way
    of several), the hard shadows of point, spot and directional lights, and the jumps of textures. Missing, without a
    warning: the lines in which meshes cut through each other. Polarised variants and participating media are not
    supported.

    .. tabs::
        .. code-tab:: xml

            <integrator type="prb_edge">
                <integer name="max_depth" value="4"/>
            </integrator>

        .. code-tab:: python

            'type': 'prb_edge',
            'max_depth': 4
    """

    def __init__(self, props: mi.Properties):
        who = props.plugin_name()
        max_depth, rr_depth = props.get("max_depth", 6), props.get("rr_depth", 5)
        if not _is_whole(max_depth) or max_depth < -1:
            raise ValueError(f'{who}: "max_depth" must be a whole number >= 0, or -1 for no limit, got {max_depth}')
        if not _is_whole(rr_depth) or rr_depth < 1:
            raise ValueError(f'{who}: "rr_depth" must be a whole number >= 1, got {rr_depth}')
        super().__init__(props, max_depth=max_depth, rr_depth=rr_depth)


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


mi.register_integrator("prb_edge", PRBEdgeIntegrator)
