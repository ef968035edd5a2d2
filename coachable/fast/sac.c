/* Gradients of SAC and QR-SAC for some rows of a batch, from the networks' inputs to the parameters' gradients, see
 * direct.py. The file includes itself for each type of matrix products that kernels.c has. */

#ifndef ELEMENT

#include "kernels.c"

#ifdef PRODUCTS

#define MOST 8 /* layers of a network, or inputs */
#define FEW 4  /* outputs of a head; beyond, products of matrices are faster */

typedef struct {
    int64_t inner, outer;    /* widths of input and output */
    int64_t from, to, width; /* columns of the skip, see layer_forward */
    double eps;
    const void *weight; /* in the type of the products */
    const float *bias, *gamma, *beta;
    float *dweight, *dbias, *dgamma, *dbeta; /* null in a network that is not trained */
} Layer;

typedef struct {
    int64_t layers, outputs;
    const float *weight, *bias; /* of the head */
    float *dweight, *dbias;
    Layer layer[MOST];
} Network;

typedef struct {
    int64_t count, width[MOST];
    const float *part[MOST]; /* (rows, width) each */
} Inputs;

typedef struct {
    int64_t batch, axes, critics, outputs; /* rows of the batch, of which this may be a part; outputs of a critic */
    double alpha, low, high, kappa;        /* entropy weight, bounds of log scale, Huber threshold or 0 for squares */
    Inputs policy, critic, next_policy, next_critic; /* the critics' without the action */
    const float *taken, *noise, *next_noise, *reward, *discount;
    float *loss, *td_error, *log_prob, *value; /* results for each row */
    const Network *actor, *own, *target;       /* own and target: one network for each critic */
} Job;

/* Memory of a thread for one call: blocks that are taken one after the other and given back all at once. */
#define BLOCKS 40
static _Thread_local struct {
    char *block[BLOCKS];
    int64_t size[BLOCKS], used[BLOCKS];
    int now;
} memory;

static void *take(int64_t bytes) {
    bytes = (bytes + 63) / 64 * 64;
    while (memory.block[memory.now] && memory.used[memory.now] + bytes > memory.size[memory.now]) memory.now++;
    const int i = memory.now;
    if (!memory.block[i]) {
        const int64_t least = i ? 2 * memory.size[i - 1] : 1 << 21; /* so that there are few blocks */
        memory.size[i] = bytes > least ? bytes : least;
        memory.block[i] = aligned_alloc(64, memory.size[i]);
        memory.used[i] = 0;
    }
    memory.used[i] += bytes;
    return memory.block[i] + memory.used[i] - bytes;
}

static float *floats(int64_t count) { return take(count * sizeof(float)); }

typedef struct {
    int now;
    int64_t used;
} Mark;

static Mark mark(void) { return (Mark){memory.now, memory.block[memory.now] ? memory.used[memory.now] : 0}; }

static void give_back(Mark m) {
    for (int i = m.now + 1; i <= memory.now; i++) memory.used[i] = 0;
    memory.now = m.now;
    memory.used[m.now] = m.used;
}

/* Exponential and logarithm to 2e-7, in a form that compilers vectorise; a NaN stays one. */
static inline float exp_of(float x) {
    x = x < -87.0f ? -87.0f : x > 88.0f ? 88.0f : x;
    const float n = x != x ? 0.0f : __builtin_rintf(x * 1.44269504f);
    const float r = __builtin_fmaf(n, -1.42860677e-6f, __builtin_fmaf(n, -0.693145752f, x));
    float p = 1.0f / 720.0f;
    p = __builtin_fmaf(p, r, 1.0f / 120.0f);
    p = __builtin_fmaf(p, r, 1.0f / 24.0f);
    p = __builtin_fmaf(p, r, 1.0f / 6.0f);
    p = __builtin_fmaf(p, r, 0.5f);
    p = __builtin_fmaf(p, r, 1.0f);
    p = __builtin_fmaf(p, r, 1.0f);
    const int32_t bits = (int32_t)(n + 127.0f) * (1 << 23);
    float power;
    memcpy(&power, &bits, sizeof power);
    return p * power;
}

/* log(1 + e) for e in [0, 1]. */
static inline float log1p_of(float e) {
    const float upper = e > 0.41421356f ? 1.0f : 0.0f; /* then log 2 + log((1 + e) / 2) */
    const float f = upper != 0.0f ? 0.5f * (e - 1.0f) : e, s = f / (2.0f + f), t = s * s;
    float p = 1.0f / 11.0f;
    p = __builtin_fmaf(p, t, 1.0f / 9.0f);
    p = __builtin_fmaf(p, t, 1.0f / 7.0f);
    p = __builtin_fmaf(p, t, 0.2f);
    p = __builtin_fmaf(p, t, 1.0f / 3.0f);
    p = __builtin_fmaf(p, t, 1.0f);
    return __builtin_fmaf(2.0f * s, p, upper * 0.693147181f);
}

