"""Radiance of one pixel of the bench, written out: the reference for `sim.render`, with which it shares nothing.

Vectors stand in the bench's frame, no rotation matrix occurs; the lamp's globe is integrated over its visible surface and
not over a cone of directions, the lens over its radius and not its area, both by Gauss-Legendre and equal steps, finer than
any rule of the simulator. Light: L_s dA_s cos(theta_s) / d^2 from each piece of the globe, L_s = I / (pi R^2).
"""

from __future__ import annotations

import math

import numpy as np


def gauss(n, low, high):
    x, w = np.polynomial.legendre.leggauss(n)
    return 0.5 * (high - low) * (x + 1) + low, 0.5 * (high - low) * w


def unit(v):
    return v / np.sqrt(np.sum(v * v, axis=-1, keepdims=True))


def lambert_ggx(n, wi, wr, albedo, alpha, f_0):
    """Lambert, and unless f_0 is 0 GGX with Smith's shadowing (the sum of the lambdas) and Schlick's Fresnel."""
    ci, cr = np.sum(n * wi, -1), np.sum(n * wr, -1)
    h = unit(wi + wr)
    ch, cd = np.sum(n * h, -1), np.sum(wr * h, -1)
    a2 = alpha**2
    with np.errstate(invalid="ignore", divide="ignore"):
        d = a2 / (math.pi * (ch**2 * (a2 - 1) + 1) ** 2)
        lam_i = (np.sqrt(1 + a2 * (1 - ci**2) / ci**2) - 1) / 2
        lam_r = (np.sqrt(1 + a2 * (1 - cr**2) / cr**2) - 1) / 2
        f = f_0 + (1 - f_0) * (1 - cd) ** 5
        value = albedo / math.pi + d * f / (1 + lam_i + lam_r) / (4 * ci * cr)
    return np.where((ci > 0) & (cr > 0), value if f_0 > 0 else albedo / math.pi, 0.0)


def pixel(pose_deg, target, *, shape="flat", radius=25.0, model=(0.5, 0.2, 0.06), globe=0.0, lens=0.0, n=(10, 24)):
    """Mean radiance over the lens of the pixel that is sharp at `target` (x, y) in z = 0; I = 1 W/sr at 500 mm."""
    g, b, t = np.radians(pose_deg)
    normal = np.array([math.sin(b) * math.cos(t), -math.sin(t), math.cos(b) * math.cos(t)])
    lamp = 500 * np.array([math.sin(g), 0.0, math.cos(g)])
    eye, sharp = np.array([0.0, 0.0, 600.0]), np.array([*target, 0.0])
    spots = [(eye, 1.0)]
    if lens > 0:
        radii, weights = gauss(n[0], 0.0, lens)
        turns = 2 * math.pi * np.arange(n[1]) / n[1]
        straight = np.linalg.norm(sharp - eye)
        spots = []
        for r, w in zip(radii, weights, strict=True):
            for turn in turns:
                spot = eye + r * np.array([math.cos(turn), math.sin(turn), 0.0])
                share = w * r * 2 / lens**2 / n[1]
                spots.append((spot, share * (straight / np.linalg.norm(sharp - spot)) ** 4))
    total = 0.0
    for spot, share in spots:
        ray = unit(sharp - spot)
        if shape == "flat":
            place = spot - ray * (normal @ spot) / (normal @ ray)
            if place @ place > radius**2 or normal @ ray >= 0:
                continue
            surface = normal
        else:
            half = ray @ spot
            inside = half**2 - spot @ spot + radius**2
            if inside <= 0:
                continue
            place = spot - ray * (half + math.sqrt(inside))
            surface = place / radius
        total += share * radiance(place, surface, -ray, lamp, globe, model, n)
    return total


def radiance(place, surface, wr, lamp, globe, model, n):
    axis = place - lamp
    distance = np.linalg.norm(axis)
    axis = axis / distance
    if globe == 0.0:
        wi = -axis
        return float(lambert_ggx(surface, wi, wr, *model) * max(surface @ wi, 0.0) * 1e6 / distance**2)
    # pieces of the globe that this place sees: polar angle about the line to it, up to acos(R / d)
    heights, weights = gauss(n[0], globe / distance, 1.0)  # cosine of that angle; dA = R^2 dcos dphi
    turns = 2 * math.pi * (np.arange(n[1]) + 0.25) / n[1]
    u = unit(np.cross(axis, [0.3, 0.5, 0.8]))
    v = np.cross(axis, u)
    rim = np.sqrt(1 - heights**2)
    outward = heights[:, None, None] * axis + rim[:, None, None] * (
        np.cos(turns)[None, :, None] * u + np.sin(turns)[None, :, None] * v
    )
    to_piece = lamp + globe * outward - place
    d2 = np.sum(to_piece**2, -1)
    wi = to_piece / np.sqrt(d2)[..., None]
    cos_s = np.maximum(-np.sum(outward * wi, -1), 0.0)
    cos_i = np.maximum(wi @ surface, 0.0)
    f_r = lambert_ggx(surface, wi, wr, *model)
    pieces = f_r * cos_i * cos_s / d2 * globe**2 * weights[:, None] * 2 * math.pi / n[1]
    return float(pieces.sum() * 1e6 / (math.pi * globe**2))
