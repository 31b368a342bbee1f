"""A network of PyTorch in the loss: pictures are alike if a network sees the same features in them."""

from rimlight import inverse, scenes  # before mitsuba
import mitsuba as mi
import torch

mi.set_variant("llvm_ad_rgb")


class Features(torch.nn.Module):
    """Mean squared difference of features. Here they are random; a trained network goes in the same place."""

    def __init__(self):
        super().__init__()
        layers = [torch.nn.Conv2d(a, b, 5, stride=2, padding=2) for a, b in ((3, 16), (16, 32))]
        self.seen = torch.nn.Sequential(layers[0], torch.nn.Softplus(), layers[1])

    def forward(self, image, target):  # (1, 3, H, W) each
        return torch.nn.functional.mse_loss(self.seen(image), self.seen(target))


torch.manual_seed(0)
torch.set_num_threads(1)  # pictures so small are faster on one
start = (0.3, -0.2, 0, 0, 0, 0)  # displacement and rotation of the triangle: the fit has to undo them
triangle = inverse.Free(key="green.vertex_positions", kind="pose", move="xy", turn="", rate=0.03, start=start)
fit = inverse.Fit(
    scene=scenes.path("two_triangles"),
    define={"res": "32"},
    integrator={"type": "direct_edge"},
    free=triangle,
    loss=inverse.torch_loss(Features().requires_grad_(False)),
    stage=[inverse.Stage(iterations=50, spp=32, decay=0.05)],
)
found = fit.run(progress=False)
before, after = found.errors["green: distance (scene units)"][[0, -1]]
print(f"distance {before:.3f} -> {after:.4f}, loss {found.losses[0]:.2e} -> {found.losses[-1]:.2e}")
assert after < 0.03 * before
