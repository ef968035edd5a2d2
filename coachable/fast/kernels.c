/* Element-wise halves of a residual layer, one pass over memory each: see workspace.py; and the optimiser's step, see
 * flat_adam.py.
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

/* While this is in scope, floats below 1.2e-38 count as 0, with which some processors take over a hundred cycles each. The
 * gradients of a distribution over many bins have them. */
#ifdef __SSE2__
#include <immintrin.h>

static inline void set_mode(const unsigned *mode) { _mm_setcsr(*mode); }
#define FLUSH_TINY                                                                                   \
    const unsigned mode __attribute__((cleanup(set_mode))) = _mm_getcsr(), flushing = mode | 0x8040; \
    set_mode(&flushing);
#else
#define FLUSH_TINY
#endif

/* Sums run in LANES independent parts: one running sum would wait for its own last addition. */
#define LANES 64

static inline float total_of(const float *part) {
    float total = 0.0f;
    for (int k = 0; k < LANES; k++) total += part[k];
    return total;
}

typedef struct {
    int64_t size;
    float *value, *first, *second; /* the parameter and its moments */
    const float *grad;
    uint16_t *rounded; /* or null */
    float *target; /* or null */
    uint16_t *target_rounded; /* if there is a target and a rounded copy of the parameter */
} Parameter;

static inline __attribute__((always_inline)) void adam_on(
    int64_t size, float *restrict value, float *restrict first, float *restrict second,
    const float *restrict grad, uint16_t *restrict rounded, float *restrict target, uint16_t *restrict target_rounded, int rounds, int follows,
    float rate, float beta1, float beta2, float root, float eps, float tau) {
    for (int64_t j = 0; j < size; j++) {
        const float g = grad[j], m = first[j] + (1.0f - beta1) * (g - first[j]);
        const float v = beta2 * second[j] + (1.0f - beta2) * g * g;
        const float x = value[j] - rate * m / (sqrtf(v) * root + eps);
        first[j] = m;
        second[j] = v;
        value[j] = x;
        if (rounds) rounded[j] = narrow(x);
        if (follows) {
            const float y = target[j] + tau * (x - target[j]);
            target[j] = y;
            if (rounds) target_rounded[j] = narrow(y);
        }
    }
}

/* One step of Adam with rate = learning rate / (1 - beta1^t) and root = 1 / sqrt(1 - beta2^t); the targets, if there
 * are any, then move by tau, and the rounded copies, if any, are renewed. */
void adam(const Parameter *parameters, int64_t count, float rate, float beta1, float beta2, float root, float eps,
          float tau) {
    FLUSH_TINY
    for (int64_t i = 0; i < count; i++) {
        const Parameter p = parameters[i];
#define ADAM(rounds, follows)                                                                                     \
    adam_on(p.size, p.value, p.first, p.second, p.grad, p.rounded, p.target, p.target_rounded, rounds, follows, rate, \
            beta1, beta2, root, eps, tau)
        if (p.rounded)
            p.target ? ADAM(1, 1) : ADAM(1, 0);
        else
            p.target ? ADAM(0, 1) : ADAM(0, 0);
#undef ADAM
    }
}

/* Products of matrices of float32 or bfloat16 numbers with float32 sums, on one thread. The right factor is packed first,
 * into memory that stays in the cache from product to product: blocks of BLOCK columns, each (depth, BLOCK). Sums are made
 * for PANEL rows at once. */
#if defined(__AVX2__) && defined(__FMA__)
#define PRODUCTS
#include <stdlib.h>

#define ROWS 6 /* of sums in vector registers at once */
#ifdef __AVX512F__
#define WIDTH 16 /* floats of a vector register; ROWS x BLOCK sums leave 8 of 32 registers */
#define BLOCK 64
#else
#define WIDTH 8 /* and 4 of 16 registers */
#define BLOCK 16
#endif
#define VECTORS (BLOCK / WIDTH)

static inline int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }

/* The thread's memory for packed factors, of `size` bytes. */
static void *packing_memory(int64_t size) {
    static _Thread_local void *memory;
    static _Thread_local int64_t held;
    if (size > held) {
        free(memory);
        held = (size + 4095) / 4096 * 4096;
        memory = aligned_alloc(64, held);
    }
    return memory;
}

