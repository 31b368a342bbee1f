"""Make the pictures of the README and the documentation:  python docs/make_images.py

About seven minutes on two cores. Writes docs/images/overview.png, and adversarial.png, which needs the extra
`adversarial`.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import mitsuba as mi
import numpy as np
# isort: on

IMAGES = Path(__file__).parent / "images"
RES = 160

#: Samples per pixel of a launch, and launches, of the derivative images.
SPP, LAUNCHES = 64, 128

#: Step (scene units; half of it counts), runs and samples per pixel of the finite differences.
STEP, RUNS, REFERENCE_SPP = 2e-3, 8, 1024


def overview(path: Path) -> None:
    """The derivative with respect to a camera motion: Rimlight, Mitsuba, finite differences."""
    from rimlight import pictures, scenes
    from rimlight.edge_sampling import Motion, derivative_image, finite_differences

    scene = mi.load_file(str(scenes.path("objects")), res=RES)
    motion = Motion(scene, "camera.to_world", direction=[1, 0, 0])

    def derivative(name: str) -> np.ndarray:
        integrator = mi.load_dict({"type": name})
        start = time.perf_counter()
        launches = [derivative_image(scene, integrator, motion, spp=SPP, seed=i) for i in range(LAUNCHES)]
        image = np.mean([np.array(launch) for launch in launches], axis=0)
        print(f"{name}: {time.perf_counter() - start:.1f} s")
        return image

    image = np.array(mi.render(scene, spp=512))
    edge, projective = derivative("direct_edge"), derivative("direct_projective")
    reference = finite_differences(scene, motion, step=STEP, runs=RUNS, spp=REFERENCE_SPP, progress=True)
    error = lambda d: np.abs(d - reference.mean).sum() / np.abs(reference.mean).sum()
    noise = np.sqrt(2 / np.pi) * reference.standard_error.sum() / np.abs(reference.mean).sum()
    pictures.write_panels(
        path,
        [
            pictures.Panel(image, "image"),
            pictures.Panel(edge, f"Rimlight: direct_edge\nrel. L1 error {error(edge):.0%}", "derivative"),
            pictures.Panel(
                projective, f"Mitsuba: direct_projective\nrel. L1 error {error(projective):.0%}", "derivative"
            ),
            pictures.Panel(reference.mean, f"finite differences\nrel. L1 noise {noise:.0%}", "derivative"),
        ],
        title="Derivative of the image when the camera moves to the right (red: brighter, blue: darker)",
        unit=motion.unit,
        limit=pictures.symmetric_limit([reference.mean], percentile=97),
    )


def adversarial(path: Path) -> None:
    """The stop sign before and after the fit of figure 10, and what the network says in each step."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from rimlight import inverse, pictures
    from rimlight.scenes import traffic_sign

    with tempfile.TemporaryDirectory() as folder:
        found = inverse.fit(inverse.read(traffic_sign.write(Path(folder))))
    (view,) = found.views
    print(f"{found.seconds:.1f} s, {found.measures[0]}")
    figure = Figure(figsize=(11, 3.5), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    before, after, curves = figure.subplots(1, 3, width_ratios=(1, 1, 1.3))
    for axes, image, title in ((before, view.start, "before"), (after, view.result, "after")):
        axes.imshow(pictures.to_srgb(image))
        axes.set_title(title, fontsize=9)
        axes.set_axis_off()
    for label, probability in found.scores.items():
        curves.plot(probability, label=label)
    curves.set(xlabel="step", ylabel="probability")
    curves.grid(alpha=0.3)
    curves.legend()
    figure.savefig(path)


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    IMAGES.mkdir(exist_ok=True)
    overview(IMAGES / "overview.png")
    adversarial(IMAGES / "adversarial.png")
