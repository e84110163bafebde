/* The formulas of gonio's BRDF models in C, for a comparison of speeds: the same algebra, with the functions of libm, whose
   vector forms -O3 -ffast-math takes where glibc has them. Values agree with gonio's to 1e-10 before times are compared.

   Parameters stand in p as gonio has them: in the order of `gonio models NAME`, then the derived numbers. For every model
   NAME_loop(omega_i, omega_r, p, weight, out, n) adds weight f_r at n pairs of directions, arrays of structs, to out. What
   is divided or calls libm stands before the choice `lit ? value : 0.0`: behind it, gcc does not vectorise the loop. Nor does
   gcc 12 where numbers are looked up at computed places (tables) or only one of three coordinates is read. */
#include <math.h>

#define INV_PI 0.31830988618379067154
#define PI 3.14159265358979323846
#define ARGUMENTS double xi, double yi, double zi, double xr, double yr, double zr, const double *restrict p

#define MODEL(name)                                                                                                        \
    static inline __attribute__((always_inline)) double name(ARGUMENTS);                                                   \
    void name##_loop(const double *restrict i, const double *restrict r, const double *restrict p, double weight,          \
                     double *restrict out, long n)                                                                         \
    {                                                                                                                      \
        for (long k = 0; k < n; k++)                                                                                       \
            out[k] += weight * name(i[3 * k], i[3 * k + 1], i[3 * k + 2], r[3 * k], r[3 * k + 1], r[3 * k + 2], p);        \
    }                                                                                                                      \
    static inline double name(ARGUMENTS)

#define LIT                                                                                                                \
    int lit = (zi > 0.0) & (zr > 0.0);                                                                                     \
    double mu_i = lit ? zi : 1.0, mu_r = lit ? zr : 1.0;

#define INLINE static inline __attribute__((always_inline)) double

/* x^y of x > 0, by two calls of which libm has fast vector forms; its pow, of more digits than count here, is slower */
INLINE power(double x, double y) { return exp(y * log(x)); }

/* --- diffuse ------------------------------------------------------------------------------------------------------ */

MODEL(lambertian) { return (zi > 0.0) & (zr > 0.0) ? p[0] * INV_PI : 0.0; }

MODEL(oren_nayar)
{
    LIT
    double s2 = p[1] * p[1], a = 1.0 - 0.5 * s2 / (s2 + 0.33), b = 0.45 * s2 / (s2 + 0.09);
    double s = fmax(xi * xr + yi * yr, 0.0);
    double value = p[0] * INV_PI * (a + b * s / fmax(mu_i, mu_r));
    return lit ? value : 0.0;
}

MODEL(oren_nayar_full)
{
    LIT
    double s2 = p[1] * p[1], s_i = sqrt(xi * xi + yi * yi), s_r = sqrt(xr * xr + yr * yr);
    int steep = mu_i > mu_r;
    double mu_a = steep ? mu_r : mu_i, s_a = steep ? s_r : s_i, mu_b = steep ? mu_i : mu_r, s_b = steep ? s_i : s_r;
    double alpha = atan2(s_a, mu_a), beta = atan2(s_b, mu_b), a = 2.0 / PI * alpha, b = 2.0 / PI * beta;
    double s = xi * xr + yi * yr, sines = s_i * s_r, cosine = s / (sines > 0.0 ? sines : 1.0);
    double c_1 = 1.0 - 0.5 * s2 / (s2 + 0.33), c_3 = 0.125 * s2 / (s2 + 0.09) * (a * b) * (a * b);
    double c_2 = 0.45 * s2 / (s2 + 0.09) * (s >= 0.0 ? s_a : s_a - b * b * b);
    double once = c_1 + c_2 * cosine * s_b / mu_b + c_3 * (1.0 - fabs(cosine)) * (s_i + s_r) / (mu_i + mu_r);
    double twice = 0.17 * p[0] * s2 / (s2 + 0.13) * (1.0 - cosine * b * b);
    double value = p[0] * INV_PI * fmax(once + twice, 0.0);
    return lit ? value : 0.0;
}

#define K_1 (0.5 - 2.0 / (3.0 * PI))
#define K_2 (2.0 / 3.0 - 28.0 / (15.0 * PI))

INLINE eon_lost(double mu, double s)
{
    double grazing = (0.5 * PI - 2.0 / 3.0) * mu / (1.0 + s) + s * s - 2.0 / 3.0 * s * (1.0 + s + s * s) / (1.0 + s);
    return INV_PI * (mu * grazing + s * atan2(mu, s));
}

