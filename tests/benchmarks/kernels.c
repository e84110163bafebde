/* The formulas of gonio's lambertian and ggx (gonio/brdf/microfacet.py) in C, for comparison.

   evaluate:  f_r at n pairs of directions, arrays of structs, as gonio's kernels get them.
   integrate: sum of w f_r cos theta_i over n nodes for one viewer, structs of arrays: the inner loop of a quadrature. */
#include <math.h>

static inline double f_r(double xi, double yi, double zi, double xr, double yr, double zr, double albedo, double k_s,
                         double alpha, double f_0)
{
    const double inv_pi = 0.31830988618379067154;
    int lit = (zi > 0.0) & (zr > 0.0);
    double mu_i = lit ? zi : 1.0, mu_r = lit ? zr : 1.0, a2 = alpha * alpha;
    double x = xi + xr, y = yi + yr, z = mu_i + mu_r;
    double s2 = x * x + y * y, l2 = s2 + z * z, t = a2 * z * z + s2;
    double d = a2 * inv_pi * l2 * l2 / (t * t);
    double si2 = xi * xi + yi * yi, sr2 = xr * xr + yr * yr;
    double g = 0.5 / (mu_r * sqrt(mu_i * mu_i + a2 * si2) + mu_i * sqrt(mu_r * mu_r + a2 * sr2));
    double c = 1.0 - 0.5 * sqrt(l2);
    c = c > 0.0 ? c : 0.0;
    double c2 = c * c, f = f_0 + (1.0 - f_0) * c2 * c2 * c;
    return lit ? albedo * inv_pi + k_s * f * d * g : 0.0;
}

void evaluate(const double *omega_i, const double *omega_r, const double *p, double *out, long n)
{
    double albedo = p[0], k_s = p[1], alpha = p[2], f_0 = p[3];
    for (long k = 0; k < n; k++)
        out[k] = f_r(omega_i[3 * k], omega_i[3 * k + 1], omega_i[3 * k + 2], omega_r[3 * k], omega_r[3 * k + 1],
                     omega_r[3 * k + 2], albedo, k_s, alpha, f_0);
}

double integrate(const double *restrict x, const double *restrict y, const double *restrict z, const double *restrict w,
                 double xr, double zr, const double *p, long n)
{
    double albedo = p[0], k_s = p[1], alpha = p[2], f_0 = p[3], total = 0.0;
    for (long k = 0; k < n; k++)
        total += w[k] * z[k] * f_r(x[k], y[k], z[k], xr, 0.0, zr, albedo, k_s, alpha, f_0);
    return total;
}
