"""Plugin `bdpt`: images by bidirectional path tracing."""

from __future__ import annotations

import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator

from rimlight.edge_sampling.refusals import InputError, Refusal
from rimlight.transport.paths import Depths

from ._bidirectional_image import light_paths_of, render
from ._depths import attribute, checked_depths
from ._options import check_options, is_whole


class BDPTIntegrator(ADIntegrator):
    r"""
    .. _integrator-bdpt:

    Bidirectional path tracing (:monosp:`bdpt`)
    -------------------------------------------

    .. pluginparameters::

     * - max_depth
       - |int|
       - Longest path, in segments, as in ``path``: 1 shows emitters only, 2 adds direct illumination, and -1 stands for
         no limit. (Default: 6)

     * - rr_depth
       - |int|
       - From this depth on, paths end at random ("Russian roulette"). (Default: 5)

     * - light_paths
       - |float|
       - Paths that start on lights, for each path that starts at the camera. More of them pay where light comes through
         glass or by mirrors, fewer where lights are in the open. (Default: 0.5)

     * - spp_per_pass
       - |int|
       - Samples per pixel that are in memory at once; they must divide those of the image. (Default: all)

     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no)

    Renders what ``path`` renders, and differs in where it has little noise: in caustics, lamps behind glass and in
    shades, and rooms that are lit through a gap, where paths from the camera find the light by chance only. Paths start
    at the camera and on the lights. Each vertex of a camera path is connected with a point on a light and with one
    vertex of a light path; each vertex of a light path, with the camera. All ways in which a path may have been made
    share it by the power heuristic (Veach 1997), see the documentation under "Theory".

    Of lights without size, it also has the caustics that perfect mirrors and smooth glass throw, and what comes through
    a ``mask``, which ``path`` lacks.

    **Supported** are all emitters, ``directionalarea`` among them, all BSDFs and shapes. Light paths are connected with
    ``perspective``, ``thinlens``, ``orthographic`` and ``fisheye`` sensors, and batches of them. All other sensors see
    their light by connections with camera paths alone.

    **Limits.** There is no derivative: use ``bdpt_edge``. Participating media, spectral and polarised variants are
    refused. In the open, it takes about twice the time of ``path`` for the same noise. A frozen function
    (``dr.freeze``) keeps the extent that the scene had when it was recorded: record it again (``clear``) when the
    scene grows.

    In Python, the attribute ``ways`` selects what is rendered: ``integrator.ways = (s, t)`` are the paths of s vertices
    that come from the light and t that come from the camera, with the weights that they have in the image; None stands
    for any number.

    .. tabs::
        .. code-tab:: xml

            <integrator type="bdpt">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'bdpt',
            'max_depth': 8
    """

    OPTIONS = ("max_depth", "rr_depth", "light_paths", "spp_per_pass", "hide_emitters")
    LONGEST = None

    depths: Depths | None = None
    max_depth, rr_depth = attribute("max_depth"), attribute("rr_depth")

    def __init__(self, props: mi.Properties):
        check_options(props, self.OPTIONS)
        self.name = props.plugin_name()
        depths = checked_depths(self.name, props.get("max_depth", 6), props.get("rr_depth", 5))
        per_pass = props.get("spp_per_pass", None)
        if per_pass is not None and (not is_whole(per_pass) or per_pass < 1):
            raise InputError(f'{self.name}: "spp_per_pass" must be a whole number >= 1, got {per_pass}')
        self.light_paths = light_paths_of(props)
        super().__init__(props)
        self.depths = depths
        self.per_pass = per_pass
        #: Numbers of vertices from the light and from the camera of the paths that are rendered; None: any.
        self.ways: tuple[int | None, int | None] = (None, None)

    def to_string(self) -> str:
        depths = f"max_depth={self.depths.max_depth}, rr_depth={self.depths.rr_depth}"
        return f"BDPTIntegrator[{depths}, light_paths={self.light_paths}, hide_emitters={self.hide_emitters}]"

    # ---------------------- Mitsuba's interface ----------------------

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """The image, as Mitsuba has it.

        Raises
        ------
        RuntimeError : there are participating media, or the passes do not add up to the samples per pixel.
        """
        return render(self, scene, sensor, seed, spp, develop, per_pass=self.per_pass, ways=self.ways)

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        """Not supported."""
        raise Refusal(f"{self.name}: has no derivative, use bdpt_edge")

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        """Not supported."""
        raise Refusal(f"{self.name}: has no derivative, use bdpt_edge")


mi.register_integrator("bdpt", BDPTIntegrator)
