"""The perfect mirror: a delta function, which reflectance maps treat in closed form.

References
----------
.. [1] B. K. P. Horn, R. W. Sjoberg, MIT AI Memo 498, 1978, section 8 (BRDF of a specular surface).
"""

from __future__ import annotations

from gonio.brdf.base import Model
from gonio.brdf.parameter import Parameter

SPECULAR = Model(
    name="specular",
    parameters=(Parameter("rho", 0.0, 1.0, "reflectance of the mirror", ("uniform", 0.0, 1.0)),),
    function=None,
    doc="Mirror: the radiance from the mirror direction times rho.",
    reference="Horn & Sjoberg, MIT AI Memo 498, 1978, section 8",
)