MODEL(eon)
{
    LIT
    double r = p[1], a = 1.0 / (1.0 + K_1 * r), s = xi * xr + yi * yr;
    double single = s > 0.0 ? 1.0 + r * s / fmax(mu_i, mu_r) : 1.0 + r * s;
    double mean = a * (1.0 + K_2 * r), multiple = p[0] * mean / (1.0 - p[0] * (a * r * (K_1 - K_2)));
    double again = r / (K_1 - K_2) * eon_lost(mu_i, sqrt(xi * xi + yi * yi)) * eon_lost(mu_r, sqrt(xr * xr + yr * yr));
    double value = p[0] * INV_PI * a * (single + multiple * again);
    return lit ? value : 0.0;
}

MODEL(minnaert)
{
    LIT
    double value = p[0] * INV_PI * power(fmax(mu_i * mu_r, 1e-300), p[1] - 1.0);
    return lit ? value : 0.0;
}

MODEL(lommel_seeliger)
{
    LIT
    double value = p[0] * 0.25 * INV_PI / (mu_i + mu_r);
    return lit ? value : 0.0;
}

INLINE h_1981(double x, double w)
{
    double gamma = sqrt(1.0 - w);
    return 2.0 * x * w / ((1.0 + gamma) * (1.0 + 2.0 * x * gamma));
}

INLINE h_2002(double x, double w)
{
    double gamma = sqrt(1.0 - w), r_0 = w / ((1.0 + gamma) * (1.0 + gamma));
    double y = w * x * (r_0 + (0.5 - r_0 * x) * log((1.0 + x) / x));
    return y / (1.0 - y);
}

INLINE hapke_of(ARGUMENTS, int year)
{
    LIT
    double w = p[0], b = p[1], c = p[2], tau = p[6];
    double sx = xi + xr, sy = yi + yr, sz = mu_i + mu_r, dx = xi - xr, dy = yi - yr, dz = mu_i - mu_r;
    double sum2 = sx * sx + sy * sy + sz * sz, off2 = dx * dx + dy * dy + dz * dz;
    double base = (1.0 - b) * (1.0 - b), back = base + b * off2, ahead = base + b * sum2;
    double phase =
        0.5 * (1.0 - b) * (1.0 + b) * ((1.0 + c) / (back * sqrt(back)) + (1.0 - c) / (ahead * sqrt(ahead)));
    double opposition = p[3] / (1.0 + sqrt(off2) / (p[4] * sqrt(sum2)));

    double s_i = sqrt(xi * xi + yi * yi), s_r = sqrt(xr * xr + yr * yr);
    int nearer = mu_i > mu_r;
    double mu_a = nearer ? mu_i : mu_r, s_a = nearer ? s_i : s_r, mu_b = nearer ? mu_r : mu_i, s_b = nearer ? s_r : s_i;
    double cot_a = mu_a / (tau * s_a + 1e-290), cot_b = mu_b / (tau * s_b + 1e-290);
    double e1_a = exp(-2.0 / PI * cot_a), e1_b = exp(-2.0 / PI * cot_b);
    double e2_a = exp(-INV_PI * cot_a * cot_a), e2_b = exp(-INV_PI * cot_b * cot_b);
    double across = xi * yr - yi * xr, dot = xi * xr + yi * yr, psi = atan2(fabs(across), dot);
    double sines = s_a * s_b, half2 = 0.5 * (1.0 - dot / (sines > 0.0 ? sines : 1.0)); /* sin^2(psi / 2) */
    double f = exp(-2.0 * sqrt(half2 / (1.0 - half2 + 1e-300)));
    double d = 2.0 - e1_b - psi * INV_PI * e1_a;
    double m_a = mu_a + s_a * tau * ((1.0 - 2.0 * half2) * e2_b + half2 * e2_a) / d;
    double m_b = mu_b + s_b * tau * (e2_b - half2 * e2_a) / d;
    double x_a = s_a * tau * e2_a / (2.0 - e1_a), x_b = s_b * tau * e2_b / (2.0 - e1_b);
    double chi = 1.0 / sqrt(1.0 + PI * tau * tau);
    double h_a = year == 1981 ? h_1981(chi * m_a, w) : h_2002(chi * m_a, w);
    double h_b = year == 1981 ? h_1981(chi * m_b, w) : h_2002(chi * m_b, w);
    double scattered = (1.0 + opposition) * phase + h_a + h_b + h_a * h_b;
    double f_r = 0.25 * INV_PI * w * m_a * m_b * scattered / ((m_a + m_b) * (mu_b + x_b) * (mu_a + x_a * (1.0 - f)));
    return lit ? f_r : 0.0;
}

