"""What surfaces reflect of the lights without detours, and its fit: normals and albedos pixel by pixel, one BSDF.

The model of the value of pixel p under light k, a colour:

    V_pk s_k a_p E_pk f(n_p; l_pk, v_p) max(n_p · l_pk, 0) + I_pk

with exposure s, albedo a (of pixels, relative to the BSDF), irradiance E over the intensity of the light, visibility V,
and indirect light I. Given the BSDF f, each pixel has three unknowns, found by damped Gauss-Newton steps; given these,
the weights of a dictionary are a non-negative least squares problem. Residuals count by Huber's loss.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.optimize import nnls

from rimlight import ggx

from .dataset import Dataset, unit

#: Step of the finite differences by which normals are turned, radians.
TURN = 1e-3

#: Longest step of a normal, radians; damping of its diagonal; range of the albedo of a pixel.
LONGEST, DAMPING, ALBEDOS = 0.2, 1.02, (0.02, 20.0)

#: Residuals count fully up to this part of the median value of the data set.
HUBER = 0.05

#: Of what the squares would be without it, a diffuse lobe under a coat must leave at most this. It is much like a
#: Lambertian one on normals that lean a little: otherwise it would be taken for all sorts of small errors.
EVIDENCE = 0.78

#: Pixels from which the BSDF is found; and by how much the diagonal of its equations is raised.
SAMPLED, RIDGE = 2000, 1e-6


@dataclass
class Guess:
    """What is sought, but depth. normals : (P, 3). albedo : (P,). exposures : (K,). weights : (B, 3), of the BSDF."""

    normals: np.ndarray
    albedo: np.ndarray
    exposures: np.ndarray
    weights: np.ndarray


class DirectModel:
    """The model above for a data set, at given positions.

    points : (P, 3), in the unit of the LEDs, or with lights at infinity in any; None for these and an orthographic
        camera.
    counts : (P, K): how much each value counts, in [0, 1].
    indirect : (P, K, 3), or None.
    """

    def __init__(
        self,
        data: Dataset,
        lobes: ggx.Lobes,
        *,
        points: np.ndarray | None = None,
        counts: np.ndarray | None = None,
        indirect: np.ndarray | None = None,
    ):
        self.P, self.K, _ = data.values.shape
        self.lobes, self.near = lobes, data.near
        lit = data.values[data.values > 0]
        self.scale = float(np.median(lit)) if lit.size else 1.0
        self.values = own(data.values)
        self.counts = own(np.ones((self.P, self.K)) if counts is None else counts)
        self.indirect = None if indirect is None else own(indirect)
        self.points = own(np.zeros((self.P, 3)) if points is None else points)
        self.perspective = data.camera is not None
        if data.near:
            self.lights = own(np.array([[*led.position, *led.axis, led.mu] for led in data.lights]))
        else:
            self.lights = own(data.lights)

    # ---------------------- The model ----------------------

    def view(self, point: mi.Point3f) -> mi.Vector3f:
        """Unit directions from points towards the camera."""
        return -dr.normalize(mi.Vector3f(point)) if self.perspective else mi.Vector3f(0, 0, 1)

    def light(self, k: mi.UInt32, point: mi.Point3f) -> tuple[mi.Vector3f, mi.Float]:
        """Unit directions from points towards lights, and irradiance of a surface that faces them, for an intensity
        of 1."""
        if not self.near:
            return dr.gather(mi.Vector3f, self.lights, k), mi.Float(1)
        offset = self._of_led(k, 0) - point
        distance = dr.norm(offset)
        direction = offset / distance
        cos = dr.maximum(-dr.dot(dr.normalize(self._of_led(k, 3)), direction), 0)
        mu = dr.gather(mi.Float, self.lights, 7 * k + 6)
        return direction, dr.select(mu > 0, cos**mu, 1) / dr.square(distance)

    def distance(self, k: mi.UInt32, point: mi.Point3f) -> mi.Float:
        """From points to lights. At infinity: the largest number."""
        return dr.norm(self._of_led(k, 0) - point) if self.near else dr.largest(mi.Float)

    def _of_led(self, k: mi.UInt32, first: int) -> mi.Vector3f:
        return mi.Vector3f(*(dr.gather(mi.Float, self.lights, 7 * k + first + i) for i in range(3)))

    def mean_directions(self) -> np.ndarray:
        """Towards the lights, from the middle of the surface: (K, 3)."""
        lights = np.array(self.lights, np.float64).reshape(self.K, -1)[:, :3]
        return unit(lights - np.array(self.points).reshape(-1, 3).mean(0)) if self.near else lights

    def lighting(self) -> tuple[np.ndarray, np.ndarray]:
        """What `light` says of all pixels and lights: directions, (K, 3), of near lights (P, K, 3); irradiance, (1, K),
        of near lights (P, K)."""
        P = self.P if self.near else 1
        p, k = self._pairs(np.arange(P))
        direction, irradiance = self.light(k, dr.gather(mi.Point3f, self.points, p))
        directions = np.array(direction, np.float64).T.reshape(P, self.K, 3)
        irradiance = np.broadcast_to(np.array(irradiance, np.float64), P * self.K).reshape(P, self.K)
        return directions if self.near else directions[0], irradiance

    def _reflected(self, bsdf: mi.BSDF, n, v, direction) -> mi.Color3f:
        frame = mi.Frame3f(n)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = frame.to_local(v)
        return bsdf.eval(mi.BSDFContext(), si, frame.to_local(direction))

    def predicted(self, guess: Guess, pixels: np.ndarray | None = None) -> np.ndarray:
        """Values of the model for some pixels, default all: (P, K, 3)."""
        pixels = np.arange(self.P) if pixels is None else pixels
        p, k = self._pairs(pixels)
        point = dr.gather(mi.Point3f, self.points, p)
        n = dr.gather(mi.Vector3f, own(guess.normals), p)
        direction, irradiance = self.light(k, point)
        scale = dr.gather(mi.Float, own(guess.albedo), p) * dr.gather(mi.Float, own(guess.exposures), k)
        found = self._reflected(bsdf_of(self.lobes, guess.weights), n, self.view(point), direction)
        found *= scale * irradiance
        if self.indirect is not None:
            found += dr.gather(mi.Color3f, self.indirect, p * self.K + k)
        return np.array(found).T.reshape(len(pixels), self.K, 3)

    def _pairs(self, pixels: np.ndarray) -> tuple[mi.UInt32, mi.UInt32]:
        """Each of the pixels with each light."""
        number = dr.arange(mi.UInt32, len(pixels) * self.K)
        row = number // self.K
        return dr.gather(mi.UInt32, mi.UInt32(pixels.astype(np.uint32)), row), number - row * self.K

    # ---------------------- Normals and albedos ----------------------

    def fit_normals(self, guess: Guess, *, steps: int = 3, free_albedo: bool = True) -> None:
        """Gauss-Newton steps of every pixel, in place."""
        normals, albedo = own(guess.normals), own(guess.albedo)
        exposures, bsdf = own(guess.exposures), bsdf_of(self.lobes, guess.weights)
        for _ in range(steps):
            normals, albedo = self._step(normals, albedo, exposures, bsdf, free_albedo)
        guess.normals = np.array(normals, np.float64).reshape(-1, 3)
        guess.albedo = np.array(albedo, np.float64)

    def _step(self, normals, albedo, exposures, bsdf, free_albedo: bool) -> tuple[mi.Float, mi.Float]:
        p = dr.arange(mi.UInt32, self.P)
        n, a = dr.gather(mi.Vector3f, normals, p), dr.gather(mi.Float, albedo, p)
        point = dr.gather(mi.Point3f, self.points, p)
        v = self.view(point)
        frame = mi.Frame3f(n)
        turned = [dr.normalize(n + TURN * t) for t in (frame.s, frame.t)]
        threshold = dr.opaque(mi.Float, HUBER * self.scale)
        # Of values that are tiny, as under LEDs in millimetres, the determinant of products would be 0
        unit = dr.opaque(mi.Float, 1 / max(self.scale, 1e-15) ** 2)

        def body(k, *sums):
            direction, irradiance = self.light(k, point)
            entry = p * self.K + k
            scale = dr.gather(mi.Float, exposures, k) * irradiance
            f = self._reflected(bsdf, n, v, direction) * scale
            residual = dr.gather(mi.Color3f, self.values, entry) - a * f
            if self.indirect is not None:
                residual -= dr.gather(mi.Color3f, self.indirect, entry)
            columns = [(self._reflected(bsdf, t, v, direction) * scale - f) * (a / TURN) for t in turned]
            columns.append(f)
            size = dr.norm(mi.Vector3f(residual))
            w = dr.gather(mi.Float, self.counts, entry) * dr.minimum(1, threshold / dr.maximum(size, 1e-20)) * unit
            products = [w * dr.sum(columns[i] * columns[j]) for i in range(3) for j in range(i, 3)]
            products += [w * dr.sum(c * residual) for c in columns]
            return k + 1, *(s + x for s, x in zip(sums, products, strict=True))

        state = (dr.zeros(mi.UInt32, self.P), *(dr.zeros(mi.Float, self.P) for _ in range(9)))
        _, uu, uv, ua, vv, va, aa, bu, bv, ba = dr.while_loop(state, lambda k, *_: k < self.K, body, label="lights")
        if not free_albedo:
            ua, va, ba, aa = mi.Float(0), mi.Float(0), mi.Float(0), mi.Float(1)
        raised = lambda x: x * DAMPING + 1e-12
        M = mi.Matrix3f([[raised(uu), uv, ua], [uv, raised(vv), va], [ua, va, raised(aa)]])
        x = dr.rcp(M) @ mi.Vector3f(bu, bv, ba)
        x = dr.select(dr.all(dr.isfinite(x)), x, 0)  # no value of the pixel counts: it stays as it is
        length = dr.hypot(x.x, x.y)
        x *= dr.minimum(1, LONGEST / dr.maximum(length, 1e-20))
        n = dr.normalize(n + x.x * frame.s + x.y * frame.t)
        # What the camera sees faces it
        away = dr.maximum(-dr.dot(n, v), 0) + 1e-3
        n = dr.select(dr.dot(n, v) > 1e-3, n, dr.normalize(n + away * v))
        result = dr.ravel(n), dr.clip(a + x.z, *ALBEDOS)
        dr.eval(result)
        return result

    # ---------------------- BSDF ----------------------

    def fit_bsdf(self, guess: Guess, rng: np.random.Generator, *, coat: bool | None = None) -> None:
        """Weights of the dictionary by non-negative least squares with a sum of at most 1, in place.

        coat : may diffuse light be that under a coat? None: if there is evidence.

        Normals lean to make up for a wrong BSDF, and the BSDF for wrong normals. So it is found as it would be if the
        normals followed: what turns of them explain is left out (variable projection, Golub and Pereyra 1973).
        """
        pixels = rng.choice(self.P, min(SAMPLED, self.P), replace=False)
        count, B = len(pixels), len(self.lobes)
        p, k = self._pairs(pixels)
        point = dr.gather(mi.Point3f, self.points, p)
        normal, view = dr.gather(mi.Vector3f, own(guess.normals), p), self.view(point)
        direction, irradiance = self.light(k, point)
        scale = dr.gather(mi.Float, own(guess.albedo), p) * dr.gather(mi.Float, own(guess.exposures), k) * irradiance

        def design(n: mi.Vector3f) -> np.ndarray:
            frame = mi.Frame3f(n)
            wo = frame.to_local(direction)
            factor = scale * dr.maximum(wo.z, 0)
            return np.array([f * factor for f in ggx.lobes(self.lobes, frame.to_local(view), wo)], np.float64).T

        frame = mi.Frame3f(normal)
        D = design(normal)  # (count K, B)
        entry = p * self.K + k
        values, counts = dr.gather(mi.Color3f, self.values, entry), dr.gather(mi.Float, self.counts, entry)
        if self.indirect is not None:
            values -= dr.gather(mi.Color3f, self.indirect, entry)
        values, counts = np.array(values, np.float64).T, np.array(counts, np.float64)
        residual = values - D @ guess.weights
        counts *= np.minimum(1, HUBER * self.scale / np.maximum(np.linalg.norm(residual, axis=1), 1e-20))
        turned = [(design(dr.normalize(normal + TURN * t)) - D) @ guess.weights / TURN for t in (frame.s, frame.t)]
        per_pixel = (a.reshape(count, self.K, *a.shape[1:]) for a in (D, np.stack(turned, -1), values, counts))
        gram, moments, squares = without_turns(*per_pixel)
        colours = values.shape[1]

        def solved(wanted: np.ndarray) -> tuple[float, np.ndarray]:
            """What is left of the squares, and weights, with these lobes."""
            i, x = np.flatnonzero(np.tile(wanted, colours)), np.zeros(colours * B)
            x[i] = simplex_least_squares(gram[np.ix_(i, i)], moments[i], colours)
            return squares + x @ gram @ x - 2 * moments @ x, x.reshape(colours, B).T

        alpha, eta = np.array(self.lobes.alpha), np.array(self.lobes.eta)
        coated = np.isnan(alpha) & ~np.isnan(eta)
        left, guess.weights = solved(~coated)
        if coat is not False and coated.any():
            with_coat, weights = solved(~np.zeros_like(coated))
            if coat or with_coat < EVIDENCE * left:
                guess.weights = weights


def without_turns(
    lobes: np.ndarray, turns: np.ndarray, values: np.ndarray, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Normal equations of weights x, (C B,) for C colours, as if the normals of all pixels followed.

    lobes : (P, K, B). turns : changes of the values as normals turn, (P, K, C, 2). values : (P, K, C). counts : (P, K).

    Returns
    -------
    gram, moments, squares : `x @ gram @ x - 2 moments @ x + squares` is what is left of the squares.
    """
    (P, _, B), colours = lobes.shape, values.shape[2]
    weighted = lobes * counts[..., None]
    counted = turns * counts[..., None, None]
    A = np.einsum("pkci,pkcj->pij", counted, turns)
    A[:, [0, 1], [0, 1]] = A[:, [0, 1], [0, 1]] * DAMPING + 1e-20
    of_lobes = np.stack([np.swapaxes(lobes, 1, 2) @ counted[:, :, c] for c in range(colours)], 1)
    of_lobes = of_lobes.reshape(P, colours * B, 2)
    of_values = np.einsum("pkci,pkc->pi", counted, values)
    explained = np.linalg.solve(A, np.swapaxes(of_lobes, 1, 2))  # (P, 2, C B)
    gram = np.kron(np.eye(colours), np.tensordot(weighted, lobes, ((0, 1), (0, 1))))
    gram -= np.tensordot(of_lobes, explained, ((0, 2), (0, 1)))
    moments = np.tensordot(values, weighted, ((0, 1), (0, 1))).ravel() - np.tensordot(of_values, explained, 2)
    squares = (counts[..., None] * values**2).sum()
    return gram, moments, float(squares - (of_values * np.linalg.solve(A, of_values[..., None])[..., 0]).sum())