/* ROWS rows of a left factor: addresses of their first numbers, and how far apart the numbers of a row are. */
#define PANEL_fp32 ROWS

typedef struct {
    const float *row[ROWS];
    int64_t step;
} Panel_fp32;

/* Length of a packed column. */
static inline int64_t depth_fp32(int64_t inner) { return inner; }
#define USE_TILES_fp32

/* Rows from i of a row-major matrix; beyond the last, the last again. */
static inline Panel_fp32 panel_of_fp32(const float *matrix, int64_t stride, int64_t i, int64_t rows, int64_t inner,
                                       float *memory) {
    (void)inner, (void)memory;
    Panel_fp32 panel = {.step = 1};
    for (int r = 0; r < ROWS; r++) panel.row[r] = matrix + smaller(i + r, rows - 1) * stride;
    return panel;
}

/* What panel_of_columns reads, of a matrix (rows, m). */
static inline const float *columns_of_fp32(const float *matrix, int64_t rows, int64_t m, float *packed) {
    (void)rows, (void)m, (void)packed;
    return matrix;
}

/* Columns from i as rows. */
static inline Panel_fp32 panel_of_columns_fp32(const float *columns, int64_t i, int64_t m, int64_t depth, float *memory) {
    (void)depth, (void)memory;
    Panel_fp32 panel = {.step = m};
    for (int r = 0; r < ROWS; r++) panel.row[r] = columns + smaller(i + r, m - 1);
    return panel;
}

/* sums (ROWS, BLOCK) of the products of a panel with one block of a right factor. */
static inline void multiply_fp32(const Panel_fp32 *left, const float *right, int64_t depth, int64_t columns, float *sums) {
    (void)columns;
    typedef float Vector __attribute__((vector_size(4 * WIDTH), aligned(4), may_alias));
    const float *row[ROWS];
    Vector s[ROWS][VECTORS] = {0}, y[VECTORS];
    for (int r = 0; r < ROWS; r++) row[r] = left->row[r];
    for (int64_t k = 0; k < depth; k++, right += BLOCK) {
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) y[v] = *(const Vector *)(right + v * WIDTH);
#pragma GCC unroll 6
        for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 4
            for (int v = 0; v < VECTORS; v++) s[r][v] += row[r][k * left->step] * y[v];
    }
#pragma GCC unroll 6
    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 4
        for (int v = 0; v < VECTORS; v++) *(Vector *)(sums + r * BLOCK + v * WIDTH) = s[r][v];
}

/* Transpose 8 x 8 numbers. */
static inline void transpose_fp32(const float *from, int64_t from_stride, float *to, int64_t to_stride) {
    __m256 m[8], pairs[8];
#pragma GCC unroll 8
    for (int r = 0; r < 8; r++) m[r] = _mm256_loadu_ps(from + r * from_stride);
#pragma GCC unroll 4
    for (int r = 0; r < 8; r += 2) {
        pairs[r] = _mm256_unpacklo_ps(m[r], m[r + 1]);
        pairs[r + 1] = _mm256_unpackhi_ps(m[r], m[r + 1]);
    }
#pragma GCC unroll 2
    for (int half = 0; half < 8; half += 4)
#pragma GCC unroll 2
        for (int r = 0; r < 2; r++) {
            m[half + 2 * r] = _mm256_shuffle_ps(pairs[half + r], pairs[half + r + 2], 0x44);
            m[half + 2 * r + 1] = _mm256_shuffle_ps(pairs[half + r], pairs[half + r + 2], 0xee);
        }
#pragma GCC unroll 4
    for (int r = 0; r < 4; r++) {
        _mm256_storeu_ps(to + r * to_stride, _mm256_permute2f128_ps(m[r], m[r + 4], 0x20));
        _mm256_storeu_ps(to + (r + 4) * to_stride, _mm256_permute2f128_ps(m[r], m[r + 4], 0x31));
    }
}

/* Right factor from a matrix (n, inner) of which the transpose is wanted. */
static void pack_transposed_fp32(const float *matrix, int64_t n, int64_t inner, float *packed) {
    for (int64_t j = 0; j < (n + BLOCK - 1) / BLOCK * BLOCK; j += 8) {
        const float *from = matrix + j * inner;
        float *to = packed + j / BLOCK * inner * BLOCK + j % BLOCK;
        int64_t k = 0;
        for (; j + 8 <= n && k + 8 <= inner; k += 8) transpose_fp32(from + k, inner, to + k * BLOCK, BLOCK);
        for (; k < inner; k++)
            for (int64_t c = 0; c < 8; c++) to[k * BLOCK + c] = j + c < n ? from[c * inner + k] : 0.0f;
    }
}