MODEL(hapke) { return hapke_of(xi, yi, zi, xr, yr, zr, p, 1981); }
MODEL(hapke_2002) { return hapke_of(xi, yi, zi, xr, yr, zr, p, 2002); }

MODEL(kubelka_munk)
{
    double rho = p[1] + (1.0 - p[1]) * (1.0 - p[2]) / (1.0 - p[2] + p[0] + sqrt(p[0] * (p[0] + 2.0)));
    double value = rho * INV_PI;
    return (zi > 0.0) & (zr > 0.0) ? value : 0.0;
}

INLINE transmitted(double mu, double n2)
{
    double q = sqrt(n2 - 1.0 + mu * mu), s = mu + q, t = n2 * mu + q;
    return 2.0 * mu * q * (1.0 / (s * s) + n2 / (t * t));
}

MODEL(plastic)
{
    LIT
    double n2 = p[1] * p[1];
    double value = p[2] * transmitted(mu_i, n2) * transmitted(mu_r, n2);
    return lit ? value : 0.0;
}

/* --- lobes -------------------------------------------------------------------------------------------------------- */

MODEL(phong)
{
    LIT
    double along = 2.0 * mu_i * mu_r - (xi * xr + yi * yr + mu_i * mu_r);
    lit = lit & (along > 0.0);
    double value = p[0] * (p[1] + 2.0) * 0.5 * INV_PI * power(lit ? along : 1.0, p[1]);
    return lit ? value : 0.0;
}

MODEL(lafortune)
{
    LIT
    double along = p[1] * (xi * xr + yi * yr) + p[2] * (mu_i * mu_r), largest = fmax(fabs(p[1]), p[2]);
    lit = lit & (along > 0.0);
    double value = p[0] * (p[3] + 2.0) * 0.5 * INV_PI * power(lit ? along / largest : 1.0, p[3]);
    return lit ? value : 0.0;
}

INLINE cosine_power(double s2, double z, double n) { return exp(-0.5 * n * log1p(s2 / (z * z))); }

MODEL(blinn_phong)
{
    LIT
    double x = xi + xr, y = yi + yr, n = p[1];
    double norm = (n + 2.0) * (n + 4.0) / (8.0 * PI * (power(2.0, -0.5 * n) + n));
    double value = p[0] * norm * cosine_power(x * x + y * y, mu_i + mu_r, n);
    return lit ? value : 0.0;
}

MODEL(ashikhmin_shirley)
{
    LIT
    double x = xi + xr, y = yi + yr, z = mu_i + mu_r, s2 = x * x + y * y, c = 0.5 * sqrt(s2 + z * z), l = 1.0 - c;
    double fresnel = p[1] + (1.0 - p[1]) * l * l * l * l * l;
    double gloss = (p[2] + 1.0) / (8.0 * PI) * cosine_power(s2, z, p[2]) * fresnel / (c * fmax(mu_i, mu_r));
    double q_i = 1.0 - 0.5 * mu_i, q_r = 1.0 - 0.5 * mu_r;
    double t_i = 1.0 - q_i * q_i * q_i * q_i * q_i, t_r = 1.0 - q_r * q_r * q_r * q_r * q_r;
    double value = 28.0 / (23.0 * PI) * p[0] * (1.0 - p[1]) * t_i * t_r + gloss;
    return lit ? value : 0.0;
}

MODEL(ward)
{
    LIT
    double x = xi + xr, y = yi + yr, z = mu_i + mu_r, a2 = p[1] * p[1];
    double value = p[0] * 0.25 * INV_PI * exp(-(x * x + y * y) / (a2 * z * z)) / (a2 * sqrt(mu_i * mu_r));
    return lit ? value : 0.0;
}

MODEL(ward_duer)
{
    LIT
    double x = xi + xr, y = yi + yr, z = mu_i + mu_r, a2 = p[1] * p[1];
    double value = p[0] * 0.25 * INV_PI * exp(-(x * x + y * y) / (a2 * z * z)) / (a2 * mu_i * mu_r);
    return lit ? value : 0.0;
}

MODEL(ward_gmd)
{
    LIT
    double x = xi + xr, y = yi + yr, z = mu_i + mu_r, a2 = p[1] * p[1], s2 = x * x + y * y, z2 = z * z;
    double value = p[0] * INV_PI * exp(-s2 / (a2 * z2)) * (s2 + z2) / (a2 * z2 * z2);
    return lit ? value : 0.0;
}

