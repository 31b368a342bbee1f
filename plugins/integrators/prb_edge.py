"""Plugin `prb_edge`: global illumination, with the derivative of visibility."""

from __future__ import annotations

import mitsuba as mi

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
         in the scene at most 16 (width + height) for each sample per pixel. And of fine textures, and of polished
         curved shapes, that move over the film, without that limit.

     * - sppi
       - |int|
       - Samples per pixel of the boundaries at shading points (shadows, reflections in rough surfaces, the light that
         objects throw on each other); likewise.

     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no)

    Renders what ``path`` renders, and differentiates it with respect to what ``direct_edge`` differentiates. At
    ``max_depth`` 2 they are the same.

    **Interior.** The first vertex of a path is met by a ray that is fixed on the film. Others are *material points*,
    which follow their surfaces (Zhang et al. 2020), but close to the vertex before, they slide, since there the
    direction is held: so contacts and corners have a finite variance, but for a logarithm. In backward mode, paths are
    written down, 76 bytes for each vertex and sample, and visited again from their end.

    **Boundaries at shading points.** Each path keeps *one* of its vertices for each kind of boundary, chosen by a
    reservoir in proportion to throughput, and one edge as seen from there. Where edges that move are close to other
    surfaces, some points are found from them. What is seen past the edge is traced to ``max_depth``. Shadows, hard
    ones too, are found from the lights, on what the camera sees, and on what lights that.

    **Memory.** As with ``direct_edge``, many samples are taken in passes.

    **Limits.** Those of ``direct_edge``, but for interreflections. Outlines in the light that perfect mirrors and glass
    throw on other surfaces are there, but noisy: they are sought in random directions. Missing, with a warning, are
    textures that jump on spheres, disks and cylinders, in the light that these throw on surfaces close to them. With
    ``max_depth`` above 32 or -1, the vertices of paths are counted before they are written down, which ``dr.freeze``
    cannot record in a derivative.

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
    HOLDS = True

    def __init__(self, props: mi.Properties):
        super().__init__(props, max_depth=props.get("max_depth", 6), rr_depth=props.get("rr_depth", 5))


mi.register_integrator("prb_edge", PRBEdgeIntegrator)
