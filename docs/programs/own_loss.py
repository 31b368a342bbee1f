"""A loss of one's own, by a function of Dr.Jit: the squared difference of logarithms, for which dark pixels count."""

from rimlight import inverse, scenes  # before mitsuba
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")


def log_difference(image, target, weight):
    """image, target: (H, W, C), weight: (H, W), all `mi.TensorXf`. Dr.Jit differentiates what it returns."""
    difference = dr.log(image + 0.01) - dr.log(target + 0.01)
    value = dr.sum(weight[:, :, None] * difference * difference, axis=None) / dr.prod(image.shape)
    return value, {"mean of the picture": dr.mean(image, axis=None).array[0]}


start = (0.3, -0.2, 0, 0, 0, 0)  # displacement and rotation of the triangle: the fit has to undo them
triangle = inverse.Free(key="green.vertex_positions", kind="pose", move="xy", turn="", rate=0.03, start=start)
fit = inverse.Fit(
    scene=scenes.path("two_triangles"),
    define={"res": "32"},
    integrator={"type": "direct_edge"},
    free=triangle,
    loss=inverse.drjit_loss(log_difference, label="mean squared difference of logarithms"),
    stage=[inverse.Stage(iterations=50, spp=32, decay=0.05)],
)
found = fit.run(progress=False)
before, after = found.errors["green: distance (scene units)"][[0, -1]]
print(f"distance {before:.3f} -> {after:.4f}, loss {found.losses[0]:.4f} -> {found.losses[-1]:.5f}")
assert after < 0.03 * before