/* --- scatter ------------------------------------------------------------------------------------------------------ */

MODEL(abg)
{
    double x = xi + xr, y = yi + yr;
    double value = p[0] / (p[1] + power(x * x + y * y, 0.5 * p[2]));
    return (zi > 0.0) & (zr > 0.0) ? value : 0.0;
}

MODEL(harvey_shack)
{
    double x = (xi + xr) / p[1], y = (yi + yr) / p[1];
    double value = p[0] * exp(0.5 * p[2] * log1p(x * x + y * y));
    return (zi > 0.0) & (zr > 0.0) ? value : 0.0;
}

MODEL(k_correlation)
{
    double scale = p[1] / p[3], x = scale * (xi + xr), y = scale * (yi + yr);
    double value = p[4] * zi * zr * exp(-0.5 * (p[2] + 1.0) * log1p(x * x + y * y));
    return (zi > 0.0) & (zr > 0.0) ? value : 0.0;
}

/* --- facets: f_r = k_s F D G / (4 mu_i mu_r), with M = mu Lambda -------------------------------------------------- */

typedef struct {
    double s2, z, l2, e2, si2, sr2; /* of omega_i + omega_r, of omega_i - omega_r, square sines */
} Half;

INLINE ggx_d(Half h, double a2)
{
    double t = a2 * h.z * h.z + h.s2;
    return a2 * INV_PI * h.l2 * h.l2 / (t * t);
}

INLINE ggx_m(double mu, double s2, double a2) { return 0.5 * a2 * s2 / (sqrt(mu * mu + a2 * s2) + mu); }

INLINE beckmann_d(Half h, double a2)
{
    double z2 = h.z * h.z;
    return exp(-h.s2 / (a2 * z2)) * INV_PI * h.l2 * h.l2 / (a2 * z2 * z2);
}

/* Lambda from erf and exp, as Walter et al. print it; without its digits where it is next to nothing */
INLINE beckmann_m(double mu, double s2, double a2)
{
    double y = mu / sqrt(a2 * s2 + 1e-300);
    y = y < 26.0 ? y : 26.0;
    return mu * 0.5 * (erf(y) - 1.0 + exp(-y * y) / (y * 1.77245385090551602730));
}

INLINE schlick(Half h, double f_0)
{
    double l = 1.0 - 0.5 * sqrt(h.l2), l2 = l * l;
    return f_0 + (1.0 - f_0) * l2 * l2 * l;
}

INLINE dielectric(Half h, double n)
{
    double c2 = 0.25 * h.l2, c = sqrt(c2), g = sqrt(n * n - 1.0 + c2);
    double r = (g - c) / (g + c), t = (c * (g + c) - 1.0) / (c * (g - c) + 1.0);
    return 0.5 * r * r * (1.0 + t * t);
}

INLINE conductor(Half h, double n, double k)
{
    double c2 = 0.25 * h.l2, c = sqrt(c2), s2 = 1.0 - c2, re = n * n - k * k - s2;
    double both = sqrt(re * re + 4.0 * n * n * k * k), a2 = 0.5 * (both + re), a = sqrt(a2 > 0.0 ? a2 : 0.0);
    double rs = (both + c2 - 2.0 * a * c) / (both + c2 + 2.0 * a * c);
    double rp = rs * (both * c2 + s2 * s2 - 2.0 * a * c * s2) / (both * c2 + s2 * s2 + 2.0 * a * c * s2);
    return 0.5 * (rs + rp);
}

#define HALF                                                                                                               \
    LIT                                                                                                                    \
    double x = xi + xr, y = yi + yr, z = mu_i + mu_r, u = xi - xr, v = yi - yr, w = mu_i - mu_r;                           \
    double s2 = x * x + y * y, a2 = p[1] * p[1];                                                                           \
    Half h = {s2, z, s2 + z * z, u * u + v * v + w * w, xi * xi + yi * yi, xr * xr + yr * yr};
#define SMITH(m_i, m_r) (0.25 / (mu_i * mu_r + mu_r * (m_i) + mu_i * (m_r)))

MODEL(ggx)
{
    HALF
    double value = p[0] * schlick(h, p[2]) * ggx_d(h, a2) * SMITH(ggx_m(mu_i, h.si2, a2), ggx_m(mu_r, h.sr2, a2));
    return lit ? value : 0.0;
}

