"""The planes of faces: what they hide where other normals than theirs shade.

Light that arrives from behind a face does not reach it: rays towards it start behind the face, and what is there is
in the way. Where the normal of the face shades, its cosine is zero in its plane, and nothing jumps. But interpolated
normals, and normal maps with `use_shadowing_function` off, go on being lit. So, at a point x of a face with normal n,
the integrand F Lᵢ of reflected light jumps where n · ω = 0; and as the face turns, or as the points y that are seen
there move, the derivative of the integral gains

    ∮ (F⁺ L⁺ ġ⁺ − F⁻ L⁻ ġ⁻) dφ,        g = n · (y − x) / |y − x|

over the directions ω(φ) in the plane; with the BSDF times its cosine F, the light L and its point y just above the
plane, and just below. As in `shading_boundary.py`, y is a *material point*, which the interior derivative holds fixed.

What a camera sees of such faces jumps at the edges between them (`film_boundary.py`): what one face hides and the next
does not is the light from between their planes (`lune.py`).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.divided_light import division_of
from rimlight.edge_sampling.geometry.meshes import has_normal_map, is_smooth, surfaces
from rimlight.edge_sampling.parametrisation import Division, material_point
from rimlight.edge_sampling.rays import spawn_ray

from .tracer import ShadingPoint, Tracer

#: Sine of the angle between the plane and the directions just beside it.
BESIDE_PLANE = 1e-5


class FacePlanes:
    """Samples the planes of those shapes of a scene that other normals than theirs shade."""

    DRJIT_STRUCT = dict.fromkeys(("_shapes",))  # for `dr.freeze`

    def __init__(self, scene: mi.Scene):
        self.shapes = [s for s in surfaces(scene) if (s.is_mesh() and is_smooth(s)) or has_normal_map(s)]
        self._shapes = [mi.ShapePtr(s) for s in self.shapes]

    def sample(self, tracer: Tracer, point: ShadingPoint, sampler: mi.Sampler) -> mi.Spectrum:
        """One sample of the integral at each point: mi.Spectrum, (N,), zero, with the gradient of the light that is
        reflected there."""
        scene, si, active = tracer.scene, point.si, point.active
        with dr.suspend_grad():
            at = dr.detach(si)
            ours = mi.Bool(False)
            for shape in self._shapes:
                ours |= at.shape == shape
            s, c = dr.sincos(dr.two_pi * sampler.next_1d())
            frame = mi.Frame3f(at.n)
            ω = frame.s * c + frame.t * s
            active = active & ours & at.is_valid()
            sides = []
            for side in (1, -1):
                ray = spawn_ray(scene, at, dr.normalize(ω + side * BESIDE_PLANE * at.n))
                # (Mitsuba's `normalmap` reflects nothing that arrives from behind the face.)
                F = dr.two_pi * at.bsdf().eval(mi.BSDFContext(), at, at.to_local(ray.d), active)
                reflects = active & dr.any(F != 0)
                pi = scene.ray_intersect_preliminary(ray, active=reflects)
                y = pi.compute_surface_interaction(ray, mi.RayFlags.All, reflects)
                emitter, scattered = y.emitter(scene, reflects), mi.Spectrum(0)
                emitted = emitter.eval(y, reflects)
                near = division_of(tracer.lamps, point.turning, emitter)
                if tracer.scatters(2):
                    onwards = reflects & y.is_valid() & tracer.scatters(point.depth + 1)
                    scattered = tracer.scattered(ray, pi, point.depth, sampler.clone(), onwards)
                    scattered = dr.select(onwards, scattered, 0)
                jumps = [dr.select(reflects, side * F * L, 0) for L in (emitted, scattered)]
                sides.append((ray, pi, reflects & y.is_valid(), jumps, near))
            scatters = Division(point.vicinity.around(at.bsdf()))
        value = mi.Spectrum(0)
        with dr.resume_grad():
            for ray, pi, valid, jumps, near in sides:
                d = material_point(ray, pi, valid).p - si.p
                # What is infinitely far away is seen in a fixed direction.
                towards = dr.normalize(dr.select(valid, d, mi.Vector3f(ω)))
                for jump, division in zip(jumps, (near, scatters), strict=True):
                    held = division.held_beside(d, towards, valid)
                    g = dr.dot(si.n, dr.lerp(division.turned(towards), towards, held))
                    value += jump * dr.select(active, g - dr.detach(g), 0)
        return value