static inline float tanh_of(float x) { return 1.0f - 2.0f / (exp_of(2.0f * x) + 1.0f); }

static int64_t widest(const Network *net) {
    int64_t n = net->layer[0].inner;
    for (int64_t i = 0; i < net->layers; i++) n = net->layer[i].outer > n ? net->layer[i].outer : n;
    return n;
}

/* Actions tanh(loc + scale * noise) and their log-densities from the policy's output y (rows, 2 axes). If they are
 * wanted, `scale` and `slope` get the scale and its derivative by the output. */
static float *sample(const Job *job, const float *y, const float *noise, int64_t rows, float *log_prob, float *scale,
                     float *slope) {
    const int64_t axes = job->axes;
    const float half = (float)(0.5 * (job->high - job->low)), middle = (float)(0.5 * (job->high + job->low));
    const float constant = (float)axes * 2.30523288f; /* log(2 pi) / 2 + 2 log 2 */
    float *action = floats(rows * axes);
    for (int64_t r = 0; r < rows; r++) {
        const float *loc = y + r * 2 * axes, *raw = loc + axes, *z = noise + r * axes;
        float total = 0.0f;
        for (int64_t j = 0; j < axes; j++) {
            const float squashed = tanh_of(raw[j]), log_scale = squashed * half + middle, s = exp_of(log_scale);
            const float u = loc[j] + s * z[j], size = u < 0.0f ? -u : u, e = exp_of(-2.0f * size);
            const float tanh_size = (1.0f - e) / (1.0f + e);
            action[r * axes + j] = u < 0.0f ? -tanh_size : tanh_size;
            total += 2.0f * (size + log1p_of(e)) - log_scale - 0.5f * z[j] * z[j];
            if (scale) {
                scale[r * axes + j] = s;
                slope[r * axes + j] = s * half * (1.0f - squashed * squashed);
            }
        }
        log_prob[r] = total - constant;
    }
    return action;
}

/* The mean of a critic's outputs for a row. */
static inline float value_of(const float *q, int64_t outputs) {
    float total = 0.0f;
    for (int64_t j = 0; j < outputs; j++) total += q[j];
    return total / (float)outputs;
}

/* Loss of a row's outputs q against the target y, both of n numbers, and its gradient times `share`. */
static float squared_loss(const float *q, const float *y, int64_t n, float share, float *dq) {
    float total = 0.0f;
    for (int64_t i = 0; i < n; i++) {
        total += (q[i] - y[i]) * (q[i] - y[i]);
        dq[i] = 2.0f * share * (q[i] - y[i]);
    }
    return total;
}

static float quantile_loss(const float *q, const float *y, int64_t n, float kappa, float share, float *dq) {
    const float scale = 1.0f / ((float)(n * n) * kappa);
    float total = 0.0f;
    for (int64_t i = 0; i < n; i++) {
        const float above = ((float)i + 0.5f) / (float)n;
        float loss = 0.0f, slope = 0.0f;
        for (int64_t j = 0; j < n; j++) {
            const float u = y[j] - q[i], c = u < -kappa ? -kappa : u > kappa ? kappa : u;
            const float weight = u < 0.0f ? 1.0f - above : above;
            loss += weight * c * (u - 0.5f * c);
            slope += weight * c;
        }
        total += loss;
        dq[i] = -scale * share * slope;
    }
    return total * scale;
}

#define ELEMENT float
#define LOAD(x) (x)
#define STORE(x) (x)
#define NAME(x) x##_fp32
#include "sac.c"

#ifdef __AVX512BF16__
#define ELEMENT uint16_t
#define LOAD(x) widen(x)
#define STORE(x) narrow(x)
#define NAME(x) x##_bf16
#include "sac.c"
#endif
#endif

#else

/* Rows of a network's input, with a column of zeros if their number is odd; `last` (rows, axes) follows. */
static const ELEMENT *NAME(assemble)(const Inputs *inputs, int64_t start, int64_t rows, const float *last, int64_t axes,
                                     int64_t *stride) {
    int64_t width = last ? axes : 0;
    for (int64_t i = 0; i < inputs->count; i++) width += inputs->width[i];
    *stride = width + width % 2;
    ELEMENT *x = take(rows * *stride * sizeof *x);
    for (int64_t r = 0; r < rows; r++) {
        ELEMENT *to = x + r * *stride;
        to[*stride - 1] = 0;
        for (int64_t i = 0; i < inputs->count; i++) {
            const float *from = inputs->part[i] + (start + r) * inputs->width[i];
            for (int64_t j = 0; j < inputs->width[i]; j++) *to++ = STORE(from[j]);
        }
        if (last)
            for (int64_t j = 0; j < axes; j++) *to++ = STORE(last[r * axes + j]);
    }
    return x;
}

