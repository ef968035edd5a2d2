/* Element-wise halves of a residual layer, one pass over memory each: see workspace.py.
 *
 * The layer is out = relu(gamma * (z + bias - mean) * rstd + beta) + skip, row by row, with z the matrix product in
 * bfloat16 or float32 (the file includes itself once for each) and everything else here in float32. Plain C without
 * dependencies, so that any C compiler builds it in a second; the loops are written for the compiler to vectorise. */

#ifndef ELEMENT

#include <math.h>
#include <stdint.h>
#include <string.h>

static inline float widen(uint16_t h) {
    uint32_t bits = (uint32_t)h << 16;
    float f;
    memcpy(&f, &bits, sizeof f);
    return f;
}

/* Round to nearest, ties to even; a NaN stays one because its payload never sits in the lowest bits alone here. */
static inline uint16_t narrow(float f) {
    uint32_t bits;
    memcpy(&bits, &f, sizeof bits);
    return (uint16_t)((bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16);
}

/* Sums run in LANES independent parts: one running sum would wait for its own last addition. */
#define LANES 64

static inline float total_of(const float *part) {
    float total = 0.0f;
    for (int k = 0; k < LANES; k++) total += part[k];
    return total;
}

#define ELEMENT uint16_t
#define LOAD(x) widen(x)
#define STORE(x) narrow(x)
#define NAME(x) x##_bf16
#include "kernels.c"
#undef ELEMENT
#undef LOAD
#undef STORE
#undef NAME

#define ELEMENT float
#define LOAD(x) (x)
#define STORE(x) (x)
#define NAME(x) x##_fp32
#include "kernels.c"

#else

/* z (rows, n); skip (rows, skip_stride), of which `width` columns from `from` are added to columns from `to` of out.
 * scratch: n floats. */
void NAME(layer_forward)(const ELEMENT *restrict z, const float *restrict bias, const float *restrict gamma,
                   const float *restrict beta, const ELEMENT *restrict skip, int64_t skip_stride, int64_t from,
                   int64_t to, int64_t width, float eps, int64_t rows, int64_t n, ELEMENT *restrict out,
                   float *restrict mean, float *restrict rstd, float *restrict scratch) {
    const int64_t even = n - n % LANES;
    for (int64_t r = 0; r < rows; r++) {
        const ELEMENT *restrict zr = z + r * n, *restrict x = skip + r * skip_stride + from;
        ELEMENT *restrict o = out + r * n;
        float sums[LANES] = {0}, squares[LANES] = {0};
        for (int64_t j = 0; j < even; j += LANES)
            for (int k = 0; k < LANES; k++) {
                const float v = LOAD(zr[j + k]) + bias[j + k];
                scratch[j + k] = v;
                sums[k] += v;
            }
        for (int64_t j = even; j < n; j++) {
            scratch[j] = LOAD(zr[j]) + bias[j];
            sums[0] += scratch[j];
        }
        const float mu = total_of(sums) / (float)n;
        for (int64_t j = 0; j < even; j += LANES)
            for (int k = 0; k < LANES; k++) {
                const float d = scratch[j + k] - mu;
                squares[k] += d * d;
            }
        for (int64_t j = even; j < n; j++) squares[0] += (scratch[j] - mu) * (scratch[j] - mu);
        const float s = 1.0f / sqrtf(total_of(squares) / (float)n + eps);
        mean[r] = mu;
        rstd[r] = s;
        if (width == n) {
            for (int64_t j = 0; j < n; j++) {
                const float y = gamma[j] * ((scratch[j] - mu) * s) + beta[j];
                o[j] = STORE((y < 0.0f ? 0.0f : y) + LOAD(x[j])); /* the comparison keeps a NaN */
            }
            continue;
        }
        for (int64_t j = 0; j < n; j++) {
            const float y = gamma[j] * ((scratch[j] - mu) * s) + beta[j];
            scratch[j] = y < 0.0f ? 0.0f : y;
        }
        float *restrict shifted = scratch + to;
        for (int64_t j = 0; j < width; j++) shifted[j] += LOAD(x[j]);
        for (int64_t j = 0; j < n; j++) o[j] = STORE(scratch[j]);
    }
}

static inline __attribute__((always_inline)) void NAME(backward)(
    const ELEMENT *restrict grad, const ELEMENT *restrict z, const float *restrict bias, const float *restrict gamma,
    const float *restrict beta, const float *restrict mean, const float *restrict rstd, const int64_t *restrict index,
    int64_t count, int64_t n, int trained, ELEMENT *restrict dz, float *restrict dgamma, float *restrict dbeta,
    float *restrict dbias, float *restrict scratch) {
    float *restrict w = scratch, *restrict xhat = scratch + n;
    const int64_t even = n - n % LANES;
    for (int64_t r = 0; r < count; r++) {
        const int64_t row = index ? index[r] : r;
        const ELEMENT *restrict g = grad + r * n, *restrict zr = z + row * n;
        ELEMENT *restrict d = dz + r * n;
        const float mu = mean[row], s = rstd[row];
        float sums[LANES] = {0}, dots[LANES] = {0};
        for (int64_t j = 0; j < n; j += LANES) {
            const int lanes = j < even ? LANES : (int)(n - j);
            for (int k = 0; k < lanes; k++) {
                const float h = (LOAD(zr[j + k]) + bias[j + k] - mu) * s;
                const float dy = gamma[j + k] * h + beta[j + k] <= 0.0f ? 0.0f : LOAD(g[j + k]);
                const float wj = dy * gamma[j + k];
                if (trained) {
                    dbeta[j + k] += dy;
                    dgamma[j + k] += dy * h;
                }
                xhat[j + k] = h;
                w[j + k] = wj;
                sums[k] += wj;
                dots[k] += wj * h;
            }
        }
        const float sum = total_of(sums) / (float)n, dot = total_of(dots) / (float)n;
        for (int64_t j = 0; j < n; j++) {
            const float v = s * (w[j] - sum - xhat[j] * dot);
            if (trained) dbias[j] += v;
            d[j] = STORE(v);
        }
    }
}

/* Gradient of the layer's product: dz (count, n) from grad (count, n). Row r belongs to row index[r] of z, or to row r
 * without an index. If `trained`, the parameters' gradients overwrite dgamma, dbeta and dbias, or are added to them if
 * `add`. scratch: 2 n floats. */
void NAME(layer_backward)(const ELEMENT *grad, const ELEMENT *z, const float *bias, const float *gamma, const float *beta,
                    const float *mean, const float *rstd, const int64_t *index, int64_t count, int trained, int add,
                    int64_t n, ELEMENT *dz, float *dgamma, float *dbeta, float *dbias, float *scratch) {
    if (trained && !add) {
        memset(dgamma, 0, n * sizeof(float));
        memset(dbeta, 0, n * sizeof(float));
        memset(dbias, 0, n * sizeof(float));
    }
    if (trained) {
        NAME(backward)(grad, z, bias, gamma, beta, mean, rstd, index, count, n, 1, dz, dgamma, dbeta, dbias, scratch);
    } else {
        NAME(backward)(grad, z, bias, gamma, beta, mean, rstd, index, count, n, 0, dz, dgamma, dbeta, dbias, scratch);
    }
}

#endif
