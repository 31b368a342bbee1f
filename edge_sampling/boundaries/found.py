"""The boundaries of one derivative, together."""

from __future__ import annotations

from dataclasses import dataclass

from rimlight.edge_sampling.choice.light_choice import LightChoice
from rimlight.edge_sampling.choice.silhouettes import Silhouettes
from rimlight.edge_sampling.divided_light import DividedLight
from rimlight.edge_sampling.first_points import HeldShapes
from rimlight.edge_sampling.geometry.surfaces import Surfaces
from rimlight.edge_sampling.geometry.texture_lines import TextureLines
from rimlight.edge_sampling.parametrisation import Slides

from .deep_shadows import DeepShadows
from .face_planes import FacePlanes
from .film_boundary import FilmBoundary
from .fine_mirrors import FineMirrors
from .horizons_at_points import HorizonsAtPoints
from .indirect_shadows import IndirectShadows
from .lamp_planes import LampPlanes
from .shading_boundary import ShadingBoundary
from .shadow_boundary import ShadowBoundary
from .shown_shadows import ShownShadows


@dataclass(frozen=True)
class Boundaries:
    """What samples the edges of a scene, for one answer to the question which meshes move, and whether the camera
    does. Nothing where nothing moves. `limits` : what the derivative will lack. `slides` : see `Vicinity`. `mirrors` :
    may the camera see edges in perfect mirrors, or through glass? `fine_mirrors` : those whose fringe is not looked
    at closely. `textures` : where those jump that the camera may see move, and mapped normals turn away. `shown` :
    shadows that mirrors or glass may show. `surfaces` : what chains meet, where there are mirrors or textures.
    `lights` : chooses one, where there are many. `lamps` : how their light is divided.
    `indirect` : shadows, and borders of beams, in indirect light. `deep` : shadows in light from surfaces.
    `horizons` : where interpolated normals turn away from points. `held` : shapes whose points are held where the
    camera sees them. `lamp_planes` : of coarse lamps with interpolated normals. `mirrored` : may other points, too, see
    edges in perfect mirrors, or through glass? `brightens` : may what is black become brighter?"""

    film: FilmBoundary | None = None
    shadows: ShadowBoundary | None = None
    shading: ShadingBoundary | None = None
    indirect: tuple[IndirectShadows, ...] = ()
    planes: FacePlanes | None = None
    moving: tuple[bool, ...] = ()
    camera_moves: bool = False
    lights_move: bool = False
    limits: tuple[str, ...] = ()
    slides: Slides = Slides.NOTHING
    mirrors: bool = False
    fine_mirrors: FineMirrors | None = None
    textures: TextureLines | None = None
    shown: ShownShadows | None = None
    surfaces: Surfaces | None = None
    lights: LightChoice | None = None
    deep: DeepShadows | None = None
    lamps: DividedLight | None = None
    horizons: HorizonsAtPoints | None = None
    held: HeldShapes | None = None
    lamp_planes: LampPlanes | None = None
    mirrored: bool = False
    brightens: bool = False

    @property
    def silhouettes(self) -> Silhouettes | None:
        return next((b.silhouettes for b in (self.shadows, self.shading) if b is not None), None)

    @property
    def anything_moves(self) -> bool:
        return any(self.moving) or self.camera_moves or self.lights_move

    def refit(self) -> None:
        """Follow the vertices. To be called before sampling."""
        if self.silhouettes is not None:
            self.silhouettes.refit()
        if self.lights is not None:
            self.lights.refit()
        if self.shading is not None:
            self.shading.refit()
