"""The object as Mitsuba renders it: a mesh with a vertex for each pixel, under all lights at once (`rig`)."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from rimlight import ggx, leds, no_collection
from rimlight.edge_sampling.geometry.meshes import make_mesh
from rimlight.edge_sampling.refusals import InputError

from .dataset import Dataset
from .direct import Guess, Lighting, bsdf_of, own
from .integration import integrate, mesh_of, normals_of

#: Distance of an orthographic camera from the surface, over the size of the image.
FAR = 2.0

#: By how many pixels images of cameras whose pixels are not square may be off at their border.
SKEWED = 1.0

#: Of the mean error: what pixels without any have, too, when paths are distributed by errors.
EVEN = 0.1

#: Rays towards lights begin so far above the surface, in the distance of two pixels.
ABOVE = 0.5


#: Pixels at the border of the mask that are darker than this part of the median pixel under so many of the lights are
#: taken for the background's, unless they are more than this part of the mask.
UNLIT, BRIGHT, MOST_UNLIT = 0.05, 0.9, 0.5


class Domain:
    """The pixels of the mask and a ring around them, so that the mesh covers the pixels of the mask entirely.

    wide : (H + 2, W + 2), bool: the mask, one pixel larger on all sides, with that ring; Q pixels. nearest : (Q,), for
    each of them the nearest of the P pixels of the mask that are `lit`, (P,), bool, itself if it is one of these: that
    are not `unlit`. inner : (P,), for each of these its number among the Q.
    camera : of the larger image.
    """

    def __init__(self, data: Dataset):
        mask = np.pad(data.mask, 1)
        self.wide = ndimage.binary_dilation(mask, np.ones((3, 3)))
        number = np.zeros(mask.shape, np.int64)
        number[mask] = np.arange(mask.sum())
        self.lit = ~unlit(data)
        _, (row, column) = ndimage.distance_transform_edt(~np.pad(data.image(self.lit), 1), return_indices=True)
        self.nearest = number[row, column][self.wide]
        self.inner = np.flatnonzero(mask[self.wide])
        self.camera = None
        if data.camera is not None:
            self.camera = data.camera.copy()
            self.camera[:2, 2] += 1
        #: Of integrated depth, in the unit of the LEDs.
        self.distance = 1.0 if data.distance is None or data.camera is None else data.distance

    def integrate(self, normals: np.ndarray, bilateral: float | None = None) -> np.ndarray:
        """Depth of the Q pixels, (Q,), of the normals of the P, (P, 3)."""
        wide = np.zeros((*self.wide.shape, 3))
        wide[self.wide] = normals[self.nearest]
        return self.distance * integrate(wide, self.wide, camera=self.camera, bilateral=bilateral)[self.wide]

    def normals(self, depth: np.ndarray) -> np.ndarray:
        """Of depth, (P, 3)."""
        wide = np.full(self.wide.shape, np.nan)
        wide[self.wide] = depth
        return normals_of(wide, self.wide, camera=self.camera)[self.wide][self.inner]

    def mesh(self, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices, (Q, 3), and faces."""
        wide = np.full(self.wide.shape, np.nan)
        wide[self.wide] = depth
        return mesh_of(wide, self.wide, camera=self.camera)[:2]

    def points(self, depth: np.ndarray) -> np.ndarray:
        """What the P pixels of the mask show: (P, 3)."""
        return self.mesh(depth)[0][self.inner]


def unlit(data: Dataset) -> np.ndarray:
    """Which pixels are the background's rather than the object's, (P,), bool: dark ones at the border of the mask.
    Their normals would be steep walls of the surface, which cast shadows on what is beside them."""
    brightness = np.quantile(data.luminance, BRIGHT, axis=1)
    dark = np.zeros(np.add(data.mask.shape, 2), bool)
    dark[1:-1, 1:-1] = data.image(brightness < UNLIT * np.median(brightness))
    outside = np.pad(~data.mask, 1, constant_values=True)
    found = ndimage.binary_propagation(outside, mask=outside | dark)[1:-1, 1:-1][data.mask]
    return found if found.mean() <= MOST_UNLIT else np.zeros_like(found)


