"""TeX of docstrings in plain characters."""

from __future__ import annotations

import pytest

from gonio.cli.formulas import formula, plain


@pytest.mark.parametrize(
    ("tex", "shown"),
    [
        (r"\frac{\rho}{\pi}\,(\mu_i\mu_r)^{k-1}", "rho/pi (mu_i mu_r)^(k-1)"),
        (r"\frac{F(\omega_r\cdot h)\,D(h)\,G}{4\cos\theta_i}", "F(omega_r . h) D(h) G/(4 cos theta_i)"),
        (r"1 - \frac{\sigma^2}{2(\sigma^2 + 0.33)}", "1 - sigma^2/(2(sigma^2 + 0.33))"),
        (r"\frac{\rho}{\pi}\Bigl(A + 1\Bigr)", "rho/pi (A + 1)"),
        (r"\tan\frac{\alpha+\beta}2, \ln\tfrac{1+x}{x}", "tan((alpha+beta)/2), ln((1+x)/x)"),
        (r"\sin^2\!\frac\psi2", "sin^2(psi/2)"),
        (r"\tfrac12\int_0^{2\pi} f\,\mathrm{d}\phi_i", "1/2 int_0^(2 pi) f d phi_i"),
        (r"\begin{cases} s/\max(a, b) & s > 0 \\ s & s \le 0 \end{cases}", "{ s/max(a, b) for s > 0 ; s for s <= 0 }"),
        (r"\sqrt{\kappa(\kappa+2)} + \sqrt\pi\,\bar F_{int}", "sqrt(kappa(kappa+2)) + sqrt(pi) F_bar_int"),
        (r"\{x\_y\}^{-1/2}, |x|^{2}", "{x_y}^(-1/2), |x|^2"),
    ],
)  # fmt: skip
def test_formulas(tex: str, shown: str) -> None:
    assert formula(tex) == shown


def test_directives_and_roles_of_a_docstring() -> None:
    rows = [
        r"With :math:`\mu = \cos\theta`", "the ``full`` one is", "", ".. math::", r"    a &= \frac12 \\", "    b &= 2", "",
        "and", "", ".. math:: c = 3", "          + 4", "", "end_of_it ^ here",
    ]  # fmt: skip
    shown = ["With mu = cos theta", "the full one is", "", "", "    a = 1/2", "    b = 2", "", "and", "", "    c = 3"]
    assert plain("\n".join(rows)).split("\n") == [*shown, "          + 4", "", "end_of_it ^ here", ""]
