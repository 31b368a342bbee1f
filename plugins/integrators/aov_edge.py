"""Plugin `aov_edge`: depth, positions, normals, texture coordinates, masks, with the derivative of visibility."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches
from itertools import accumulate

import drjit as dr
import mitsuba as mi

from rimlight._collection import no_collection
from rimlight._plan import Plan
from rimlight.edge_sampling.refusals import InputError, Refusal
from rimlight.terms.channels import ChannelSample, ChannelsOnFilmTerm, ChannelsTerm
from rimlight.terms.sampling import over_film
from rimlight.terms.term import FilmSamples, Job
from rimlight.transport.channels import Channel, ChannelTracer

from ._channel_search import ChannelSearch
from .edge_integrator import EdgeIntegrator


class AOVEdgeIntegrator(EdgeIntegrator):
    r"""
    .. _integrator-aov_edge:

    Depth, normals, masks with edge sampling (:monosp:`aov_edge`)
    -------------------------------------------------------------

    .. pluginparameters::

     * - aovs
       - |string|
       - The channels: a list of :monosp:`<name>:<type>`, as Mitsuba's ``aov`` has it, and of
         :monosp:`<name>:mask:<id of a shape>`.

     * - (Nested plugin)
       - *integrator*
       - Integrators whose images come before the channels, such as ``direct_edge`` or ``prb_edge``; none or several.
         Each differentiates its own image.

     * - sppc
       - |int|
       - Samples per pixel of the interior derivative of the channels. 0 switches it off; otherwise the ``spp`` argument
         of the render call overrides it. Default: that argument, or the sampler's ``sample_count``.

     * - sppp
       - |int|
       - Samples per pixel of the film boundary of the channels; likewise, but without a number in the scene at most
         16 (width + height) for each sample per pixel.

     * - hide_emitters
       - |bool|
       - Look through emitters. (Default: no)

    Renders what Mitsuba's ``aov`` renders, in the same order, and differentiates it with respect to what
    ``direct_edge`` differentiates, visibility included: the images of the nested integrators, then the channels. A pose
    can be fitted to a depth map alone, or to a mask alone, see :doc:`/channels`.

    .. list-table::
       :header-rows: 1

       * - type
         - components
         - what it is
       * - ``depth``
         - T
         - distance along the camera ray from where that begins (the near clipping plane), scene units
       * - ``position``
         - X, Y, Z
         - of the surface, world space
       * - ``uv``
         - U, V
         - texture coordinates
       * - ``geo_normal``, ``sh_normal``
         - X, Y, Z
         - unit normal of the face, and the interpolated one; world space
       * - ``albedo``
         - R, G, B
         - diffuse reflectance
       * - ``dp_du``, ``dp_dv``, ``duv_dx``, ``duv_dy``
         - X, Y, Z; U, V
         - derivatives of the position by texture coordinates, and of these by film positions, for the footprint
           that one of the samples of a pixel has
       * - ``alpha``
         - A
         - 1 where a shape is seen, 0 where there is nothing, or the environment
       * - ``mask:<id>``
         - A
         - 1 where the shape (or instance) with this id is seen, 0 elsewhere
       * - ``prim_index``, ``shape_index``
         - I
         - numbers of triangle and shape: their derivative is taken to be 0, with a warning

    Where nothing is seen, all of them are 0 (where Mitsuba's ``duv_dx`` and ``duv_dy`` are not finite). Channels are
    not weighted by what the sensor weighs light with, but they are 0 where it shows nothing, as outside of the circle
    of a ``fisheye``.

    **Interior.** The film position of a ray is held, so that where it meets a surface slides over it, as that or the
    camera moves.

    **Film boundary.** That of ``direct_edge``, and the edges at which channels alone jump: of smooth-shaded
    meshes for ``geo_normal``; of all triangles for ``dp_du`` and its kin, and for ``uv`` where a mesh has no
    texture coordinates; the seams of ``uv`` on spheres, disks and cylinders.

    **Names.** :monosp:`integrator.channel(image, name)` is the part of an image that a name stands for, and
    :monosp:`integrator.layout(width)` tells where all of them are.

    **Limits.** Those of the film boundary of ``direct_edge``. The ``albedo`` of textures that jump lacks their jumps,
    with a warning. Masks know the shapes of the scene by their ids: where Mitsuba merges meshes of equal materials,
    load the scene with :monosp:`optimize=False`. Mitsuba's own ``aov`` cannot be given a boundary: around integrators
    of Rimlight it renders, but raises in a derivative. The film (:monosp:`specfilm`) must not be a special one.

    .. tabs::
        .. code-tab:: xml

            <integrator type="aov_edge">
                <string name="aovs" value="dd.y:depth, nn:sh_normal, thing:mask:cube"/>
                <integrator type="direct_edge" name="image"/>
            </integrator>

        .. code-tab:: python

            'type': 'aov_edge',
            'aovs': 'dd.y:depth, nn:sh_normal, thing:mask:cube',
            'image': {
                'type': 'direct_edge',
            }
    """

    OPTIONS = ("sppc", "sppp", "hide_emitters", "aovs")
    IDLE = ("sppi",)
    TRACER = ChannelTracer
    TERMS = (ChannelsTerm(), ChannelsOnFilmTerm())
    BALANCES = False

    def __init__(self, props: mi.Properties):
        who = props.plugin_name()
        keys = list(props.keys())
        self.nested = {key: props[key] for key in keys if isinstance(props[key], mi.Integrator)}
        self.OPTIONS = (*self.OPTIONS, *self.nested)
        if not isinstance(props.get("aovs", None), str):
            raise InputError(f'{who}: "aovs" must list channels, such as "depth:depth, nn:sh_normal"')
        self.channels = Channel.parse(who, props["aovs"])
        twice = set(self.nested) & {c.name for c in self.channels}
        if twice:
            raise InputError(f'{who}: the integrator and the channel "{twice.pop()}" have one name')
        # Of paths of one segment: nothing is reflected.
        super().__init__(props, max_depth=1)
        self.search = ChannelSearch(self.name, self.channels)
        self.CHANNELS = [name for c in self.channels for name in c.components]
        self.count = len(self.CHANNELS)

    def to_string(self) -> str:
        nested = "".join(f", {key}={value}" for key, value in self.nested.items())
        return f"{type(self).__name__}[aovs={', '.join(self.aov_names())}, sppc={self.sppc}, sppp={self.sppp}{nested}]"

    def aov_names(self) -> list[str]:
        """As Mitsuba's `aov` has them: of the nested integrators, then of the channels."""
        names = [f"{key}.{letter}" for key in self.nested for letter in "RGBA"]
        names += [f"{key}.{name}" for key, nested in self.nested.items() for name in nested.aov_names()]
        return names + [name for c in self.channels for name in c.components]

    def traverse(self, callback: mi.TraversalCallback) -> None:
        super().traverse(callback)
        for key, nested in self.nested.items():
            callback.put(key, nested, mi.ParamFlags.Differentiable)

    # ---------------------- Mitsuba's interface ----------------------

    @no_collection()
    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """The images of the nested integrators, and the channels behind them: mi.TensorXf, (H, W, C)."""
        sensor = self._sensor(scene, sensor)
        self._rendered.remember(scene, sensor, seed)
        images = [i.render(scene, sensor, seed, spp, develop, evaluate) for i in self.nested.values()]
        with dr.suspend_grad():
            sampler, spp = over_film(sensor, seed, spp or sensor.sampler().sample_count())
            ray, weight, position = self.sample_rays(scene, sensor, sampler)
            tracer = self._tracer(scene, spp)
            values = tracer.values(tracer.sized(ray), dr.any(weight != 0), attached=False)
            samples = FilmSamples(position, ChannelSample(values), ray.wavelengths, 1.0, spp)
            images.append(self._develop(sensor.film(), [samples], [samples.value]))
        return _joined(images)

    @no_collection()
    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        """Derivative of the image along the gradients that are set on the parameters: mi.TensorXf, (H, W, C)."""
        own = super().render_forward(scene, params, sensor, seed, spp)
        return _joined([*(i.render_forward(scene, params, sensor, seed, spp) for i in self.nested.values()), own])

    @no_collection()
    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        """Add to the gradients of the parameters what `grad_in`, (H, W, C), the gradient of a loss with respect to the
        image, makes of them."""
        sensor = self._sensor(scene, sensor)
        super().render_backward(scene, params, grad_in[:, :, -self.count :], sensor, seed, spp)
        for key, nested in self.nested.items():
            nested.render_backward(scene, params, self.channel(grad_in, key), sensor, seed, spp)

    def _develop(self, film, terms, values, weights=None):
        """The channels that the film makes of `values` at the positions of `terms`: (H, W, C)."""
        if mi.has_flag(film.flags(), mi.FilmFlags.Special):
            raise Refusal(f"{self.name}: a film of the class {film.class_name()} cannot hold channels, use a hdrfilm")
        return super()._develop(film, terms, values, weights)[:, :, -self.count :]

    # ---------------------- Channels ----------------------

    def layout(self, width: int) -> dict[str, slice]:
        """Where the image of each nested integrator, and each channel, is on the last axis of an image of this width.

        Raises
        ------
        ValueError : an image of this integrator cannot have this width.
        """
        extra = {key: len(nested.aov_names()) for key, nested in self.nested.items()}
        base, rest = divmod(width - self.count - sum(extra.values()), max(len(extra), 1))
        if rest or base < 0 or (base and not extra):
            raise InputError(f"{self.name}: an image with {width} channels is not one of this integrator")
        widths = {key: base + count for key, count in extra.items()}
        widths |= {c.name: len(c.components) for c in self.channels}
        ends = list(accumulate(widths.values()))
        return {name: slice(end - size, end) for (name, size), end in zip(widths.items(), ends, strict=True)}

    def channel(self, image, name: str):
        """The channels of this name, or the image of the nested integrator of this name: (H, W, K), a part of an image
        of this integrator, (H, W, C), or of its derivative; attached as that is.

        Raises
        ------
        ValueError : there are none of this name.
        """
        layout = self.layout(image.shape[2])
        if name not in layout:
            near = get_close_matches(name, layout, n=1)
            remedy = f'did you mean "{near[0]}"?' if near else f"it has {', '.join(layout)}."
            raise InputError(f'{self.name}: an image has no channel "{name}"; {remedy}')
        return image[:, :, layout[name]]

    def _tracer(self, scene: mi.Scene, spp: int) -> ChannelTracer:
        tracer = self.TRACER(scene, self)
        tracer.footprint = spp**-0.5
        return tracer

    def _job(self, scene, sensor, seed, spp, mode) -> Job:
        job = super()._job(scene, sensor, seed, spp, mode)
        return replace(job, tracer=self._tracer(scene, job.weights))

    # ---------------------- What is to be done ----------------------

    @no_collection()
    def plan(self, scene: mi.Scene, sensor: int | mi.Sensor = 0, spp: int = 0) -> Plan:
        """What a derivative will do, the nested integrators' own included, see `rimlight.plan`."""
        plan = super().plan(scene, sensor, spp)
        for nested in self.nested.values():
            if hasattr(nested, "plan"):
                other = nested.plan(scene, sensor, spp)
                limits = (*plan.limits, *(limit for limit in other.limits if limit not in plan.limits))
                plan = replace(plan, terms=(*plan.terms, *other.terms), limits=limits)
        return plan

    @no_collection()
    def find_boundaries(self, scene, sensor=0):
        """As in `EdgeIntegrator`; those of the nested integrators, too."""
        nested = [i.find_boundaries(scene, sensor) for i in self.nested.values() if hasattr(i, "find_boundaries")]
        return super().find_boundaries(scene, sensor), nested


def _joined(images: Sequence[mi.TensorXf]) -> mi.TensorXf:
    """Images side by side along their channels: (H, W, C)."""
    return dr.concat(images, axis=2) if len(images) > 1 else images[0]


mi.register_integrator("aov_edge", AOVEdgeIntegrator)
