"""What surfaces reflect of the lights without detours, and its fit: what is a pixel's own, and what pixels share.

The model of the value of pixel p under light k, a colour:

    V_pk s_k E_pk (a_p f(n_p; l_pk, v_p) + b_p g(n_p; l_pk, v_p)) max(n_p · l_pk, 0) + I_pk

with exposure s, irradiance E over the intensity of the light, visibility V, and indirect light I. Of one material, a is
the albedo of pixels, relative to the BSDF f, and b is 0. Of several under one glaze, a is 1, or 0 where there is no
glaze, f has glossy lobes only, and b is the colour of a diffuse lobe g, a pixel's own (Lambertian, or under a smooth
coat). Given f, each pixel has three unknowns, or five, found by damped Gauss-Newton steps; given these, the weights of
a dictionary are a non-negative least squares problem. Residuals count by Huber's loss.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from rimlight import ggx

from .dataset import Dataset
from .vectors import unit

#: Step of the finite differences by which normals are turned, radians.
TURN = 1e-3

#: Longest step of a normal, radians; damping of its diagonal; range of the albedo of a pixel.
LONGEST, DAMPING, ALBEDOS = 0.2, 1.02, (0.02, 20.0)

#: Residuals count fully up to this part of the median value of the data set.
HUBER = 0.05

#: Largest diffuse colour of a pixel. Above 1, for the scale of the images may be a guess.
LIGHTEST = 4.0

#: Pixels from which the BSDF is found, and of which matrices are multiplied at a time; and by how much the diagonal of
#: its equations is raised.
SAMPLED, BLOCK, RIDGE = 2000, 100, 1e-6


@dataclass
class Guess:
    """What is sought, but depth. normals : (P, 3). albedo : (P,); of several materials, 1 where the glaze is, else 0.
    exposures : (K,). weights : (B, 3), of the BSDF. base : (P, 3), the diffuse colours of several materials under one
    glaze, or None, of one material. base_eta : the index of refraction of the coat over them; NaN: they are
    Lambertian."""

    normals: np.ndarray
    albedo: np.ndarray
    exposures: np.ndarray
    weights: np.ndarray
    base: np.ndarray | None = None
    base_eta: float = np.nan

    def of(self, pixels: np.ndarray) -> Guess:
        """What is said of some pixels: their numbers, or a mask."""
        base = None if self.base is None else self.base[pixels]
        return replace(self, normals=self.normals[pixels], albedo=self.albedo[pixels], base=base)


class Lighting:
    """The lights of a data set, at infinity or near."""

    def __init__(self, data: Dataset):
        self.P, self.K, _ = data.values.shape
        self.near = data.near
        if data.near:
            self.lights = own(np.array([[*led.position, *led.axis, led.mu] for led in data.lights]))
        else:
            self.lights = own(data.lights)

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


class DirectModel(Lighting):
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
        super().__init__(data)
        self.lobes, self.scale = lobes, data.typical
        self.values = own(data.values)
        self.counts = own(np.ones((self.P, self.K), np.float32) if counts is None else counts)
        self.indirect = None if indirect is None else own(indirect)
        self.points = own(np.zeros((self.P, 3)) if points is None else points)
        self.perspective = data.camera is not None

    # ---------------------- The model ----------------------

    def view(self, point: mi.Point3f) -> mi.Vector3f:
        """Unit directions from points towards the camera."""
        return -dr.normalize(mi.Vector3f(point)) if self.perspective else mi.Vector3f(0, 0, 1)

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
        if guess.base is not None:
            colour = dr.gather(mi.Color3f, own(guess.base), p) * dr.gather(mi.Float, own(guess.exposures), k)
            found += colour * irradiance * diffuse(guess.base_eta, n, self.view(point), direction)
        if self.indirect is not None:
            found += dr.gather(mi.Color3f, self.indirect, p * self.K + k)
        return np.array(found).T.reshape(len(pixels), self.K, 3)

    def _pairs(self, pixels: np.ndarray) -> tuple[mi.UInt32, mi.UInt32]:
        """Each of the pixels with each light."""
        number = dr.arange(mi.UInt32, len(pixels) * self.K)
        row = number // self.K
        return dr.gather(mi.UInt32, mi.UInt32(pixels.astype(np.uint32)), row), number - row * self.K

    # ---------------------- Of each pixel ----------------------

    def losses(self, guess: Guess) -> np.ndarray:
        """Huber's, of what is left of the values of each pixel, (P,)."""
        exposures, bsdf, p = own(guess.exposures), bsdf_of(self.lobes, guess.weights), dr.arange(mi.UInt32, self.P)
        normals, albedo = dr.gather(mi.Vector3f, own(guess.normals), p), dr.gather(mi.Float, own(guess.albedo), p)
        base = None if guess.base is None else dr.gather(mi.Color3f, own(guess.base), p)
        pixel, threshold = _Pixel(self, guess.base_eta, normals, albedo, base), dr.opaque(mi.Float, HUBER * self.scale)

        def body(k, loss):
            direction, irradiance = self.light(k, pixel.point)
            scale = dr.gather(mi.Float, exposures, k) * irradiance
            x = self._left(p * self.K + k, self._parts(pixel, bsdf, pixel.n, direction, scale)[1])
            x = dr.norm(mi.Vector3f(x)) / threshold
            return k + 1, loss + dr.gather(mi.Float, self.counts, p * self.K + k) * dr.select(x < 1, x * x / 2, x - 0.5)

        begun = dr.zeros(mi.UInt32, self.P), dr.zeros(mi.Float, self.P)
        return np.array(dr.while_loop(begun, lambda k, *_: k < self.K, body, label="losses")[1])

    def _parts(self, pixel: _Pixel, bsdf: mi.BSDF, n, direction, scale) -> tuple[mi.Color3f, mi.Color3f]:
        """Without colour and albedo: what is linear in them; and with these, all."""
        f = self._reflected(bsdf, n, pixel.view, direction) * scale
        if pixel.base is None:
            return f, pixel.a * f
        g = diffuse(pixel.base_eta, n, pixel.view, direction) * scale
        return g, pixel.a * f + pixel.base * g

    def _left(self, entry: mi.UInt32, total: mi.Color3f) -> mi.Color3f:
        """Of a value, without what is reflected directly and indirectly."""
        left = dr.gather(mi.Color3f, self.values, entry) - total
        return left if self.indirect is None else left - dr.gather(mi.Color3f, self.indirect, entry)

    def fit_normals(self, guess: Guess, *, steps: int = 3, free_albedo: bool = True, turn: bool = True) -> None:
        """Gauss-Newton steps of every pixel, in place: of its normal, and its albedo or its colour.

        turn : False holds the normals, and fits the rest.
        """
        exposures, bsdf = own(guess.exposures), bsdf_of(self.lobes, guess.weights)
        p, most = dr.arange(mi.UInt32, self.P), dr.opaque(mi.UInt32, steps)
        normals, albedo = dr.gather(mi.Vector3f, own(guess.normals), p), dr.gather(mi.Float, own(guess.albedo), p)
        linear = albedo if guess.base is None else dr.gather(mi.Color3f, own(guess.base), p)

        def body(i, normals, linear):
            pixel = _Pixel(self, guess.base_eta, normals, *((linear,) if guess.base is None else (albedo, linear)))
            return i + 1, *pixel.stepped(self._sums(pixel, exposures, bsdf), free_albedo=free_albedo, turn=turn)

        # A loop of Dr.Jit, for it takes longer to trace a step than to make it
        begun = dr.zeros(mi.UInt32, self.P), normals, linear
        _, normals, linear = dr.while_loop(begun, lambda i, *_: i < most, body, label="steps")
        dr.eval(normals, linear)
        guess.normals, found = np.array(normals, np.float64).T, np.array(linear, np.float64).T
        if guess.base is None:
            guess.albedo = found
        else:
            guess.base = found

    def _sums(self, pixel: _Pixel, exposures: mi.Float, bsdf: mi.BSDF) -> list[mi.Float]:
        """Over the lights, of what the equations of `_Pixel.stepped` are made: products of the two derivatives with
        respect to turns and of the residual; then those with the derivatives with respect to what is linear."""
        p = pixel.number
        coloured = pixel.base is not None
        turned = [dr.normalize(pixel.n + TURN * t) for t in (pixel.frame.s, pixel.frame.t)]
        threshold = dr.opaque(mi.Float, HUBER * self.scale)
        # Of values that are tiny, as under LEDs in millimetres, the determinant of products would be 0
        unit = dr.opaque(mi.Float, 1 / max(self.scale, 1e-15) ** 2)

        def body(k, *sums):
            direction, irradiance = self.light(k, pixel.point)
            entry = p * self.K + k
            scale = dr.gather(mi.Float, exposures, k) * irradiance
            parts = lambda n: self._parts(pixel, bsdf, n, direction, scale)
            linear, total = parts(pixel.n)
            residual = self._left(entry, total)
            columns = [(parts(t)[1] - total) / TURN for t in turned]
            size = dr.norm(mi.Vector3f(residual))
            w = dr.gather(mi.Float, self.counts, entry) * dr.minimum(1, threshold / dr.maximum(size, 1e-20)) * unit
            u, t = columns
            products = [w * dr.sum(x) for x in (u * u, u * t, t * t, u * residual, t * residual)]
            if coloured:  # each colour has an unknown of its own
                products += [w * linear * linear]
                products += [w * linear * x[c] for x in (u, t, residual) for c in range(3)]
            else:
                products += [w * dr.sum(linear * x) for x in (linear, u, t, residual)]
            return k + 1, *(s + x for s, x in zip(sums, products, strict=True))

        state = (dr.zeros(mi.UInt32, self.P), *(dr.zeros(mi.Float, self.P) for _ in range(15 if coloured else 9)))
        return list(dr.while_loop(state, lambda k, *_: k < self.K, body, label="lights"))[1:]

    # ---------------------- BSDF ----------------------

    def wanted(self, guess: Guess, coat: bool) -> np.ndarray:
        """Which lobes a material may have, (B,), bool. coat : may diffuse light be that under a coat?"""
        alpha, eta = np.array(self.lobes.alpha), np.array(self.lobes.eta)
        return ~np.isnan(alpha) if guess.base is not None else ~(np.isnan(alpha) & ~np.isnan(eta)) | coat

    def of_lobes(self, guess: Guess, pixels: np.ndarray) -> np.ndarray:
        """Values of some pixels for a weight of 1 of each lobe, (P', K, B)."""
        p, k = self._pairs(pixels)
        point, frame = dr.gather(mi.Point3f, self.points, p), mi.Frame3f(dr.gather(mi.Vector3f, own(guess.normals), p))
        direction, irradiance = self.light(k, point)
        wi, wo = frame.to_local(self.view(point)), frame.to_local(direction)
        scale = dr.gather(mi.Float, own(guess.albedo), p) * dr.gather(mi.Float, own(guess.exposures), k) * irradiance
        factor = scale * dr.maximum(wo.z, 0)
        found = [f * factor for f in ggx.lobes(self.lobes, wi, wo)]
        dr.eval(found)  # in one kernel: NumPy would ask for one array after the other
        return np.stack([f.numpy() for f in found], 1).astype(np.float64).reshape(len(pixels), self.K, len(self.lobes))

    def fit_bsdf(self, guess: Guess, rng: np.random.Generator, *, coat: bool = False, turn: bool = True) -> None:
        """Weights of the dictionary by non-negative least squares with a sum of at most 1, in place; where pixels have
        a diffuse colour of their own, only those of glossy lobes.

        coat : may diffuse light be that under a coat? turn : may normals?

        Normals lean to make up for a wrong BSDF, and the BSDF for wrong normals. So it is found as it would be if the
        normals followed, and the colours: what these explain is left out (variable projection, Golub and Pereyra 1973).
        """
        pixels = rng.choice(self.P, min(SAMPLED, self.P), replace=False)
        count, B = len(pixels), len(self.lobes)
        p, k = self._pairs(pixels)
        point = dr.gather(mi.Point3f, self.points, p)
        normal, view = dr.gather(mi.Vector3f, own(guess.normals), p), self.view(point)
        direction, irradiance = self.light(k, point)
        scale = dr.gather(mi.Float, own(guess.exposures), k) * irradiance
        albedo = dr.gather(mi.Float, own(guess.albedo), p)
        colour = None if guess.base is None else dr.gather(mi.Color3f, own(guess.base), p)
        entry, bsdf = p * self.K + k, bsdf_of(self.lobes, guess.weights)
        table = lambda found: found.numpy().astype(np.float64).T.reshape(count, self.K, -1)

        def shown(n: mi.Vector3f) -> np.ndarray:
            """Of the guess, with these normals: (count, K, 3)."""
            found = self._reflected(bsdf, n, view, direction) * (scale * albedo)
            return table(found if colour is None else found + colour * (scale * own_lobe(n)))

        own_lobe = lambda n: diffuse(guess.base_eta, n, view, direction)
        frame, D = mi.Frame3f(normal), self.of_lobes(guess, pixels)
        values, counts = dr.gather(mi.Color3f, self.values, entry), dr.gather(mi.Float, self.counts, entry)
        if self.indirect is not None:
            values -= dr.gather(mi.Color3f, self.indirect, entry)
        values, counts, here = table(values), table(counts)[..., 0], shown(normal)
        counts *= np.minimum(1, HUBER * self.scale / np.maximum(np.linalg.norm(values - here, axis=2), 1e-20))
        own_columns = [(shown(dr.normalize(normal + TURN * t)) - here) / TURN for t in (frame.s, frame.t) if turn]
        if guess.base is not None:
            g = table(scale * own_lobe(normal))
            own_columns += [g * one for one in np.eye(3)]
            values -= guess.base[pixels][:, None] * g
        columns = np.stack(own_columns, -1) if own_columns else np.zeros((*values.shape, 0))
        gram, moments = without_turns(D, columns, values, counts, shared=guess.base is not None)
        parts, colours = len(moments) // B, values.shape[2]
        i, x = np.flatnonzero(np.tile(self.wanted(guess, coat), parts)), np.zeros(parts * B)
        if i.size:
            x[i] = simplex_least_squares(gram[np.ix_(i, i)], moments[i], parts)
        guess.weights = np.broadcast_to(x.reshape(parts, B).T, (B, colours)).copy()