/* What a backward pass needs of a forward pass. */
typedef struct {
    const ELEMENT *x;
    int64_t stride;
    ELEMENT *z[MOST], *out[MOST];
    float *mean[MOST], *rstd[MOST];
} NAME(Tape);

static float *NAME(network_forward)(const Network *net, const ELEMENT *x, int64_t stride, int64_t rows, NAME(Tape) *tape) {
    float *scratch = floats(2 * widest(net)), *y = floats(rows * net->outputs);
    tape->x = x;
    tape->stride = stride;
    int64_t n = 0;
    for (int64_t i = 0; i < net->layers; i++) {
        const Layer *layer = net->layer + i;
        n = layer->outer;
        tape->z[i] = take(rows * n * sizeof **tape->z);
        tape->out[i] = take(rows * n * sizeof **tape->out);
        tape->mean[i] = floats(rows);
        tape->rstd[i] = floats(rows);
        NAME(dense_forward)(layer->inner, layer->weight, tape->z[i], layer->bias, layer->gamma, layer->beta, x, stride,
                            layer->from, layer->to, layer->width, (float)layer->eps, rows, n, tape->out[i], tape->mean[i],
                            tape->rstd[i], scratch);
        x = tape->out[i];
        stride = n;
    }
    if (net->outputs <= FEW)
        NAME(head_forward)(x, net->weight, net->bias, rows, n, net->outputs, y);
    else
        NAME(wide_head_forward)(x, net->weight, net->bias, rows, n, net->outputs, y);
    return y;
}

/* Backward pass from dy (count, outputs): the parameters' gradients if `trained`; else the gradient of `columns` inputs
 * from `first`, for the rows of `index`, written to those rows of dx (rows, columns). */
static void NAME(network_backward)(const Network *net, const NAME(Tape) *tape, const float *dy, int64_t count, int trained,
                                   const int64_t *index, float *dx, int64_t first, int64_t columns) {
    const int64_t size = count * widest(net);
    float *scratch = floats(2 * widest(net));
    ELEMENT *here = take(size * sizeof *here), *below = take(size * sizeof *below), *dz = take(size * sizeof *dz);
    const int64_t top = net->layers - 1;
    const ELEMENT *x = tape->out[top];
    if (net->outputs <= FEW)
        NAME(head_backward)(dy, x, net->weight, count, net->layer[top].outer, net->outputs, trained, 0, here,
                            net->dweight, net->dbias, scratch);
    else
        NAME(wide_head_backward)(dy, x, net->weight, count, net->layer[top].outer, net->outputs, trained, 0, here,
                                 net->dweight, net->dbias);
    for (int64_t i = top; i >= 0; i--) {
        const Layer *layer = net->layer + i;
        const int64_t n = layer->inner, m = layer->outer;
        NAME(layer_backward)(here, tape->z[i], layer->bias, layer->gamma, layer->beta, tape->mean[i], tape->rstd[i], index,
                             count, trained, 0, m, dz, layer->dgamma, layer->dbeta, layer->dbias, scratch);
        if (trained)
            NAME(weight_gradient)(dz, m, i ? tape->out[i - 1] : tape->x, n, i ? n : tape->stride, count, 0, layer->dweight);
        if (i) {
            NAME(dense_backward)(dz, count, m, layer->weight, n, n, here, layer->from, layer->to, layer->width, below);
            ELEMENT *free = here;
            here = below;
            below = free;
        } else if (dx) {
            NAME(dense_backward)(dz, count, m, (const ELEMENT *)layer->weight + first, n, columns, here, layer->from - first, layer->to,
                                 layer->width, below);
            for (int64_t r = 0; r < count; r++)
                for (int64_t j = 0; j < columns; j++) dx[index[r] * columns + j] = LOAD(below[r * columns + j]);
        }
    }
}

