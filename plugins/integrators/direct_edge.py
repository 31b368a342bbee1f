"""Plugin `direct_edge`: emission and direct illumination, with the derivative of primary visibility."""

from __future__ import annotations

import mitsuba as mi

from .edge_integrator import EdgeIntegrator


class DirectEdgeIntegrator(EdgeIntegrator):
    r"""
    .. _integrator-direct_edge:

    Direct illumination with edge sampling (:monosp:`direct_edge`)
    --------------------------------------------------------------

    .. pluginparameters::

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
       - Samples per pixel of the boundaries of shadows, and at shading points (lights in rough surfaces); likewise.

     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no)

    Renders what ``path`` renders at ``max_depth`` 2, and differentiates it with respect to vertex positions,
    ``to_world`` of rectangles, the camera (``to_world``, ``x_fov``, principal point, lens), lights, materials and
    textures.

    The interior derivative holds the film position of a camera ray, and the *material point* of a light sample: a
    light that moves takes its samples along (as in path-space differentiation, Zhang et al. 2020). So it needs no
    boundary unless something occludes it, or it touches what it lights.

    **Memory.** A derivative has at most 2¹⁸ samples of a term in memory (2²¹ on a GPU), but at least one per pixel.
    More are taken in passes. In Python, ``integrator.at_once`` is that number.

    **Limits.** Only triangle meshes and their instances, spheres, disks, cylinders, grids of signed distances and
    b-spline curves can move: a moving ``linearcurve`` is refused, and so is a camera that moves past one. Missing, with
    a warning: the curves in which grids and curves cut through other shapes, cuts of the far clipping plane through
    any, and shadows of ``linearcurve``, ... on what moves. Warned about, too: participating
    media, which are taken for empty (derivatives with respect to their parameters are refused). So is the light of
    smooth-shaded lamps with coarse meshes, which is off by some per cent. Polarised variants are refused. With
    filters other than ``box``, the ratio of sums that makes a pixel has a bias of order 1/spp, as it has in the
    image.

    .. tabs::
        .. code-tab:: xml

            <integrator type="direct_edge">
                <integer name="sppi" value="0"/>
            </integrator>

        .. code-tab:: python

            'type': 'direct_edge',
            'sppi': 0
    """

    HOLDS = True

    #: Its paths end after direct illumination. `direct_projective` has these properties, and does not heed them either.
    IDLE = ("max_depth", "rr_depth")

    def __init__(self, props: mi.Properties):
        super().__init__(props, max_depth=2)


mi.register_integrator("direct_edge", DirectEdgeIntegrator)
