// The kernels of kernels_numba.py and sh_compiled.py for a GPU: float32, one thread for each sample, ray or coefficient.
// They are compiled at run time by NVRTC (cuda_kernels.py), and by a C++ compiler in the tests. Scalars come as int or
// double. Sums of several threads are added in an order that depends on timing: a fit on a GPU is not repeatable bit by
// bit.

#define EACH(n, count)                                 \
    const int n = blockIdx.x * blockDim.x + threadIdx.x; \
    if (n >= (count)) return

// ---------------------------------------------------------------- spline SDF (pipeline.maths.sdf)
struct Axis {
    int node;     // the nearest one that is not on the border
    float w[3];   // weights of the nodes node - 1 .. node + 1
    float dw[3];  // their derivatives by u
};

__device__ Axis axis_at(float u, int top) {
    Axis a;
    a.node = min(max((int)floorf(u + 0.5f), 1), top - 2);
    const float f = fminf(fmaxf(u - (float)a.node, -0.5f), 0.5f);
    a.w[0] = 0.5f * (0.5f - f) * (0.5f - f);
    a.w[1] = 0.75f - f * f;
    a.w[2] = 0.5f * (0.5f + f) * (0.5f + f);
    a.dw[0] = f - 0.5f;
    a.dw[1] = -2.0f * f;
    a.dw[2] = f + 0.5f;
    return a;
}

__device__ float value_at(const float* values, int sx, int sy, int sz, const float* lo, float inv, float x, float y,
                          float z) {
    const Axis a = axis_at((x - lo[0]) * inv, sx), b = axis_at((y - lo[1]) * inv, sy),
               c = axis_at((z - lo[2]) * inv, sz);
    float total = 0.0f;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            const float* v = values + ((long long)(a.node + i - 1) * sy + (b.node + j - 1)) * sz + c.node - 1;
            total += a.w[i] * b.w[j] * (c.w[0] * v[0] + c.w[1] * v[1] + c.w[2] * v[2]);
        }
    return total;
}

// SDF s (count,) and gradient g (count, 3) at x (count, 3).
extern "C" __global__ void spline_forward(int count, const float* values, int sx, int sy, int sz, const float* lo,
                                          double inverse_cell, const float* x, float* s, float* g) {
    EACH(n, count);
    const float inv = (float)inverse_cell;
    const Axis a = axis_at((x[3 * n] - lo[0]) * inv, sx), b = axis_at((x[3 * n + 1] - lo[1]) * inv, sy),
               c = axis_at((x[3 * n + 2] - lo[2]) * inv, sz);
    float t = 0.0f, gx = 0.0f, gy = 0.0f, gz = 0.0f;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            const float* v = values + ((long long)(a.node + i - 1) * sy + (b.node + j - 1)) * sz + c.node - 1;
            const float line = c.w[0] * v[0] + c.w[1] * v[1] + c.w[2] * v[2];
            t += a.w[i] * b.w[j] * line;
            gx += a.dw[i] * b.w[j] * line;
            gy += a.w[i] * b.dw[j] * line;
            gz += a.w[i] * b.w[j] * (c.dw[0] * v[0] + c.dw[1] * v[1] + c.dw[2] * v[2]);
        }
    s[n] = t;
    g[3 * n] = gx * inv;
    g[3 * n + 1] = gy * inv;
    g[3 * n + 2] = gz * inv;
}

// Add the gradient of the coefficients to out (sx, sy, sz), from those of s (count,) and g (count, 3).
extern "C" __global__ void spline_backward(int count, float* out, int sx, int sy, int sz, const float* lo,
                                           double inverse_cell, const float* x, const float* gs, const float* gg) {
    EACH(n, count);
    const float inv = (float)inverse_cell;
    const Axis a = axis_at((x[3 * n] - lo[0]) * inv, sx), b = axis_at((x[3 * n + 1] - lo[1]) * inv, sy),
               c = axis_at((x[3 * n + 2] - lo[2]) * inv, sz);
    const float s = gs[n], px = gg[3 * n] * inv, py = gg[3 * n + 1] * inv, pz = gg[3 * n + 2] * inv;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            float* v = out + ((long long)(a.node + i - 1) * sy + (b.node + j - 1)) * sz + c.node - 1;
            const float flat = s * a.w[i] * b.w[j] + px * a.dw[i] * b.w[j] + py * a.w[i] * b.dw[j];
            const float deep = pz * a.w[i] * b.w[j];
            for (int k = 0; k < 3; ++k) atomicAdd(v + k, flat * c.w[k] + deep * c.dw[k]);
        }
}

