"""From counts to light to BRDF samples: noise model, exposure bracket, white reference, sensitivities.

It reads frames and joint angles that were measured; it moves nothing, opens no device, and fits no model.
"""

from __future__ import annotations

from gonio.radiometry.bracket import Merged, Reading, merge_bracket, read_bracket
from gonio.radiometry.irradiance import image_irradiance
from gonio.radiometry.reduction import Bracket, Setup, reduce
from gonio.radiometry.run import reduce_run

__all__ = [
    "Bracket",
    "Merged",
    "Reading",
    "Setup",
    "image_irradiance",
    "merge_bracket",
    "read_bracket",
    "reduce",
    "reduce_run",
]