class Rendering:
    """Renders the images of a data set from a guess and a depth.

    What became garbage, such as the one before, is collected first: it may be large.

    max_depth : longest path: 2 is direct light, 3 adds one interreflection.
    lights : number of lights that are rendered at a time, the first ones until others are chosen. 0: all.
    several, base_eta : of guesses with a diffuse colour of each pixel, see `Guess`.

    Raises
    ------
    ValueError : the pixels of the camera are not square; so many lights there are not; or they are at finite
        distances, of which all are rendered.
    """

    def __init__(
        self,
        data: Dataset,
        lobes: ggx.Lobes,
        *,
        max_depth: int = 3,
        lights: int = 0,
        several: bool = False,
        base_eta: float = np.nan,
    ):
        gc.collect()
        if not 0 <= lights <= len(data.lights) or (lights and data.near):
            raise InputError(
                f"ps: cannot render {lights} of {len(data.lights)} lights at a time"
                + (", they are at finite distances" if data.near else "")
            )
        self.chosen = np.arange(lights or len(data.lights))
        self.data, self.domain, self.lobes, self.max_depth = data, Domain(data), lobes, max_depth
        vertices, faces = self.domain.mesh(np.ones(self.domain.wide.sum()))
        Q = len(vertices)
        self.several = several
        base = "vertex_base" if several else None
        bsdf = bsdf_of(lobes, np.zeros((len(lobes), 3)), scale="vertex_albedo", base=base, eta=base_eta)
        colours = {"vertex_albedo": np.ones((Q, 1))} | ({"vertex_base": np.ones((Q, 3))} if several else {})
        mesh = make_mesh("object", vertices, faces, bsdf=bsdf, attributes=colours)
        self.scene = mi.load_dict({"type": "scene", "object": mesh, "sensor": self._sensor(), **self._lights()})
        self.params = mi.traverse(self.scene)
        # The camera sees points that move along its rays: no edge moves on the film
        rig = {"type": "rig", "rr_depth": 99, "sppp": 0}
        self.integrators = {d: mi.load_dict({**rig, "max_depth": d}) for d in {2, max_depth}}
        self.bounces = mi.load_dict({**rig, "max_depth": max_depth, "min_depth": 3})
        self.fixed_shadows = mi.load_dict({**rig, "max_depth": max_depth, "sppi": 0})

    # ---------------------- Scene ----------------------

    def key(self, name: str) -> str:
        """Of a parameter that ends so; positions and normals have shorter names in Mitsuba 3.10."""
        names = (name, name.removeprefix("vertex_"))
        return next(k for k in self.params.keys() if k.endswith(names))  # noqa: SIM118

    def _set(self, name: str, leaf: mi.Float | mi.TensorXf) -> None:
        """A parameter from its numbers, flat or as they are kept; attached if they are."""
        now = self.params[self.key(name)]
        self.params[self.key(name)] = leaf if type(leaf) is type(now) else type(now)(leaf, now.shape)

    def _sensor(self) -> dict:
        H, W = self.data.mask.shape
        film = {"type": "hdrfilm", "width": W, "height": H, "pixel_format": "rgb", "rfilter": {"type": "box"}}
        T = mi.ScalarTransform4f
        if self.data.camera is None:
            # In the padded image, the first pixel is (1, 1)
            x, y, far = 1 + (W - 1) / 2, -1 - (H - 1) / 2, FAR * max(H, W)
            look = T().look_at(origin=[x, y, far], target=[x, y, 0], up=[0, 1, 0])
            scale = T().scale([W / 2, W / 2, 1])
            return {
                "type": "orthographic",
                "to_world": look @ scale,
                "near_clip": 1e-3 * far,
                "far_clip": 1e3 * far,
                "film": film,
            }
        K = self.data.camera
        if (off := max(abs(K[1, 1] / K[0, 0] - 1) * H, abs(K[0, 1] / K[1, 1]) * H) / 2) > SKEWED:
            raise InputError(
                f"ps: the camera's pixels are not square: rendered, its images would be {off:.1f} pixels off; "
                "resample them"
            )
        return {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2 * np.arctan(W / 2 / K[0, 0]))),
            # Mitsuba's offsets are those of the image from the principal point
            "principal_point_offset_x": float(0.5 - (K[0, 2] + 0.5) / W),
            "principal_point_offset_y": float(0.5 - (K[1, 2] + 0.5) / H),
            "to_world": T().look_at(origin=[0, 0, 0], target=[0, 0, -1], up=[0, 1, 0]),
            "near_clip": 1e-3 * self.domain.distance,
            "far_clip": 1e3 * self.domain.distance,
            "film": film,
        }

    def _lights(self) -> dict:
        if self.data.near:
            return leds.emitters(self.data.lights)
        return {
            "lights": {
                "type": "distant_lights",
                "directions": mi.TensorXf(self.data.lights[self.chosen].astype(np.float32)),
            }
        }

    def choose(self, lights: np.ndarray) -> None:
        """Render these from the next `update` on, as many as before: their numbers."""
        self.chosen = lights

    def update(self, guess: Guess, depth: np.ndarray) -> None:
        """Take over a guess, and the depth of the Q pixels of the domain, as `integrate` has it."""
        nearest = self.domain.nearest
        self.leaves = {
            "vertex_positions": own(self.domain.mesh(depth)[0]),
            "vertex_normals": own(guess.normals[nearest]),
            "vertex_albedo": own(guess.albedo[nearest]),
            "weights": mi.TensorXf(own(guess.weights), guess.weights.shape),
        }
        if self.several:
            self._set("vertex_base", own(guess.base[nearest]))
        self._put()
        if self.data.near:
            for k, s in enumerate(guess.exposures):
                self.params[f"led{k}.intensity.value"] = mi.Color3f(s)
        else:
            self.params["lights.directions"] = mi.TensorXf(self.data.lights[self.chosen].astype(np.float32))
            irradiance = np.repeat(guess.exposures[self.chosen, None], 3, 1).astype(np.float32)
            self.params["lights.irradiance"] = mi.TensorXf(irradiance)
        self.params.update()

    def _put(self) -> None:
        """Hand the leaves to the scene: the positions first, an update of which makes normals anew."""
        for name, leaf in self.leaves.items():
            self._set(name, leaf)
            if name == "vertex_positions":
                self.params.update()
        self.params.update()

    # ---------------------- Images ----------------------

    def image(self, *, spp: int, seed: int, max_depth: int | None = None) -> np.ndarray:
        """(P, K, 3)"""
        return self._image(self.integrators[max_depth or self.max_depth], spp, seed)

    def indirect(self, *, spp: int, seed: int) -> np.ndarray:
        """Of `image`, what has been reflected more than once: (P, K, 3)."""
        return self._image(self.bounces, spp, seed)

    def _image(self, integrator: mi.Integrator, spp: int, seed: int) -> np.ndarray:
        image = integrator.render(self.scene, seed=seed, spp=spp)
        return np.asarray(image).reshape(*self.data.mask.shape, -1, 3)[self.data.mask]

    def gradient(
        self, adjoint: np.ndarray, *, spp: int, seed: int, depth: bool = False, adaptive: bool = False
    ) -> dict[str, np.ndarray]:
        """Of a loss, given its derivatives with respect to the values, (P, K, 3), through all bounces.

        spp : samples per pixel. Unbiased if `seed` is not that of the images from which `adjoint` was made.
        depth : with respect to depth, too, with the edges of shadows sampled.
        adaptive : camera paths go to pixels in proportion to their part of `adjoint`, but for a tenth of the paths.

        Returns
        -------
        "normals", (P, 3), "albedo", (P,), "weights", (B, 3), and "depth", (Q,), in which shadows move under the lights.
        Of indirect light, the derivative lacks what edges do, and the jumps where normals turn away from what their
        triangles still see: of a bowl 16 pixels wide, 2 to 4 % of it with respect to depth, less of finer ones.
        """
        H, W = self.data.mask.shape
        images = np.zeros((H, W, *adjoint.shape[1:]), np.float32)
        images[self.data.mask] = adjoint
        wanted = {k: v for k, v in self.leaves.items() if depth or k != "vertex_positions"}
        dr.enable_grad(wanted)
        self._put()
        integrator = self.integrators[self.max_depth] if depth else self.fixed_shadows
        if adaptive and adjoint.any():
            error = np.zeros((H, W))
            error[self.data.mask] = np.sqrt(np.square(adjoint).sum((1, 2)))
            integrator.pixel_density = own(error + EVEN * error[self.data.mask].mean() * self.data.mask)
        grad_in = mi.TensorXf(images.reshape(H, W, -1))
        try:
            integrator.render_backward(self.scene, self.params, grad_in, seed=seed, spp=spp)
        finally:
            integrator.pixel_density = None
        found = {k: np.array(dr.grad(v), np.float64) for k, v in wanted.items()}
        dr.disable_grad(wanted)
        self._put()
        nearest, inner = self.domain.nearest, self.domain.inner
        total = lambda x: np.stack(
            [np.bincount(nearest, column, len(inner)) for column in x.reshape(len(nearest), -1).T], 1
        )
        result = {
            "normals": total(found["vertex_normals"]),
            "albedo": total(found["vertex_albedo"])[:, 0],
            "weights": found["weights"].reshape(self.leaves["weights"].shape),
        }
        if depth:
            one = np.ones(len(nearest))
            rays = self.domain.mesh(2 * one)[0] - self.domain.mesh(one)[0]  # by which points move with depth
            result["depth"] = (found["vertex_positions"].reshape(-1, 3) * rays).sum(1)
        return result

    @no_collection()
    def visible(self, lighting: Lighting) -> np.ndarray:
        """Which lights the surface does not hide from its pixels: (P, K), bool."""
        P, K = lighting.P, lighting.K
        p = dr.arange(mi.UInt32, P)
        inner = dr.gather(mi.UInt32, mi.UInt32(self.domain.inner.astype(np.uint32)), p)
        load = lambda kind, name: dr.gather(kind, self.leaves[name], inner)
        point, normal = load(mi.Point3f, "vertex_positions"), load(mi.Vector3f, "vertex_normals")
        pixel = 1.0 if self.data.camera is None else dr.abs(point.z) / float(self.data.camera[0, 0])
        origin = mi.Point3f(point + normal * (ABOVE * pixel))
        found = dr.zeros(mi.UInt8, P * K)

        def body(k):
            direction, _ = lighting.light(k, point)
            hidden = self.scene.ray_test(mi.Ray3f(origin, direction, lighting.distance(k, point), 0.0, []))
            dr.scatter(found, mi.UInt8(dr.select(hidden, mi.UInt32(0), mi.UInt32(1))), p * K + k)
            return (k + 1,)

        dr.while_loop((dr.zeros(mi.UInt32, P),), lambda k: k < K, body, label="lights")
        return np.array(found).reshape(P, K).astype(bool)