// Sphere tracing (pipeline.maths.tracing.sphere_trace): t, hit and SDF of the first hit or of the closest approach.
extern "C" __global__ void march(int count, const float* values, int sx, int sy, int sz, const float* lo,
                                 double inverse_cell, const float* o, const float* d, const float* t_near,
                                 const float* t_far, double factor_, double min_step_, int max_steps, int refine_steps,
                                 float* t_out, bool* hit, float* s_out) {
    EACH(n, count);
    const float inv = (float)inverse_cell, factor = (float)factor_, min_step = (float)min_step_;
    const float ox = o[3 * n], oy = o[3 * n + 1], oz = o[3 * n + 2];
    const float dx = d[3 * n], dy = d[3 * n + 1], dz = d[3 * n + 2], far = t_far[n];
    float t = t_near[n];
    float s = value_at(values, sx, sy, sz, lo, inv, ox + t * dx, oy + t * dy, oz + t * dz);
    float best_t = t, best_s = s;
    bool found = false;
    for (int step = 0; step < max_steps && far > t && s > 0.0f; ++step) {
        float t1 = fminf(t + fmaxf(factor * s, min_step), far);
        float s1 = value_at(values, sx, sy, sz, lo, inv, ox + t1 * dx, oy + t1 * dy, oz + t1 * dz);
        if (s1 <= 0.0f) {  // the Illinois method
            float t0 = t, s0 = s;
            int last = 0;
            for (int k = 0; k < refine_steps; ++k) {
                best_t = t0 + (t1 - t0) * (s0 / fmaxf(s0 - s1, 1e-12f));
                best_s = value_at(values, sx, sy, sz, lo, inv, ox + best_t * dx, oy + best_t * dy, oz + best_t * dz);
                if (fabsf(best_s) < 1e-3f * min_step) break;
                if (best_s > 0.0f) {
                    t0 = best_t;
                    s0 = best_s;
                    if (last == 1) s1 *= 0.5f;
                    last = 1;
                } else {
                    t1 = best_t;
                    s1 = best_s;
                    if (last == -1) s0 *= 0.5f;
                    last = -1;
                }
            }
            found = true;
            break;
        }
        if (s1 < best_s) {
            best_t = t1;
            best_s = s1;
        }
        t = t1;
        s = s1;
    }
    t_out[n] = best_t;
    hit[n] = found;
    s_out[n] = best_s;
}

// One Adam step on the coefficients `active` (count,), flat indices, that have a gradient, which it clears.
extern "C" __global__ void band_adam(int count, float* values, float* grad, float* m, float* v, const long long* active,
                                     double lr, double b1, double b2, double eps, double c1, double c2) {
    EACH(n, count);
    const long long i = active[n];
    const float g = grad[i];
    if (g == 0.0f) return;
    grad[i] = 0.0f;
    m[i] = (float)b1 * m[i] + (float)(1.0 - b1) * g;
    v[i] = (float)b2 * v[i] + (float)(1.0 - b2) * g * g;
    values[i] -= (float)lr * (m[i] / (float)c1) / (sqrtf(v[i] / (float)c2) + (float)eps);
}

// ---------------------------------------------------------------- hash encoding (pipeline.fields.encodings)
struct Cell {
    int i, j, k;
    float f[3];
};

__device__ Cell cell_at(const float* x, const float* lo, float inv, const long long* size) {
    Cell c;
    int* node[3] = {&c.i, &c.j, &c.k};
    for (int a = 0; a < 3; ++a) {
        const float u = (x[a] - lo[a]) * inv;
        *node[a] = min(max((int)floorf(u), 0), (int)size[a] - 2);
        c.f[a] = fminf(fmaxf(u - (float)*node[a], 0.0f), 1.0f);
    }
    return c;
}

__device__ long long row_of(int i, int j, int k, const long long* size, bool hashed, int mask) {
    if (hashed) return ((unsigned)i ^ ((unsigned)j * 2654435761u) ^ ((unsigned)k * 805459861u)) & (unsigned)mask;
    return ((long long)i * size[1] + j) * size[2] + k;
}

// Trilinear features out (samples, 2 levels) at x (samples, 3); count = samples * levels.
extern "C" __global__ void hash_forward(int count, int levels, const float* table, const long long* offset,
                                        const long long* size, const bool* hashed, int mask, const float* lo,
                                        const float* inv, const float* x, float* out) {
    EACH(q, count);
    const int n = q / levels, level = q % levels;
    const long long* own = size + 3 * level;
    const Cell c = cell_at(x + 3 * n, lo, inv[level], own);
    float a0 = 0.0f, a1 = 0.0f;
    for (int corner = 0; corner < 8; ++corner) {
        const int di = corner >> 2, dj = (corner >> 1) & 1, dk = corner & 1;
        const float w = (di ? c.f[0] : 1.0f - c.f[0]) * (dj ? c.f[1] : 1.0f - c.f[1]) * (dk ? c.f[2] : 1.0f - c.f[2]);
        const long long at = offset[level] + row_of(c.i + di, c.j + dj, c.k + dk, own, hashed[level], mask);
        a0 += w * table[2 * at];
        a1 += w * table[2 * at + 1];
    }
    out[2 * q] = a0;
    out[2 * q + 1] = a1;
}

