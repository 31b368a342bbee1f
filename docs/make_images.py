"""Make the pictures of the README and the documentation:  python docs/make_images.py [FOLDER]

About twelve minutes on two cores. Writes docs/images/without.webp, an animation; overview.png; normal_integration.png,
which needs the depth of the bear of DiLiGenT in ../shared; jumps.png and hidden_light.png; adversarial.png, which needs
the extra `adversarial`; and reflectance.png, if the argument names a folder with tables of the MERL database.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

# isort: off
import rimlight  # noqa: F401  (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np
# isort: on

IMAGES = Path(__file__).parent / "images"
BEAR = Path(__file__).parents[2] / "shared" / "data" / "diligent" / "bear_depth"
RES = 160

#: Samples per pixel of a launch, and launches, of the derivative images.
SPP, LAUNCHES = 64, 128

#: Step (scene units; half of it counts), runs and samples per pixel of the finite differences.
STEP, RUNS, REFERENCE_SPP = 2e-3, 8, 1024


def without(path: Path) -> None:
    """An animation: a cube looks for its place in an image, by the gradient of `prb`, and by that of `prb_edge`."""
    from PIL import Image, ImageDraw, ImageFont

    from rimlight import no_collection, pictures, scenes

    key, size, top, gap, steps = "cube.vertex_positions", 176, 26, 8, 48
    scene = mi.load_file(str(scenes.path("objects")), res=size // 2)
    large = mi.load_file(str(scenes.path("objects")), res=size)
    params, shown = mi.traverse(scene), mi.traverse(large)
    initial = dr.unravel(mi.Point3f, mi.Float(params[key]))
    target = mi.TensorXf(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=256))
    view = lambda: pictures.to_srgb(mi.render(large, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=64))
    goal, films = view(), {}
    for name in ("prb", "prb_edge"):
        integrator = mi.load_dict({"type": name, "max_depth": 2})
        optimiser = mi.ad.Adam(lr=0.03)
        optimiser["shift"] = mi.Vector3f(-0.35, 0.35, 0.3)
        films[name] = []
        for i in range(steps):
            with no_collection():
                params[key] = dr.ravel(initial + optimiser["shift"])
                params.update()
                if i % 2 == 0:
                    shown[key] = dr.detach(params[key])
                    shown.update()
                    films[name].append(view())
                image = mi.render(scene, params, integrator=integrator, spp=16, seed=2 * i, seed_grad=2 * i + 1)
                dr.backward(dr.mean(dr.square(image - target), axis=None))
                optimiser.step()
        print(f"{name}: {optimiser['shift']}")
    frames, font = [], ImageFont.load_default(13)
    for wrong, right in zip(films["prb"], films["prb_edge"], strict=True):
        frame = Image.new("RGB", (3 * size + 2 * gap, size + top), "white")
        captions = ("without the boundary term", "with it: Rimlight", "the target")
        for k, (panel, caption) in enumerate(zip((wrong, right, goal), captions, strict=True)):
            frame.paste(Image.fromarray(panel), (k * (size + gap), top))
            ImageDraw.Draw(frame).text((k * (size + gap) + 2, 5), caption, fill="black", font=font)
        frames.append(frame)
    durations = [1000, *[90] * (len(frames) - 2), 2500]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0, quality=70, method=6)


def overview(path: Path) -> None:
    """The derivative with respect to a camera motion: Rimlight, Mitsuba, finite differences."""
    from rimlight import pictures, scenes
    from rimlight.checks import Motion, derivative_image, finite_differences

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


def normal_integration(path: Path) -> None:
    """Depth of the bear from its true normals, and its errors without and with bilateral weights."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from rimlight.inverse.photometric_stereo.integration import depth_error, integrate

    read = lambda name: np.array(mi.Bitmap(str(BEAR / name)))
    mask = read("mask.png").reshape(512, 612, -1)[..., 0] > 0
    rows, columns = (slice(i.min() - 4, i.max() + 5) for i in np.nonzero(mask))
    normals = read("normal_map.png")[..., :3] / 65535.0 * 2 - 1
    truth, camera = np.load(BEAR / "depth_gt.npz")["depth_gt"], np.loadtxt(BEAR / "K.txt")
    truth = np.where(mask, truth, np.nan)
    figure = Figure(figsize=(11, 4.2), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    axes[0].set_title("true depth, mm", fontsize=9)
    shown = [axes[0].imshow(truth[rows, columns], cmap="viridis_r")]
    for ax, title, options in (
        (axes[1], "continuous surface", {}),
        (axes[2], "bilateral weights", {"bilateral": 2}),
    ):
        depth = integrate(normals, mask, camera=camera, **options)
        depth *= np.median((truth / depth)[mask])
        error = depth_error(depth, truth, mask, align="scale")
        ax.set_title(f"{title}: error, mm (mean {error:.2f})", fontsize=9)
        shown.append(ax.imshow((depth - truth)[rows, columns], cmap="RdBu_r", vmin=-5, vmax=5))
    for ax, image in zip(axes, shown, strict=True):
        ax.set_axis_off()
        figure.colorbar(image, ax=ax, shrink=0.8)
    figure.savefig(path)


def reflectance(path: Path, folder: Path) -> None:
    """Slices through two tables, and through the weights of the package for these materials."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    degrees = np.linspace(-89, 89, 1001)
    direction = lambda angle: mi.Vector3f(np.sin(np.radians(angle)), 0, np.cos(np.radians(angle)))
    for row, name in zip(figure.subplots(2, 3, sharex=True), ("gray-plastic", "dark-blue-paint"), strict=True):
        measured = mi.load_dict({"type": "merl", "filename": str(folder / f"{name}.binary")})
        fitted = mi.load_dict({"type": "ggx_dictionary", "material": name})
        for ax, angle in zip(row, (0, 30, 70), strict=True):
            si, wo = dr.zeros(mi.SurfaceInteraction3f, len(degrees)), direction(degrees)
            si.wi = direction(np.full_like(degrees, -angle))
            for bsdf, style in ((measured, "-"), (fitted, "--")):
                values = np.array(bsdf.eval(mi.BSDFContext(), si, wo) / wo.z)
                for value, colour in zip(values, ("tab:red", "tab:green", "tab:blue"), strict=True):
                    ax.semilogy(degrees, value, style, color=colour, linewidth=1)
            ax.set_title(f"{name}, light from {-angle}°", fontsize=9)
            ax.grid(alpha=0.3)
        row[0].set_ylabel("reflectance, 1/sr")
    figure.supxlabel("viewing angle in the plane of incidence, degrees; solid: table, dashed: fit", fontsize=9)
    figure.savefig(path)


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


def fits(path: Path, names: Sequence[str]) -> None:
    """Target, start and result of fits of `rimlight reproduce`."""
    from rimlight import inverse
    from rimlight.inverse import reproduce

    views = {}
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            (view,) = inverse.fit(reproduce.problem_of(name, Path(folder))).views
        views[name] = {"target": view.target, "start": view.start, "result": view.result}
    draw_views(path, views)


def draw_views(path: Path, views: dict[str, dict[str, np.ndarray]]) -> None:
    """Pictures with titles, a row for each fit. views : linear colours, (H, W, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from rimlight import pictures

    figure = Figure(figsize=(6.6, 2.2 * len(views)), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    for row, (name, images) in zip(figure.subplots(len(views), 3), views.items(), strict=True):
        for axes, (title, image) in zip(row, images.items(), strict=True):
            axes.imshow(pictures.to_srgb(image))
            axes.set_title(f"{name}: {title}", fontsize=8)
            axes.set_axis_off()
    figure.savefig(path)


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    IMAGES.mkdir(exist_ok=True)
    without(IMAGES / "without.webp")
    overview(IMAGES / "overview.png")
    normal_integration(IMAGES / "normal_integration.png")
    fits(IMAGES / "jumps.png", ("pot_in_mirror", "ball_of_glass", "box_in_sand"))
    fits(IMAGES / "hidden_light.png", ("lampshade", "caustic"))
    adversarial(IMAGES / "adversarial.png")
    if len(sys.argv) > 1:
        reflectance(IMAGES / "reflectance.png", Path(sys.argv[1]))
