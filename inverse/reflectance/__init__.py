"""Fits of reflectance: the weights of a dictionary of lobes for a measured material, and the dictionary itself.

from rimlight import ggx, merl_tables
from rimlight.inverse import reflectance

lobes, _ = ggx.read_dictionary()
weights = reflectance.fit(merl_tables.read_merl("gray-plastic.binary"), lobes)
ggx.write("gray-plastic.json", lobes, weights)  # for the plugin `ggx_dictionary`
"""

from .dictionary import FitError, candidates, error, fit, reduce

__all__ = ["FitError", "candidates", "error", "fit", "reduce"]