@dataclass
class _Pixel:
    """All pixels, each with what it has of its own, as one step of Gauss and Newton begins: normal, albedo, colour."""

    model: DirectModel
    base_eta: float
    n: mi.Vector3f
    a: mi.Float
    base: mi.Color3f | None = None

    def __post_init__(self):
        self.number = p = dr.arange(mi.UInt32, self.model.P)
        self.point = dr.gather(mi.Point3f, self.model.points, p)
        self.view, self.frame = self.model.view(self.point), mi.Frame3f(self.n)

    def stepped(self, sums: list[mi.Float], *, free_albedo: bool, turn: bool) -> tuple:
        """Normals after a step, of `DirectModel._sums`; and albedo, or colours if there are any. What is linear is
        eliminated."""
        uu, uv, vv, bu, bv, ll, *rest = sums
        count = 1 if self.base is None else 3
        lu, lv, lb = rest[:count], rest[count : 2 * count], rest[2 * count :]
        free = 1 if free_albedo or self.base is not None else 0
        inverse = free / (ll * DAMPING + 1e-12)
        less = lambda x, y: sum(a * b for a, b in zip(x, y, strict=True)) * inverse
        uu, vv = uu * DAMPING + 1e-12 - less(lu, lu), vv * DAMPING + 1e-12 - less(lv, lv)
        uv, bu, bv = uv - less(lu, lv), bu - less(lu, lb), bv - less(lv, lb)
        x = dr.rcp(mi.Matrix2f([[uu, uv], [uv, vv]])) @ mi.Vector2f(bu, bv)
        x = dr.select(dr.all(dr.isfinite(x)) & turn, x, 0)
        x *= dr.minimum(1, LONGEST / dr.maximum(dr.hypot(x.x, x.y), 1e-20))
        n, v = dr.normalize(self.n + x.x * self.frame.s + x.y * self.frame.t), self.view
        # What the camera sees faces it
        away = dr.maximum(-dr.dot(n, v), 0) + 1e-3
        n = dr.select(dr.dot(n, v) > 1e-3, n, dr.normalize(n + away * v))
        linear = [(b - x.x * u - x.y * w) * inverse for b, u, w in zip(lb, lu, lv, strict=True)]
        linear = [dr.select(dr.isfinite(step), step, 0) for step in linear]  # no value of the pixel counts: as it is
        if self.base is None:
            return n, dr.clip(self.a + linear[0], *ALBEDOS)
        return n, dr.clip(self.base + mi.Color3f(*linear), 0, LIGHTEST)