// Add the gradients of the table and of x (samples, 3), from those of out (samples, 2 levels).
extern "C" __global__ void hash_backward(int count, int levels, const float* table, const long long* offset,
                                         const long long* size, const bool* hashed, int mask, const float* lo,
                                         const float* inv, const float* x, const float* grad_out, float* grad_table,
                                         float* grad_x) {
    EACH(q, count);
    const int n = q / levels, level = q % levels;
    const long long* own = size + 3 * level;
    const Cell c = cell_at(x + 3 * n, lo, inv[level], own);
    const float g0 = grad_out[2 * q], g1 = grad_out[2 * q + 1];
    float g[3] = {0.0f, 0.0f, 0.0f};
    for (int corner = 0; corner < 8; ++corner) {
        const int di = corner >> 2, dj = (corner >> 1) & 1, dk = corner & 1;
        const float wx = di ? c.f[0] : 1.0f - c.f[0], wy = dj ? c.f[1] : 1.0f - c.f[1],
                    wz = dk ? c.f[2] : 1.0f - c.f[2];
        const long long at = offset[level] + row_of(c.i + di, c.j + dj, c.k + dk, own, hashed[level], mask);
        atomicAdd(grad_table + 2 * at, wx * wy * wz * g0);
        atomicAdd(grad_table + 2 * at + 1, wx * wy * wz * g1);
        const float v = g0 * table[2 * at] + g1 * table[2 * at + 1];
        g[0] += (di ? v : -v) * wy * wz;
        g[1] += (dj ? v : -v) * wx * wz;
        g[2] += (dk ? v : -v) * wx * wy;
    }
    for (int a = 0; a < 3; ++a)
        if (c.f[a] > 0.0f && c.f[a] < 1.0f) atomicAdd(grad_x + 3 * n + a, g[a] * inv[level]);
}

// ---------------------------------------------------------------- spherical harmonics (pipeline.maths.sh)
// Y_lm (count, (order + 1)^2) at d (count, 3). start (order + 1,), a, b (order + 1, order + 1): sh_recurrence.tables.
extern "C" __global__ void sh_forward(int count, int order, const float* start, const float* a, const float* b,
                                      const float* d, float* out) {
    EACH(n, count);
    const float x = d[3 * n], y = d[3 * n + 1], z = d[3 * n + 2];
    float* own = out + (long long)n * (order + 1) * (order + 1);
    float cm = 1.0f, sm = 0.0f;
    for (int m = 0; m <= order; ++m) {
        float p = start[m], before = 0.0f;
        for (int l = m; l <= order; ++l) {
            if (l > m) {
                const float next = a[l * (order + 1) + m] * z * p - b[l * (order + 1) + m] * before;
                before = p;
                p = next;
            }
            own[l * (l + 1) + m] = p * cm;
            if (m) own[l * (l + 1) - m] = p * sm;
        }
        const float c = cm;
        cm = x * c - y * sm;
        sm = x * sm + y * c;
    }
}

// The gradient of d (count, 3), from that of the basis (count, (order + 1)^2).
extern "C" __global__ void sh_backward(int count, int order, const float* start, const float* a, const float* b,
                                       const float* d, const float* grad, float* grad_d) {
    EACH(n, count);
    const float x = d[3 * n], y = d[3 * n + 1], z = d[3 * n + 2];
    const float* own = grad + (long long)n * (order + 1) * (order + 1);
    float cm = 1.0f, sm = 0.0f, cl = 0.0f, sl = 0.0f;  // of m, and of m - 1
    float gx = 0.0f, gy = 0.0f, gz = 0.0f;
    for (int m = 0; m <= order; ++m) {
        float p = start[m], before = 0.0f, s = 0.0f, s_before = 0.0f;  // s: derivative of p by z
        for (int l = m; l <= order; ++l) {
            if (l > m) {
                const float al = a[l * (order + 1) + m], bl = b[l * (order + 1) + m];
                const float s_next = al * (p + z * s) - bl * s_before, next = al * z * p - bl * before;
                s_before = s;
                s = s_next;
                before = p;
                p = next;
            }
            const float plus = own[l * (l + 1) + m], minus = m ? own[l * (l + 1) - m] : 0.0f;
            gx += m * p * (plus * cl + minus * sl);
            gy += m * p * (minus * cl - plus * sl);
            gz += s * (plus * cm + minus * sm);
        }
        cl = cm;
        sl = sm;
        cm = x * cl - y * sl;
        sm = x * sl + y * cl;
    }
    grad_d[3 * n] = gx;
    grad_d[3 * n + 1] = gy;
    grad_d[3 * n + 2] = gz;
}
