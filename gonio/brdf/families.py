"""The registered BRDF models: which names there are, and which choices each leaves.

A family is a name with choices, such as oren_nayar's variant; with the choices made it is one `Model`. Packages of others
add families by entry points, see `gonio.brdf.plugins`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from gonio.brdf.base import Model, _suggest
from gonio.brdf.blinn import ASHIKHMIN_SHIRLEY, BLINN_PHONG
from gonio.brdf.eon import EON
from gonio.brdf.hapke import hapke
from gonio.brdf.kubelka_munk import KUBELKA_MUNK
from gonio.brdf.lambertian import LAMBERTIAN
from gonio.brdf.lommel_seeliger import LOMMEL_SEELIGER
from gonio.brdf.microfacet import BECKMANN, CHOICES, GGX
from gonio.brdf.microfacet import build as microfacet
from gonio.brdf.minnaert import MINNAERT
from gonio.brdf.oren_nayar import OREN_NAYAR, OREN_NAYAR_FULL
from gonio.brdf.phong import LAFORTUNE, PHONG
from gonio.brdf.plastic import PLASTIC
from gonio.brdf.scatter import ABG, HARVEY_SHACK, K_CORRELATION
from gonio.brdf.specular import SPECULAR
from gonio.brdf.ward import WARD
from gonio.errors import ParameterError

_PART = re.compile(r"\s*(\w+)\s*(?:\[([^\[\]]*)\])?\s*")


@dataclass(frozen=True)
class Family:
    """A name, its choices and how a model is made of them.

    Attributes
    ----------
    build : callable
        Of the choices, by name, as strings: the `Model`; the same object for the same choices.
    choices : mapping of str to tuple of str
        What each may be; the first is the default. Flags are ("false", "true").
    """

    name: str
    build: Callable[..., Model]
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def model(self, **chosen: object) -> Model:
        """The model with these choices and the default of the others.

        Raises
        ------
        ParameterError
            If a choice is unknown.
        """
        made = {key: allowed[0] for key, allowed in self.choices.items()}
        for key, value in chosen.items():
            if key not in self.choices:
                known = f"it has: {', '.join(self.choices)}" if self.choices else "leave it out"
                raise ParameterError(f"{self.name} has no choice {key!r}{_suggest(key, self.choices)}; {known}")
            made[key] = str(value).lower() if isinstance(value, bool | np.bool_) else str(value)
            if made[key] not in self.choices[key]:
                raise ParameterError(
                    f"{self.name} has no {key} {value!r}{_suggest(made[key], self.choices[key])}; "
                    f"it has: {', '.join(self.choices[key])}"
                )
        return self.build(**made)


def single(model: Model) -> Family:
    """The family of a model without choices."""
    return Family(model.name, lambda: model)


def _oren_nayar(variant: str) -> Model:
    return {"qualitative": OREN_NAYAR, "full": OREN_NAYAR_FULL}[variant]


FAMILIES: dict[str, Family] = {
    family.name: family
    for family in (
        single(LAMBERTIAN),
        Family("oren_nayar", _oren_nayar, {"variant": ("qualitative", "full")}),
        single(EON),
        single(MINNAERT),
        single(LOMMEL_SEELIGER),
        Family("hapke", hapke, {"H": ("1981", "2002")}),
        single(KUBELKA_MUNK),
        single(PLASTIC),
        single(PHONG),
        single(BLINN_PHONG),
        single(LAFORTUNE),
        Family("ward", lambda variant: WARD[variant], {"variant": ("ward", "duer", "gmd")}),
        single(ASHIKHMIN_SHIRLEY),
        single(ABG),
        single(HARVEY_SHACK),
        single(K_CORRELATION),
        Family("microfacet", microfacet, CHOICES),
        single(GGX),
        single(BECKMANN),
        single(SPECULAR),
    )
}


def find(name: str) -> Family:
    """The registered family of that name, or a `ParameterError` with the nearest one."""
    if name in FAMILIES:
        return FAMILIES[name]
    from gonio.brdf import plugins

    if name in plugins.names():
        return plugins.load(name)
    if name == "tabulated":
        raise ParameterError(
            "a tabulated BRDF has no parameters: it is read from a file by gonio.formats.read(path).brdf() or tabulated by "
            "gonio.brdf.tabulated.from_brdf and tabulate"
        )
    known = sorted({*FAMILIES, *plugins.names()})
    raise ParameterError(f"there is no BRDF model {name!r}{_suggest(name, known)}; known are: {', '.join(known)}")


def parse(expression: str) -> tuple[Model, ...]:
    """The models of a sum such as ``"lambertian+ggx"`` or ``"oren_nayar[variant=full]+ggx"``."""
    return tuple(_parse(part) for part in expression.split("+"))


def _parse(part: str) -> Model:
    found = _PART.fullmatch(part)
    if found is None:
        raise ParameterError(f"{part.strip()!r} is no BRDF model: write a name, or name[choice=value,...]")
    name, choices = found[1], [item.partition("=") for item in (found[2] or "").split(",") if item.strip()]
    return find(name).model(**{key.strip(): value.strip() for key, _, value in choices})
