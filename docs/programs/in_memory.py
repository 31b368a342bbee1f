"""Scene and targets in memory: a dictionary, two sensors, arrays; and a loop of one's own."""

from rimlight import inverse  # before mitsuba
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")


def sensor(x):
    look = mi.ScalarTransform4f().look_at(origin=[x, 2, 5], target=[0, 0, 0], up=[0, 1, 0])
    return {"type": "perspective", "fov": 40, "to_world": look, "film": {"type": "hdrfilm", "width": 32, "height": 24}}


def scene(colour):
    floor = mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(3)
    return {
        "type": "scene",
        "left": sensor(-2),
        "right": sensor(2),
        "sky": {"type": "constant"},
        "floor": {"type": "rectangle", "to_world": floor},
        "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}},
    }


truth = mi.load_dict(scene([0.7, 0.3, 0.1]))
photos = [np.array(mi.render(truth, sensor=i, spp=256, integrator=mi.load_dict({"type": "path"}))) for i in (0, 1)]

free = inverse.Free(key="ball.bsdf.reflectance.value", kind="material", rate=0.05)
fit = inverse.Fit(scene=scene([0.5, 0.5, 0.5]), target=photos, free=free, stage=inverse.Stage(iterations=60, decay=0.1))
for step in fit:
    if step.number % 20 == 0 or step.loss < 1e-5:
        print(f"step {step.number}: loss {step.loss:.5f}")
colour = fit.result().values[free.key[0]]
print("colour", colour)
assert np.abs(colour - [0.7, 0.3, 0.1]).max() < 0.02
