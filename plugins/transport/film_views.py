"""The sensor as the first vertex of paths: from where it is seen, and with what density its rays arrive."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from rimlight.edge_sampling.projection.film_parts import film_parts
from rimlight.edge_sampling.projection.sensors import Projection, inside_frame
from rimlight.edge_sampling.refusals import Refusal


@dataclass
class View:
    """What the sensor sees of points. (A Dr.Jit structure: not frozen.)

    u : film position, pixels. d : unit vector towards the sensor, world space. distance : to where its rays start.
    arrival : density with which its rays arrive, by area across them; 0 where there are none.
    """

    u: mi.Point2f
    d: mi.Vector3f
    distance: mi.Float
    arrival: mi.Float


class FilmViews:
    """The views that a sensor has of points: of a `batch`, one of its children by chance.

    per_frame : pixels of what is sampled of the film.
    per_path : light subpaths for each camera path.
    """

    def __init__(self, sensor: mi.Sensor, per_frame: int, per_path: float):
        self.film = sensor.film()
        self.batch = sensor.class_name() == "BatchSensor"
        self.needs_aperture = sensor.needs_aperture_sample()
        self.parts, self.projections = [], []
        self.per_frame, self.per_path = per_frame, per_path
        try:
            self.parts = film_parts(sensor)
            self.projections = [Projection(part.sensor) for part in self.parts]
        except Refusal:
            if self.batch:
                raise  # its parts would have to be told apart
        #: Can points be projected on to the film?
        self.projects = bool(self.projections)

    @staticmethod
    def none() -> FilmViews:
        """Those of a sensor that sees no point."""
        views = FilmViews.__new__(FilmViews)
        views.parts, views.projections, views.projects, views.needs_aperture = [], [], False, False
        return views

    def of(self, p: mi.Point3f, lens: mi.Point2f, choice: mi.Float, active: mi.Bool) -> View:
        """Views of points: p, (N,), world space. lens : random numbers for a point of the lens. choice : of a part."""
        number = dr.minimum(mi.UInt32(choice * len(self.parts)), len(self.parts) - 1)
        view = None
        for i, (part, projection) in enumerate(zip(self.parts, self.projections, strict=True)):
            found = self._view(part, projection, p, lens)
            view = found if view is None else dr.select(number == i, found, view)
        view.arrival = dr.select(active & inside_frame(view.u, self.film), view.arrival, 0)
        return view

    def _view(self, part, projection, p, lens) -> View:
        if projection.orthographic:
            d = dr.normalize(projection.viewer()) + dr.zeros(mi.Vector3f, dr.width(p))
        else:
            d = dr.normalize(projection.viewer(lens if self.needs_aperture else None) - p)
        u = projection.film(p, lens if self.needs_aperture else None).position()
        distance = projection.distance(p, d)
        visible = (distance > 0) & (part.inside(u))
        arrival = dr.select(visible, self._arrival(part, projection, p, d), 0)
        return View(part.to_film(u), d, distance, arrival)

    def _arrival(self, part, projection, p, d) -> mi.Float:
        # One part in so many is chosen, of the film they share.
        scale = part.area * len(self.parts) / self.per_frame
        return projection.pixels_per_area(p, d) * scale

    def arrival(self, ray: mi.Ray3f, p: mi.Point3f, u: mi.Point2f) -> mi.Float:
        """Density with which the sensor's rays arrive at what they meet, as `View.arrival`; 0 if nothing is projected.

        u : their position on the film, pixels.
        """
        if not self.projects:
            return mi.Float(0)
        found = None
        for part, projection in zip(self.parts, self.projections, strict=True):
            arrival = self._arrival(part, projection, p, -ray.d)
            found = arrival if found is None else dr.select(u.x >= part.offset.x, arrival, found)
        return found