/* Right factor from a matrix (inner, n) with rows `stride` apart. */
static void pack_fp32(const float *matrix, int64_t inner, int64_t n, int64_t stride, float *packed) {
    for (int64_t some = 0; some < inner; some += 8) /* so that rows are read in a piece */
        for (int64_t j = 0; j < n; j += BLOCK) {
            const int64_t columns = smaller(BLOCK, n - j);
            for (int64_t k = some; k < smaller(some + 8, inner); k++) {
                float *to = packed + j * inner + k * BLOCK;
                const float *from = matrix + k * stride + j;
                if (columns == BLOCK)
                    memcpy(to, from, BLOCK * sizeof *to);
                else
                    for (int64_t c = 0; c < BLOCK; c++) to[c] = c < columns ? from[c] : 0.0f;
            }
        }
}
#endif

/* The same for bfloat16: the inner dimension goes in pairs, and what does not fill its pairs is filled up with zeros. Sums
 * are made in vector registers, or in tiles where the processor has them (AMX). */
#ifdef __AVX512BF16__
#include <sys/syscall.h>
#include <unistd.h>

#define EACH_ROW(DO) DO(0) DO(1) DO(2) DO(3) DO(4) DO(5)

/* Transpose 16 x 16 numbers of 32 bits: exchange halves, then quarters, and so on. */
static inline void transpose(__m512i *m) {
    const __m512i column = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
#pragma GCC unroll 4
    for (int d = 8; d; d /= 2) {
        const __mmask16 right = _mm512_test_epi32_mask(column, _mm512_set1_epi32(d));
        const __m512i shift = _mm512_set1_epi32(d), other = _mm512_set1_epi32(16);
        const __m512i upper = _mm512_mask_add_epi32(column, right, _mm512_sub_epi32(column, shift), other);
        const __m512i lower = _mm512_mask_add_epi32(_mm512_add_epi32(column, shift), right, column, other);
#pragma GCC unroll 16
        for (int r = 0; r < 16; r++) {
            if (r & d) continue;
            const __m512i one = m[r], two = m[r + d];
            m[r] = _mm512_permutex2var_epi32(one, upper, two);
            m[r + d] = _mm512_permutex2var_epi32(one, lower, two);
        }
    }
}

/* PANEL_bf16 rows of a left factor, and their products with one block of a right factor. */
#if defined(__AMX_BF16__) && defined(__linux__)
#define PANEL_bf16 32

typedef struct {
    const uint16_t *first;
    int64_t stride;
} Panel_bf16;

/* Pairs of an inner dimension: a tile holds 16. */
static inline int64_t pairs_of(int64_t inner) { return (inner + 31) / 32 * 16; }

typedef struct {
    uint8_t palette, start, reserved[14];
    uint16_t bytes[16];
    uint8_t rows[16];
} Tiles;

/* Compilers do not know all memory that instructions on tiles read and write. */
#define TOUCH(address) __asm__ volatile("" ::"r"(address) : "memory")

static void load_tiles(const Tiles *wanted) {
    TOUCH(wanted);
    _tile_loadconfig(wanted);
}

/* Set tiles of 16 rows of 64 bytes, and return the settings before. */
static Tiles set_tiles(void) {
    Tiles wanted = {.palette = 1}, before;
    for (int i = 0; i < 8; i++) wanted.bytes[i] = 64, wanted.rows[i] = 16;
    TOUCH(&before);
    _tile_storeconfig(&before);
    TOUCH(&before);
    load_tiles(&wanted);
    return before;
}

/* While this is in scope, the tiles are ours. Others on this thread may have settings of their own, which are put back. */
#define USE_TILES_bf16 const Tiles before __attribute__((cleanup(load_tiles))) = set_tiles();

/* Whether the kernel lets this process use tiles. */
int tiles_allowed(void) { return !syscall(SYS_arch_prctl, 0x1023 /* ARCH_REQ_XCOMP_PERM */, 18 /* their data */); }