#define BECKMANN(f, g)                                                                                                     \
    double value = p[0] * (f) * beckmann_d(h, a2) * (g);                                                                   \
    return lit ? value : 0.0;
#define BECKMANN_SMITH SMITH(beckmann_m(mu_i, h.si2, a2), beckmann_m(mu_r, h.sr2, a2))

MODEL(microfacet) { HALF BECKMANN(schlick(h, p[2]), BECKMANN_SMITH) }
MODEL(beckmann) { HALF BECKMANN(schlick(h, p[2]), BECKMANN_SMITH) }
MODEL(microfacet_dielectric) { HALF BECKMANN(dielectric(h, p[2]), BECKMANN_SMITH) }
MODEL(microfacet_conductor) { HALF BECKMANN(conductor(h, p[2], p[3]), BECKMANN_SMITH) }
MODEL(microfacet_none) { HALF BECKMANN(1.0, BECKMANN_SMITH) }
MODEL(microfacet_smith_separable)
{
    HALF BECKMANN(schlick(h, p[2]), 0.25 / ((mu_i + beckmann_m(mu_i, h.si2, a2)) * (mu_r + beckmann_m(mu_r, h.sr2, a2))))
}
MODEL(microfacet_v_groove)
{
    HALF BECKMANN(schlick(h, p[2]), fmin(1.0, 4.0 * z * fmin(mu_i, mu_r) / h.l2) / (4.0 * mu_i * mu_r))
}
MODEL(microfacet_ggx)
{
    HALF
    double value = p[0] * schlick(h, p[2]) * ggx_d(h, a2) * SMITH(ggx_m(mu_i, h.si2, a2), ggx_m(mu_r, h.sr2, a2));
    return lit ? value : 0.0;
}

/* Student's t: its Lambda as a polynomial of 21 terms, from p[4] on */
INLINE std_m(double mu, double s2, const double *restrict p)
{
    double b2 = (p[2] - 1.0) * p[1] * p[1] * s2, q2 = mu * mu + b2;
    double t = fmin(mu / (mu + p[4] * sqrt(q2)) * p[5] - 1.0, 1.0), w = p[26];
#pragma GCC unroll 20
    for (int k = 20; k > 0; k--)
        w = w * t + p[5 + k];
    return p[1] * sqrt(s2) * w * power(b2 / q2, p[2] - 1.5);
}

MODEL(microfacet_std)
{
    HALF
    double z2 = z * z, d = power(1.0 + s2 / ((p[2] - 1.0) * a2 * z2), -p[2]) * INV_PI * h.l2 * h.l2 / (a2 * z2 * z2);
    double value = p[0] * schlick(h, p[3]) * d * SMITH(std_m(mu_i, h.si2, p), std_m(mu_r, h.sr2, p));
    return lit ? value : 0.0;
}

/* A table in pieces of 19 coefficients each, as gonio.brdf.pieces has it */
INLINE pieces(double x, const double *restrict table, long count)
{
    long piece = (long)x;
    piece = piece < count ? piece : count - 1;
    double t = 2.0 * (x - (double)piece) - 1.0;
    const double *c = table + 19 * piece;
    double value = c[18];
#pragma GCC unroll 18
    for (int k = 17; k >= 0; k--)
        value = value * t + c[k];
    return value;
}

INLINE gtr_m(double mu, double s2, const double *restrict p)
{
    double b = p[5], r = sqrt(mu * mu + b * b * s2);
    return s2 * pieces(log((mu + r) / b) * p[6], p + 7, 12);
}

MODEL(microfacet_gtr)
{
    HALF
    double d = p[4] * power(h.l2 / (a2 * z * z + s2), p[2]);
    double value = p[0] * schlick(h, p[3]) * d * SMITH(gtr_m(mu_i, h.si2, p), gtr_m(mu_r, h.sr2, p));
    return lit ? value : 0.0;
}

/* p: k_s, alpha, f_0, then weight, two scales and the table of 1 - E over ln((mu + near) / (s + tip)), tip = 0.05 */
INLINE lost(double mu, double s2, const double *restrict p)
{
    return exp(pieces(log((mu * p[4] + 1.0) * 1.05 / (sqrt(s2) + 0.05)) * p[5], p + 6, 30));
}

MODEL(microfacet_multiple_scattering)
{
    HALF
    double once = schlick(h, p[2]) * beckmann_d(h, a2) * BECKMANN_SMITH;
    double value = p[0] * (once + p[3] * lost(mu_i, h.si2, p) * lost(mu_r, h.sr2, p));
    return lit ? value : 0.0;
}