def simplex_least_squares(gram: np.ndarray, moments: np.ndarray, colours: int = 1) -> np.ndarray:
    """Non-negative x, (colours B,), that minimises `x @ gram @ x - 2 moments @ x`, slightly regularised, while each of
    `colours` equal parts of it sums to at most 1.

    gram : (colours B, colours B), positive semidefinite. moments : (colours B,).
    """
    size = np.sqrt(np.diag(gram)) + 1e-30
    root = np.linalg.cholesky(gram / size / size[:, None] + RIDGE * np.eye(len(moments))).T * size
    target = np.linalg.solve(root.T, moments)
    # A black lobe of each colour takes what is left of 1
    heavy = 1e3 * np.linalg.norm(target) + 1e-30
    sums = np.kron(np.eye(colours), np.full((1, len(moments) // colours), heavy))
    A = np.block([[root, np.zeros((len(moments), colours))], [sums, heavy * np.eye(colours)]])
    x, _ = nnls(A, np.append(target, np.full(colours, heavy)), maxiter=20 * A.shape[1])
    x = x[: len(moments)].reshape(colours, -1)
    return (x / np.maximum(x.sum(1, keepdims=True), 1)).ravel()


def bsdf_of(lobes: ggx.Lobes, weights: np.ndarray, scale: str | None = None) -> mi.BSDF:
    """A `ggx_dictionary`. scale : attribute of a mesh, with which it is multiplied."""
    return mi.load_dict(
        {
            **({} if scale is None else {"scale": {"type": "mesh_attribute", "name": scale}}),
            "type": "ggx_dictionary",
            "alpha": mi.Float(list(lobes.alpha)),
            "eta": mi.Float(list(lobes.eta)),
            "weights": mi.TensorXf(np.asarray(weights, np.float32)),
        }
    )


def own(array: np.ndarray) -> mi.Float:
    """Numbers in Dr.Jit's own memory, flat."""
    found = mi.Float(np.asarray(array, np.float32).ravel())
    dr.make_opaque(found)
    return found