def diffuse(eta: float, n: mi.Vector3f, v: mi.Vector3f, direction: mi.Vector3f) -> mi.Float:
    """Of a diffuse lobe, its value times the cosine, where light and camera are in front of the surface."""
    cos_i, cos_o = dr.dot(n, v), dr.dot(n, direction)
    return dr.select((cos_i > 0) & (cos_o > 0), ggx.diffuse(eta, cos_i, cos_o) * cos_o, 0)


def without_turns(
    lobes: np.ndarray,
    turns: np.ndarray,
    values: np.ndarray,
    counts: np.ndarray,
    *,
    shared: bool = False,
    damping: float = DAMPING,
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of weights x, (C B,) for C colours, as if T numbers of each pixel followed, such as its normal.

    lobes : (P, K, B). turns : changes of the values with these numbers, (P, K, C, T). values : (P, K, C).
    counts : (P, K). shared : the weights are the same for all colours, (B,), as a glaze reflects all alike.
    damping : of the T numbers: the more, the closer they stay to what they are.

    Returns
    -------
    gram, moments : `x @ gram @ x - 2 moments @ x` is what is left of the squares, but for a constant.
    """
    (P, K, B), (_, _, colours, T) = lobes.shape, turns.shape
    transposed = np.swapaxes(lobes, 1, 2)
    counted = turns * counts[..., None, None]
    A = np.swapaxes(counted.reshape(P, K * colours, T), 1, 2) @ turns.reshape(P, K * colours, T)
    diagonal = np.arange(T)
    A[:, diagonal, diagonal] = A[:, diagonal, diagonal] * damping + 1e-20
    by_colour = [counted.sum(2)] if shared else [counted[:, :, c] for c in range(colours)]
    of_lobes = np.stack([transposed @ x for x in by_colour], 1).reshape(P, len(by_colour) * B, T)
    of_values = values.reshape(P, 1, K * colours) @ counted.reshape(P, K * colours, T)
    explained = np.linalg.solve(A, np.swapaxes(of_lobes, 1, 2))  # (P, T, C B)
    squares = sum_of_products(transposed, lobes * counts[..., None])
    gram = colours * squares if shared else np.kron(np.eye(colours), squares)
    gram -= sum_of_products(of_lobes, explained)
    moments = sum_of_products(np.swapaxes(values * counts[..., None], 1, 2), lobes)
    moments = moments.sum(0) if shared else moments.ravel()
    return gram, moments - sum_of_products(of_values, explained)[0]


def sum_of_products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of matrices, (P, I, J) and (P, J, L): (I, L). Some at a time, so that they stay in the cache, but not as one long
    and thin product, in which threads of BLAS wait for each other again and again: that takes up to a hundred times as
    long on processors that have other work."""
    return sum((a[i : i + BLOCK] @ b[i : i + BLOCK]).sum(0) for i in range(0, len(a), BLOCK))


def simplex_least_squares(gram: np.ndarray, moments: np.ndarray, colours: int = 1) -> np.ndarray:
    """Non-negative x, (colours B,), that minimises `x @ gram @ x - 2 moments @ x`, slightly regularised, while each of
    `colours` equal parts of it sums to at most 1.

    gram : (colours B, colours B), positive semidefinite. moments : (colours B,).
    """
    size = np.sqrt(np.diag(gram)) + 1e-30
    root = np.linalg.cholesky(gram / size / size[:, None] + RIDGE * np.eye(len(moments))).T * size
    target = solve_triangular(root, moments, trans=1)
    # A black lobe of each colour takes what is left of 1
    heavy = 1e3 * np.linalg.norm(target) + 1e-30
    sums = np.kron(np.eye(colours), np.full((1, len(moments) // colours), heavy))
    A = np.block([[root, np.zeros((len(moments), colours))], [sums, heavy * np.eye(colours)]])
    x, _ = nnls(A, np.append(target, np.full(colours, heavy)), maxiter=20 * A.shape[1])
    x = x[: len(moments)].reshape(colours, -1)
    return (x / np.maximum(x.sum(1, keepdims=True), 1)).ravel()


def bsdf_of(
    lobes: ggx.Lobes, weights: np.ndarray, *, scale: str | None = None, base: str | None = None, eta: float = np.nan
) -> mi.BSDF:
    """A `ggx_dictionary`. scale, base : attributes of a mesh, see there. eta : of the coat over the base."""
    attributes = {"scale": scale, "base": base}
    return mi.load_dict(
        {
            **{key: {"type": "mesh_attribute", "name": name} for key, name in attributes.items() if name is not None},
            **({} if base is None else {"base_eta": eta}),
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