/* Rows from i of a row-major matrix (rows, inner); copied to `memory` if they do not fill the tiles. */
static inline Panel_bf16 panel_of_bf16(const uint16_t *matrix, int64_t stride, int64_t i, int64_t rows, int64_t inner,
                                       uint16_t *memory) {
    const int64_t width = 2 * pairs_of(inner), count = smaller(PANEL_bf16, rows - i);
    if (count == PANEL_bf16 && width == inner) return (Panel_bf16){matrix + i * stride, stride};
    for (int64_t r = 0; r < count; r++) {
        memcpy(memory + r * width, matrix + (i + r) * stride, inner * sizeof *memory);
        memset(memory + r * width + inner, 0, (width - inner) * sizeof *memory);
    }
    memset(memory + count * width, 0, (PANEL_bf16 - count) * width * sizeof *memory);
    return (Panel_bf16){memory, width};
}

/* Columns from i of a matrix (inner, m) that is packed like a right factor, as rows. */
static inline Panel_bf16 panel_of_columns_bf16(const uint16_t *packed, int64_t i, int64_t m, int64_t depth, uint16_t *memory) {
    (void)m;
    const int64_t pairs = depth / 2;
    for (int64_t c = i; c < i + PANEL_bf16; c += 16)
        for (int64_t k = 0; k < pairs; k += 16) {
            const uint16_t *from = packed + (c / BLOCK * pairs + k) * 2 * BLOCK + c % BLOCK * 2;
            __m512i t[16];
            for (int64_t r = 0; r < 16; r++) t[r] = _mm512_loadu_si512(from + r * 2 * BLOCK);
            transpose(t);
            for (int64_t r = 0; r < 16; r++) _mm512_storeu_si512(memory + (c - i + r) * 2 * pairs + 2 * k, t[r]);
        }
    return (Panel_bf16){memory, 2 * pairs};
}

static inline void multiply_bf16(const Panel_bf16 *left, const uint16_t *right, int64_t depth, int64_t columns, float *sums) {
    const int64_t pairs = depth / 2;
    TOUCH(left->first);
    for (int64_t c = 0; c < smaller(BLOCK, columns); c += 32) {
        _tile_zero(0);
        _tile_zero(1);
        _tile_zero(2);
        _tile_zero(3);
        for (int64_t k = 0; k < pairs; k += 16) {
            const uint16_t *x = left->first + 2 * k, *y = right + k * 2 * BLOCK + 2 * c;
            _tile_loadd(4, x, 2 * left->stride);
            _tile_loadd(6, y, 4 * BLOCK);
            _tile_loadd(7, y + 32, 4 * BLOCK);
            _tile_loadd(5, x + 16 * left->stride, 2 * left->stride);
            _tile_dpbf16ps(0, 4, 6);
            _tile_dpbf16ps(1, 4, 7);
            _tile_dpbf16ps(2, 5, 6);
            _tile_dpbf16ps(3, 5, 7);
        }
        _tile_stored(0, sums + c, 4 * BLOCK);
        _tile_stored(1, sums + c + 16, 4 * BLOCK);
        _tile_stored(2, sums + 16 * BLOCK + c, 4 * BLOCK);
        _tile_stored(3, sums + 16 * BLOCK + c + 16, 4 * BLOCK);
    }
}
#else
#define PANEL_bf16 ROWS

typedef struct {
    const uint16_t *row[ROWS];
    int64_t step;
} Panel_bf16;

static inline int64_t pairs_of(int64_t inner) { return (inner + 1) / 2; }

#define USE_TILES_bf16
int tiles_allowed(void) { return 0; }

static inline Panel_bf16 panel_of_bf16(const uint16_t *matrix, int64_t stride, int64_t i, int64_t rows, int64_t inner,
                                       uint16_t *memory) {
    (void)inner, (void)memory;
    Panel_bf16 panel = {.step = 2};
    for (int r = 0; r < ROWS; r++) panel.row[r] = matrix + smaller(i + r, rows - 1) * stride;
    return panel;
}

static inline Panel_bf16 panel_of_columns_bf16(const uint16_t *packed, int64_t i, int64_t m, int64_t depth, uint16_t *memory) {
    (void)memory;
    Panel_bf16 panel = {.step = 2 * BLOCK};
    for (int64_t r = 0; r < ROWS; r++) {
        const int64_t column = smaller(i + r, m - 1);
        panel.row[r] = packed + column / BLOCK * depth * BLOCK + column % BLOCK * 2;
    }
    return panel;
}

