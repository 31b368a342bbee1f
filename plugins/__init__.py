"""Rimlight: correct derivatives of visibility for Mitsuba 3, by sampling the edges at which the image jumps.

Importing the package makes its plugins known to Mitsuba, for the current variant and for those set later::

    import rimlight
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    integrator = mi.load_dict({"type": "direct_edge"})

It neither sets a variant nor needs one. It also names a suitable LLVM library to Dr.Jit, so import it first.
"""

from rimlight import _llvm

__version__ = "0.1.0"
__all__ = ["Plan", "__version__", "no_collection", "plan", "register"]

_llvm.activate()  # before the line below, which imports Dr.Jit

from rimlight import _registration  # noqa: E402
from rimlight._collection import no_collection  # noqa: E402
from rimlight._plan import Plan, plan  # noqa: E402
from rimlight._registration import register  # noqa: E402

_registration.follow_variants()
