"""The renderer as a layer of PyTorch: one loop trains a network and fits a scene, with gradients to both at once."""

from rimlight import scenes  # before mitsuba
from rimlight.inverse import torch_render
import mitsuba as mi
import torch

mi.set_variant("llvm_ad_rgb")


scene = mi.load_file(str(scenes.path("two_triangles")), res=32)
key = "green.vertex_positions"
place = torch.tensor(mi.traverse(scene)[key].numpy())
render = lambda place, **options: torch_render(scene, {key: place}, integrator="direct_edge", **options)

# Photos of a camera whose colours are mixed, and a bit brighter: the network has to learn by how much.
mixed = torch.tensor([[1.2, 0.2, 0.0], [0.1, 1.1, 0.1], [0.0, 0.2, 1.3]])
photo = render(place, seed=1234, spp=256) @ mixed

shift = torch.tensor([0.3, -0.2, 0.0], requires_grad=True)  # where the triangle is wrong
network = torch.nn.Linear(3, 3, bias=False)
torch.nn.init.eye_(network.weight)
optimiser = torch.optim.Adam([{"params": [shift], "lr": 0.03}, {"params": network.parameters(), "lr": 0.03}])
schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.96)
losses = []
for step in range(80):
    image = render(place + (shift * torch.tensor([1.0, 1.0, 0.0])).repeat(3), seed=step)
    loss = torch.nn.functional.mse_loss(network(image), photo)
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    schedule.step()
    losses.append(loss.item())
print(f"loss {losses[0]:.2e} -> {losses[-1]:.2e}, distance {shift.norm().item():.4f}, colours\n{network.weight.T.data}")
assert shift.norm() < 0.02 and (network.weight.T - mixed).norm() < 0.5