static void NAME(critic_gradients)(const Job *job, int64_t start, int64_t rows) {
    const int64_t axes = job->axes, n = job->outputs;
    NAME(Tape) tape;
    int64_t stride;
    float *y = floats(rows * n), *best = floats(rows), *log_prob = floats(rows), *dq = floats(rows * n);
    Mark before = mark();
    const ELEMENT *x = NAME(assemble)(&job->next_policy, start, rows, NULL, 0, &stride);
    const float *output = NAME(network_forward)(job->actor, x, stride, rows, &tape);
    const float *action = sample(job, output, job->next_noise + start * axes, rows, log_prob, NULL, NULL);
    x = NAME(assemble)(&job->next_critic, start, rows, action, axes, &stride);
    for (int64_t k = 0; k < job->critics; k++) {
        Mark inner = mark();
        const float *q = NAME(network_forward)(job->target + k, x, stride, rows, &tape);
        for (int64_t r = 0; r < rows; r++) {
            const float value = value_of(q + r * n, n);
            if (k && !(value < best[r] || value != value)) continue;
            best[r] = value;
            memcpy(y + r * n, q + r * n, n * sizeof *y);
        }
        give_back(inner);
    }
    give_back(before);
    for (int64_t r = 0; r < rows; r++) {
        const float entropy = (float)job->alpha * log_prob[r], discount = job->discount[start + r];
        for (int64_t j = 0; j < n; j++) /* a terminal state's value may be infinite */
            y[r * n + j] = job->reward[start + r] + (discount != 0.0f ? discount * (y[r * n + j] - entropy) : 0.0f);
        job->loss[start + r] = job->td_error[start + r] = 0.0f;
    }
    x = NAME(assemble)(&job->critic, start, rows, job->taken + start * axes, axes, &stride);
    for (int64_t k = 0; k < job->critics; k++) {
        Mark inner = mark();
        const float *q = NAME(network_forward)(job->own + k, x, stride, rows, &tape), share = 1.0f / (float)job->batch;
        for (int64_t r = 0; r < rows; r++) {
            const float *here = q + r * n, *wanted = y + r * n;
            const float error = value_of(here, n) - value_of(wanted, n), size = error < 0.0f ? -error : error;
            job->loss[start + r] += job->kappa > 0.0
                                        ? quantile_loss(here, wanted, n, (float)job->kappa, share, dq + r * n)
                                        : squared_loss(here, wanted, n, share, dq + r * n);
            if (size > job->td_error[start + r]) job->td_error[start + r] = size;
        }
        NAME(network_backward)(job->own + k, &tape, dq, rows, 1, NULL, NULL, 0, 0);
        give_back(inner);
    }
}

static void NAME(policy_gradients)(const Job *job, int64_t start, int64_t rows) {
    const int64_t axes = job->axes, n = job->outputs;
    const float share = 1.0f / (float)job->batch, entropy = (float)job->alpha * share;
    const float *noise = job->noise + start * axes;
    NAME(Tape) tape, *tapes = take(job->critics * sizeof *tapes);
    int64_t stride, critic_stride, *index = take(rows * sizeof *index), *lowest = take(rows * sizeof *lowest);
    float *scale = floats(rows * axes), *slope = floats(rows * axes), *value = job->value + start;
    const ELEMENT *x = NAME(assemble)(&job->policy, start, rows, NULL, 0, &stride);
    const float *output = NAME(network_forward)(job->actor, x, stride, rows, &tape);
    const float *action = sample(job, output, noise, rows, job->log_prob + start, scale, slope);
    x = NAME(assemble)(&job->critic, start, rows, action, axes, &critic_stride);
    for (int64_t k = 0; k < job->critics; k++) {
        const float *q = NAME(network_forward)(job->own + k, x, critic_stride, rows, tapes + k);
        for (int64_t r = 0; r < rows; r++) {
            const float mean = value_of(q + r * n, n);
            if (k && !(mean < value[r] || mean != mean)) continue;
            value[r] = mean;
            lowest[r] = k;
        }
    }
    float *by_action = floats(rows * axes), *dq = floats(rows * n), *dy = floats(rows * 2 * axes);
    const int64_t first = job->own->layer[0].inner - axes;
    for (int64_t i = 0; i < rows * n; i++) dq[i] = -share / (float)n;
    for (int64_t k = 0; k < job->critics; k++) {
        int64_t count = 0;
        Mark inner = mark();
        for (int64_t r = 0; r < rows; r++)
            if (lowest[r] == k) index[count++] = r;
        if (count) NAME(network_backward)(job->own + k, tapes + k, dq, count, 0, index, by_action, first, axes);
        give_back(inner);
    }
    for (int64_t r = 0; r < rows; r++)
        for (int64_t j = 0; j < axes; j++) {
            const int64_t i = r * axes + j;
            /* The log-density's derivative is 2 tanh(u) by u, and -1 / scale besides. */
            const float a = action[i], by_loc = by_action[i] * (1.0f - a * a) + 2.0f * entropy * a;
            dy[r * 2 * axes + j] = by_loc;
            dy[r * 2 * axes + axes + j] = (by_loc * noise[i] - entropy / scale[i]) * slope[i];
        }
    NAME(network_backward)(job->actor, &tape, dy, rows, 1, NULL, NULL, 0, 0);
}

/* Set the gradients of the critics, the policy or both for rows from `start`, and the results for these rows. */
void NAME(sac_gradients)(const Job *job, int64_t start, int64_t rows, int critics, int policy) {
    FLUSH_TINY
    const Mark before = mark();
    if (critics) NAME(critic_gradients)(job, start, rows);
    if (policy) NAME(policy_gradients)(job, start, rows);
    give_back(before);
}

#undef ELEMENT
#undef LOAD
#undef STORE
#undef NAME

#endif
