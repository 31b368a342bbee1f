"""Plugin `direct_edge`: emission and direct illumination, with the derivative of primary visibility."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators.common import mis_weight

from ._edge_integrator import EdgeIntegrator


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
       - Samples per pixel of the film boundary (visibility as seen from the sensor); likewise.

     * - sppi
       - |int|
       - Samples per pixel of the boundaries at shading points (soft shadows, lights in rough surfaces); likewise.

     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no)

    Renders what ``path`` renders at ``max_depth`` 2, and differentiates it with respect to vertex positions,
    ``to_world`` of rectangles, the camera (``to_world``, ``x_fov``, principal point, lens), lights, materials and
    textures.

    The interior derivative holds the film position of a camera ray, and the *material point* of a light sample: a
    light that moves takes its samples along (as in path-space differentiation, Zhang et al. 2020). So it needs no
    boundary unless something occludes it.

    **Limits.** Only triangle meshes can move: a moving sphere, curve, instance, ... is refused, and so is a camera
    that moves past one. Missing, with a warning: the hard shadows of point, spot and directional lights, edges seen
    in perfect mirrors and glass, and the jumps of textures (``checkerboard``, ``nearest`` filters). Missing, without
    a warning: the lines in which meshes cut through each other. At the outline of a smooth-shaded mesh, the dark
    fringe of normals that face away is taken as infinitely thin (see the theory), which leaves a bias of the order of
    its width: about 2 % on a torus of 48 × 24 quads at 32². The boundaries at shading points choose edges in
    proportion to their length, without bias, but with much noise on meshes with many edges. Polarised variants are
    refused. With filters other than ``box``, the ratio of sums that makes a pixel has a bias of order 1/spp, as it
    has in the image.

    .. tabs::
        .. code-tab:: xml

            <integrator type="direct_edge">
                <integer name="sppi" value="0"/>
            </integrator>

        .. code-tab:: python

            'type': 'direct_edge',
            'sppi': 0
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.max_depth = 2

    def sample(self, mode, scene, sampler, ray, active=True, beyond_horizon=False, **_):
        """Estimate the radiance along camera rays. Call it with gradients suspended: it resumes them where they belong.

        beyond_horizon : turn shading normals that face away from a visible face back to its horizon, see
            `_up_to_horizon`.

        Returns
        -------
        L : mi.Spectrum, (N,); attached unless `mode` is primal.
        valid : mi.Bool, (N,); does the ray meet a surface, or a visible environment? The alpha channel.
        aovs, state : empty; Mitsuba's interface has them.
        """
        attached = mode != dr.ADMode.Primal
        active = mi.Bool(active)
        L = mi.Spectrum(0)

        # ---------------------- First hit ----------------------

        # A surface that moves is met by a fixed ray; a ray that moves with the camera takes its hit along.
        pi = self._first_hit(scene, ray, active)
        with dr.resume_grad(when=attached):
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
            if not self.hide_emitters:
                L += si.emitter(scene).eval(si, active)
        if beyond_horizon:
            _up_to_horizon(si, ray)
        bsdf = si.bsdf(ray)
        valid = active & si.is_valid() & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
        if scene.environment() is not None and not self.hide_emitters:
            valid |= active
        active &= si.is_valid()

        # ---------------------- Direct illumination ----------------------

        lights = _Lights(scene, attached)
        Lr_emitter = lights.sample_emitter(si, bsdf, sampler, active) if lights.any else 0
        Lr_bsdf = lights.sample_bsdf(si, bsdf, sampler, active) if lights.any_hit_by_rays else 0
        with dr.resume_grad(when=attached):
            L += Lr_emitter + Lr_bsdf
        return L, valid, [], None

    def sample_shading_boundary(self, scene, sampler, ray, boundaries):
        """What the edges seen from the first hits do to their light: mi.Spectrum, (N,), zero, with a gradient."""
        pi = self._first_hit(scene, ray, True)
        with dr.resume_grad():
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
        return boundaries.shading.sample(scene, si, sampler, boundaries.camera_moves)

    def _first_hit(self, scene, ray, active):
        pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        if self.hide_emitters:
            skip = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711 (an array of pointers)
            onwards = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, skip).spawn_ray(ray.d)
            pi[skip] = self.skip_area_emitters(scene, onwards, True, skip)
        return pi


def _up_to_horizon(si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> None:
    """Turn interpolated normals that face away from the viewer, on a face that does not, until they just face them.

    Just inside of the silhouette of a smooth-shaded mesh such normals make a black fringe, whose inner border is a
    jump that lies on no edge. The finer the mesh, the narrower the fringe: its two borders are taken together, as one
    jump from the background to the surface beside it.
    """
    to_viewer = -ray.d
    side = dr.sign(dr.dot(si.n, to_viewer))
    cos = side * dr.dot(si.sh_frame.n, to_viewer)
    ε = 1e-4
    away = si.is_valid() & (cos < ε)
    si.sh_frame.n = dr.select(away, dr.normalize(si.sh_frame.n + side * (ε - cos) * to_viewer), si.sh_frame.n)
    si.initialize_sh_frame()
    si.wi = dr.select(away, si.to_local(to_viewer), si.wi)


class _Lights:
    """Direct illumination by multiple importance sampling, attached to light, surface and material where wanted.

    Of a light sample, the *material point* y is held fixed. With the solid angle written as area,
    dω = |cos θ_y| dA(y) / r², its estimate is

        f(ω) |cos θ_x| Lₑ(y, −ω) · |cos θ_y| dA / r²  /  p(ω),      ω = (y − x) / r,

    where all factors but the density p follow the motion of x and y, dA by the change of the area of the triangle.
    """

    def __init__(self, scene: mi.Scene, attached: bool):
        self.scene = scene
        self.attached = attached
        flags = [e.flags() for e in scene.emitters()]
        self.any = bool(flags)
        self.any_delta = any(f & mi.EmitterFlags.Delta for f in flags)
        self.any_hit_by_rays = any(not f & mi.EmitterFlags.Delta for f in flags)
        self.any_deforms = any(s.is_emitter() and s.parameters_grad_enabled() for s in scene.shapes())
        # The BSDFs inside of shape groups are not listed: assume the worst of an instance.
        self.any_mirror = any(s.bsdf() is None or s.bsdf().flags() & mi.BSDFFlags.Delta for s in scene.shapes())

    def sample_emitter(self, si, bsdf, sampler, active):
        """Radiance reflected at `si` by a sampled light: mi.Spectrum, (N,)."""
        scene, context = self.scene, mi.BSDFContext()
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        sample = sampler.next_2d()
        ds, weight = scene.sample_emitter_direction(si, sample, not self.attached, active)
        active &= ds.pdf != 0
        direction = ds.d
        if self.attached:
            direction, weight, visible = self._attach_emitter(si, ds, weight, sample, active)
            active &= visible
        with dr.resume_grad(when=self.attached):
            f, pdf = bsdf.eval_pdf(context, si, si.to_local(direction), active)
            mis = dr.select(ds.delta, 1, mis_weight(ds.pdf, dr.detach(pdf)))
            return dr.select(active, f * weight * mis, 0)

    def _attach_emitter(self, si, ds, weight, sample, active):
        """Direction and weight (Lₑ · geometry / density) of a light sample with their gradients, and its visibility."""
        scene = self.scene
        on_surface = active & mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
        # One ray answers both questions: is the light visible, and which of its triangles is y on?
        ray = si.spawn_ray_to(ds.p)
        before = mi.Float(ray.maxt)
        ray.maxt = dr.select(on_surface, 2 * dr.norm(ds.p - ray.o) - ray.maxt, ray.maxt)
        pi = scene.ray_intersect_preliminary(ray, active=active)
        visible = dr.select(on_surface, pi.is_valid() & (pi.t >= before), ~pi.is_valid())
        with dr.resume_grad():
            y, ω, geometry = self._connect(si, pi, ray, on_surface & visible)
            direction = dr.select(on_surface, ω, ds.d)
            # Lights at infinity: the direction is fixed.
            elsewhere = scene.eval_emitter_direction(si, ds, active & ~on_surface & ~ds.delta) / ds.pdf
            attached = dr.select(
                on_surface, y.emitter(scene).eval(y, on_surface & visible) * (geometry / ds.pdf), elsewhere
            )
            if self.any_delta:
                moved, at_delta = scene.sample_emitter_direction(si, sample, False, active & ds.delta)
                direction = dr.select(ds.delta, moved.d, direction)
                attached = dr.select(ds.delta, at_delta, attached)
            return direction, dr.replace_grad(weight, attached), visible

    def sample_bsdf(self, si, bsdf, sampler, active):
        """Radiance reflected at `si` from a direction sampled from the BSDF: mi.Spectrum, (N,)."""
        scene, context = self.scene, mi.BSDFContext()
        sample1, sample2 = sampler.next_1d(), sampler.next_2d()
        bs, weight = bsdf.sample(context, si, sample1, sample2, active)
        active = active & dr.any(weight != 0)
        mirrored = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        ray = si.spawn_ray(si.to_world(bs.wo))
        pi = scene.ray_intersect_preliminary(ray, active=active)
        if not self.attached:
            y = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        else:
            with dr.resume_grad():
                on_surface = active & pi.is_valid()
                y, ω, geometry = self._connect(si, pi, ray, on_surface)
                ω = dr.select(on_surface, ω, ray.d)
                f = bsdf.eval(context, si, si.to_local(ω), active & ~mirrored)
                attached = f * (dr.select(on_surface, geometry, 1) / bs.pdf)
                if self.any_mirror:
                    # A mirror turns its ray with it: what that meets slides over the light.
                    turned, at_mirror = bsdf.sample(context, si, sample1, sample2, active & mirrored)
                    onwards = mi.Ray3f(ray)
                    onwards.o, onwards.d = si.p, si.to_world(turned.wo)
                    slid = pi.compute_surface_interaction(onwards, mi.RayFlags.All, active & mirrored)
                    y = dr.select(mirrored, slid, y)
                    attached = dr.select(mirrored, at_mirror, attached)
                weight = dr.replace_grad(weight, attached)
        emitter = y.emitter(scene, active)
        ds = mi.DirectionSample3f(scene, y, si)
        pdf = scene.pdf_emitter_direction(si, ds, active & ~mirrored & (emitter != None))  # noqa: E711
        mis = dr.select(mirrored, 1, mis_weight(bs.pdf, pdf))
        with dr.resume_grad(when=self.attached):
            return dr.select(active, weight * emitter.eval(y, active) * mis, 0)

    def _connect(self, si, pi, ray, active):
        """The material point y that `pi` stands for, the direction ω from `si` to it, and |cos θ_y| dA / r² relative
        to its present value."""
        y = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
        d = y.p - si.p
        r2 = dr.squared_norm(d)
        ω = d * dr.rsqrt(r2)
        y.wi = dr.replace_grad(y.wi, y.to_local(-ω))
        geometry = dr.abs_dot(y.n, ω) / r2
        if self.any_deforms:
            geometry *= self._area(pi, ray, active)
        return y, ω, geometry / dr.detach(geometry)

    def _area(self, pi, ray, active):
        """Twice the area of the triangles hit, attached."""
        corners = []
        for u, v in ((0, 0), (1, 0), (0, 1)):
            corner = mi.PreliminaryIntersection3f(pi)
            corner.prim_uv = mi.Point2f(u, v)
            flags = mi.RayFlags.Minimal | mi.RayFlags.FollowShape
            corners.append(corner.compute_surface_interaction(ray, flags, active).p)
        return dr.norm(dr.cross(corners[1] - corners[0], corners[2] - corners[0]))


mi.register_integrator("direct_edge", DirectEdgeIntegrator)