/* sums (ROWS, BLOCK) from ROWS addresses of pairs, `step` elements apart, and one block of the right factor. */
static inline void tile(const uint16_t *const *left, int64_t step, const uint16_t *right, int64_t pairs, float *sums) {
    __m512bh x;
    int32_t pair;
#define START(r)                                                                                     \
    const uint16_t *p##r = left[r];                                                                  \
    __m512 s##r##0 = _mm512_setzero_ps(), s##r##1 = s##r##0, s##r##2 = s##r##0, s##r##3 = s##r##0;
#define ADD(s, y) s = _mm512_dpbf16_ps(s, x, y)
#define MULTIPLY(r)                                     \
    memcpy(&pair, p##r + k * step, sizeof pair);        \
    x = (__m512bh)_mm512_set1_epi32(pair);              \
    ADD(s##r##0, y0);                                   \
    ADD(s##r##1, y1);                                   \
    ADD(s##r##2, y2);                                   \
    ADD(s##r##3, y3);
#define FINISH(r)                                       \
    _mm512_storeu_ps(sums + r * BLOCK, s##r##0);        \
    _mm512_storeu_ps(sums + r * BLOCK + 16, s##r##1);   \
    _mm512_storeu_ps(sums + r * BLOCK + 32, s##r##2);   \
    _mm512_storeu_ps(sums + r * BLOCK + 48, s##r##3);
    EACH_ROW(START)
    for (int64_t k = 0; k < pairs; k++) {
        const uint16_t *y = right + k * 2 * BLOCK;
        const __m512bh y0 = (__m512bh)_mm512_loadu_si512(y), y1 = (__m512bh)_mm512_loadu_si512(y + 32);
        const __m512bh y2 = (__m512bh)_mm512_loadu_si512(y + 64), y3 = (__m512bh)_mm512_loadu_si512(y + 96);
        EACH_ROW(MULTIPLY)
    }
    EACH_ROW(FINISH)
}

static inline void multiply_bf16(const Panel_bf16 *left, const uint16_t *right, int64_t depth, int64_t columns, float *sums) {
    (void)columns;
    tile(left->row, left->step, right, depth / 2, sums);
}
#endif

static inline int64_t depth_bf16(int64_t inner) { return 2 * pairs_of(inner); }

/* Right factor from a matrix (n, inner) of which the transpose is wanted. */
static void pack_transposed_bf16(const uint16_t *matrix, int64_t n, int64_t inner, uint16_t *packed) {
    const int64_t pairs = pairs_of(inner);
    for (int64_t j = 0; j < n; j += 16) {
        uint16_t *to = packed + j / BLOCK * pairs * 2 * BLOCK + j % BLOCK * 2;
        for (int64_t k = 0; k < inner; k += 32) {
            const __mmask32 present = (__mmask32)(((uint64_t)1 << smaller(32, inner - k)) - 1);
            __m512i m[16];
            for (int64_t r = 0; r < 16; r++) {
                const uint16_t *from = matrix + (j + r) * inner + k;
                m[r] = j + r < n ? _mm512_maskz_loadu_epi16(present, from) : _mm512_setzero_si512();
                _mm_prefetch(from + 16 * inner, _MM_HINT_T0); /* the processor does not guess this order */
            }
            transpose(m);
            for (int64_t r = 0; r < smaller(16, pairs - k / 2); r++)
                _mm512_storeu_si512(to + (k / 2 + r) * 2 * BLOCK, m[r]);
        }
    }
}

/* Right factor from a matrix (inner, n) with rows `stride` apart. */
static void pack_bf16(const uint16_t *matrix, int64_t inner, int64_t n, int64_t stride, uint16_t *packed) {
    const int64_t pairs = pairs_of(inner);
    for (int64_t k = 0; k < 2 * pairs; k += 2)
        for (int64_t j = 0; j < n; j += BLOCK) {
            const int64_t columns = smaller(BLOCK, n - j);
            const uint16_t *one = matrix + k * stride + j, *two = one + stride;
            uint32_t pair[BLOCK] = {0};
            for (int64_t ahead = 8; ahead < 10; ahead++) {
                _mm_prefetch(one + ahead * stride, _MM_HINT_T0);
                _mm_prefetch(one + ahead * stride + 32, _MM_HINT_T0);
            }
            if (k + 1 < inner)
                for (int64_t c = 0; c < columns; c++) pair[c] = one[c] | (uint32_t)two[c] << 16;
            else if (k < inner)
                for (int64_t c = 0; c < columns; c++) pair[c] = one[c];
            memcpy(packed + 2 * j * pairs + k * BLOCK, pair, sizeof pair);
        }
}

static inline const uint16_t *columns_of_bf16(const uint16_t *matrix, int64_t rows, int64_t m, uint16_t *packed) {
    pack_bf16(matrix, rows, m, m, packed);
    return packed;
}
#endif

/* The functions below for each type; the file includes itself, and undefines the type at its end. */
#define ELEMENT float
#define LOAD(x) (x)
#define STORE(x) (x)
#define NAME(x) x##_fp32
#ifdef PRODUCTS
#define DENSE
#endif
#include "kernels.c"

#define ELEMENT uint16_t
#define LOAD(x) widen(x)
#define STORE(x) narrow(x)
#define NAME(x) x##_bf16
#ifdef __AVX512BF16__
#define DENSE
#endif
#include "kernels.c"

#else

/* z (rows, n); skip (rows, skip_stride), of which `width` columns from `from` are added to columns from `to` of out.
 * scratch: n floats. */
void NAME(layer_forward)(const ELEMENT *restrict z, const float *restrict bias, const float *restrict gamma,
                   const float *restrict beta, const ELEMENT *restrict skip, int64_t skip_stride, int64_t from,
                   int64_t to, int64_t width, float eps, int64_t rows, int64_t n, ELEMENT *restrict out,
                   float *restrict mean, float *restrict rstd, float *restrict scratch) {
    FLUSH_TINY
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
    FLUSH_TINY
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

/* A linear head of few outputs: y (rows, outputs) from x (rows, n). */
void NAME(head_forward)(const ELEMENT *restrict x, const float *restrict weight, const float *restrict bias, int64_t rows,
                        int64_t n, int64_t outputs, float *restrict y) {
    FLUSH_TINY
    const int64_t even = n - n % LANES;
    for (int64_t r = 0; r < rows; r++, x += n)
        for (int64_t o = 0; o < outputs; o++) {
            const float *restrict w = weight + o * n;
            float sums[LANES] = {0};
            for (int64_t j = 0; j < even; j += LANES)
                for (int k = 0; k < LANES; k++) sums[k] += LOAD(x[j + k]) * w[j + k];
            for (int64_t j = even; j < n; j++) sums[0] += LOAD(x[j]) * w[j];
            y[r * outputs + o] = total_of(sums) + bias[o];
        }
}

/* Its gradients from grad (count, outputs): dx (count, n), and, if `trained`, dweight and dbias, overwritten or added to
 * as above. scratch: n floats. */
void NAME(head_backward)(const float *restrict grad, const ELEMENT *restrict x, const float *restrict weight,
                         int64_t count, int64_t n, int64_t outputs, int trained, int add, ELEMENT *restrict dx,
                         float *restrict dweight, float *restrict dbias, float *restrict scratch) {
    FLUSH_TINY
    if (trained && !add) {
        memset(dweight, 0, outputs * n * sizeof(float));
        memset(dbias, 0, outputs * sizeof(float));
    }
    for (int64_t r = 0; r < count; r++, grad += outputs, x += n, dx += n) {
        memset(scratch, 0, n * sizeof(float));
        for (int64_t o = 0; o < outputs; o++) {
            const float g = grad[o];
            for (int64_t j = 0; j < n; j++) scratch[j] += g * weight[o * n + j];
            if (!trained) continue;
            for (int64_t j = 0; j < n; j++) dweight[o * n + j] += g * LOAD(x[j]);
            dbias[o] += g;
        }
        for (int64_t j = 0; j < n; j++) dx[j] = STORE(scratch[j]);
    }
}

#ifdef DENSE

/* Numbers of a packed right factor (inner, n). */
static inline int64_t NAME(packed_size)(int64_t inner, int64_t n) {
    return NAME(depth)(inner) * ((n + BLOCK - 1) / BLOCK * BLOCK);
}

/* z = x times the transpose of weight (n, inner), and then layer_forward with its arguments; x (rows, inner) is also
 * the skip. If inner is odd, a column of zeros follows in a bfloat16 x. */
void NAME(dense_forward)(int64_t inner, const ELEMENT *weight, ELEMENT *z, const float *bias, const float *gamma,
                         const float *beta, const ELEMENT *x, int64_t x_stride, int64_t from, int64_t to, int64_t width,
                         float eps, int64_t rows, int64_t n, ELEMENT *out, float *mean, float *rstd, float *scratch) {
    FLUSH_TINY
    NAME(USE_TILES)
    const int64_t depth = NAME(depth)(inner), size = NAME(packed_size)(inner, n);
    ELEMENT *packed = packing_memory((size + NAME(PANEL) * depth) * sizeof *packed);
    float sums[NAME(PANEL) * BLOCK];
    NAME(pack_transposed)(weight, n, inner, packed);
    for (int64_t i = 0; i < rows; i += NAME(PANEL)) {
        const int64_t count = smaller(NAME(PANEL), rows - i);
        const NAME(Panel) left = NAME(panel_of)(x, x_stride, i, rows, inner, packed + size);
        for (int64_t j = 0; j < n; j += BLOCK) {
            const int64_t columns = smaller(BLOCK, n - j);
            NAME(multiply)(&left, packed + j * depth, depth, columns, sums);
            for (int64_t r = 0; r < count; r++)
                for (int64_t c = 0; c < columns; c++) z[(i + r) * n + j + c] = STORE(sums[r * BLOCK + c]);
        }
        NAME(layer_forward)(z + i * n, bias, gamma, beta, x + i * x_stride, x_stride, from, to, width, eps, count, n,
                            out + i * n, mean + i, rstd + i, scratch);
    }
}

/* Gradient of a layer's input: below (rows, n) = dz (rows, inner) times weight (inner, n; rows `stride` apart),
 * plus columns from `to` of grad (rows, inner) at columns from `from`, which may be negative; an even inner dimension. */
void NAME(dense_backward)(const ELEMENT *dz, int64_t rows, int64_t inner, const ELEMENT *weight, int64_t stride, int64_t n,
                          const ELEMENT *restrict grad, int64_t from, int64_t to, int64_t width, ELEMENT *restrict below) {
    FLUSH_TINY
    NAME(USE_TILES)
    const int64_t depth = NAME(depth)(inner), size = NAME(packed_size)(inner, n);
    ELEMENT *packed = packing_memory((size + NAME(PANEL) * depth) * sizeof *packed);
    float sums[NAME(PANEL) * BLOCK];
    NAME(pack)(weight, inner, n, stride, packed);
    for (int64_t i = 0; i < rows; i += NAME(PANEL)) {
        const NAME(Panel) left = NAME(panel_of)(dz, inner, i, rows, inner, packed + size);
        for (int64_t j = 0; j < n; j += BLOCK) {
            const int64_t first = from > j ? from - j : 0, last = smaller(from + width, j + BLOCK) - j;
            NAME(multiply)(&left, packed + j * depth, depth, n - j, sums);
            for (int64_t r = 0; r < smaller(NAME(PANEL), rows - i); r++) {
                float *restrict s = sums + r * BLOCK;
                const ELEMENT *restrict g = grad + (i + r) * inner + to - from + j;
                for (int64_t c = first; c < last; c++) s[c] += LOAD(g[c]);
                for (int64_t c = 0; c < smaller(BLOCK, n - j); c++) below[(i + r) * n + j + c] = STORE(s[c]);
            }
        }
    }
}

/* Gradient of a weight (m, n), added to what is there if `add`: the transpose of dz (rows, m) times x (rows, n). */
void NAME(weight_gradient)(const ELEMENT *dz, int64_t m, const ELEMENT *x, int64_t n, int64_t x_stride, int64_t rows, int add,
                           float *restrict grad) {
    FLUSH_TINY
    NAME(USE_TILES)
    const int64_t depth = NAME(depth)(rows), dz_size = NAME(packed_size)(rows, m), x_size = NAME(packed_size)(rows, n);
    ELEMENT *packed = packing_memory((dz_size + x_size + NAME(PANEL) * depth) * sizeof *packed);
    ELEMENT *x_packed = packed + dz_size;
    float sums[NAME(PANEL) * BLOCK];
    const ELEMENT *dz_columns = NAME(columns_of)(dz, rows, m, packed);
    NAME(pack)(x, rows, n, x_stride, x_packed);
    for (int64_t i = 0; i < m; i += NAME(PANEL)) {
        const NAME(Panel) left = NAME(panel_of_columns)(dz_columns, i, m, depth, x_packed + x_size);
        for (int64_t j = 0; j < n; j += BLOCK) {
            NAME(multiply)(&left, x_packed + j * depth, depth, n - j, sums);
            for (int64_t r = 0; r < smaller(NAME(PANEL), m - i); r++)
                for (int64_t c = 0; c < smaller(BLOCK, n - j); c++) {
                    float *to = grad + (i + r) * n + j + c;
                    *to = (add ? *to : 0.0f) + sums[r * BLOCK + c];
                }
        }
    }
}

/* A linear head of many outputs, in float32: the same as head_forward. */
void NAME(wide_head_forward)(const ELEMENT *restrict x, const float *weight, const float *restrict bias, int64_t rows,
                             int64_t n, int64_t outputs, float *restrict y) {
    FLUSH_TINY
    const int64_t size = packed_size_fp32(n, outputs);
    float *packed = packing_memory((size + ROWS * n) * sizeof *packed), *some = packed + size, sums[ROWS * BLOCK];
    pack_transposed_fp32(weight, outputs, n, packed);
    for (int64_t i = 0; i < rows; i += ROWS) {
        const int64_t count = smaller(ROWS, rows - i);
        for (int64_t k = 0; k < count * n; k++) some[k] = LOAD(x[i * n + k]);
        const Panel_fp32 left = panel_of_fp32(some, n, 0, count, n, NULL);
        for (int64_t j = 0; j < outputs; j += BLOCK) {
            multiply_fp32(&left, packed + j * n, n, outputs - j, sums);
            for (int64_t r = 0; r < count; r++)
                for (int64_t c = 0; c < smaller(BLOCK, outputs - j); c++)
                    y[(i + r) * outputs + j + c] = sums[r * BLOCK + c] + bias[j + c];
        }
    }
}

/* Its gradients: the same as head_backward. */
void NAME(wide_head_backward)(const float *grad, const ELEMENT *restrict x, const float *restrict weight, int64_t count,
                              int64_t n, int64_t outputs, int trained, int add, ELEMENT *restrict dx,
                              float *restrict dweight, float *restrict dbias) {
    FLUSH_TINY
    float *packed = packing_memory((count < outputs ? outputs : count) * BLOCK * sizeof *packed), sums[ROWS * BLOCK];
    for (int64_t j = 0; j < n; j += BLOCK) {
        const int64_t columns = smaller(BLOCK, n - j);
        pack_fp32(weight + j, outputs, columns, n, packed);
        for (int64_t i = 0; i < count; i += ROWS) {
            const Panel_fp32 left = panel_of_fp32(grad, outputs, i, count, outputs, NULL);
            multiply_fp32(&left, packed, outputs, columns, sums);
            for (int64_t r = 0; r < smaller(ROWS, count - i); r++)
                for (int64_t c = 0; c < columns; c++) dx[(i + r) * n + j + c] = STORE(sums[r * BLOCK + c]);
        }
        if (!trained) continue;
        for (int64_t k = 0; k < count; k++)
            for (int64_t c = 0; c < columns; c++) packed[k * BLOCK + c] = LOAD(x[k * n + j + c]);
        for (int64_t i = 0; i < outputs; i += ROWS) {
            const Panel_fp32 left = panel_of_columns_fp32(grad, i, outputs, count, NULL);
            multiply_fp32(&left, packed, count, columns, sums);
            for (int64_t r = 0; r < smaller(ROWS, outputs - i); r++)
                for (int64_t c = 0; c < columns; c++) {
                    float *to = dweight + (i + r) * n + j + c;
                    *to = (add ? *to : 0.0f) + sums[r * BLOCK + c];
                }
        }
    }
    if (trained && !add) memset(dbias, 0, outputs * sizeof *dbias);
    for (int64_t r = 0; trained && r < count; r++)
        for (int64_t o = 0; o < outputs; o++) dbias[o] += grad[r * outputs + o];
}
#endif

#undef ELEMENT
#undef LOAD
#undef STORE
#undef NAME
#undef DENSE

#endif
