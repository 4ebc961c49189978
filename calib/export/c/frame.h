#ifndef SKIN_FRAME_H
#define SKIN_FRAME_H

#include <math.h>
#include <stdint.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "compile without -ffast-math, -Ofast and -ffinite-math-only: a missing reading is NaN, which they take for impossible"
#endif

/*@SIZES@*/

/* Missing readings of one frame that are left out exactly. The stack of skin_frame() grows with the square.
   0: a frame with a missing reading has no image, and the table skin_predict takes no flash. */
#ifndef SKIN_MAX_MISSING
#define SKIN_MAX_MISSING 16
#endif

/* Least part of the image over a pad that is positive, for the image to give the shape of the force there. */
#ifndef SKIN_GATE
#define SKIN_GATE 0.6f
#endif

#if SKIN_MAX_MISSING < 0
#error "SKIN_MAX_MISSING: give a whole number, zero or more"
#endif

#define SKIN_CHANNELS (SKIN_READINGS + SKIN_PADS)

/* Numbers from which missing readings are predicted; double where the images need more than float keeps. */
typedef /*@EXACT@*/ skin_exact;

/*@TABLES@*/

/* The skin without contact. NaN: this reading or pressure is never used. */
typedef struct {
    float readings[SKIN_READINGS]; /* V */
    float pressures[SKIN_PADS];    /* Pa */
} skin_rest;

/* Means over frames without contact, each over its finite values. */
typedef struct {
    float first[SKIN_CHANNELS];
    float sum[SKIN_CHANNELS]; /* of differences to the first value, which lose fewer digits than the values would */
    uint32_t count[SKIN_CHANNELS];
} skin_tare;

typedef struct {
    float image[SKIN_PIXELS];    /* change of sheet conductivity, S, row by row; NaN: too many readings are missing */
    float map[SKIN_PIXELS];      /* force, N; over a pad it sums to the force of the pad; NaN: the pad tells none */
    float force[SKIN_PADS];      /* N; NaN: the pad tells none */
    uint8_t in_range[SKIN_PADS]; /* 1: the pressure is within the calibrated range */
    uint8_t shaped[SKIN_PADS];   /* 1: the image gives the shape of the map; 0: the force is spread evenly */
    uint32_t missing;            /* readings that were not finite */
/*@PLACE@*/
} skin_result;

static inline void skin_tare_start(skin_tare *tare)
{
    for (uint32_t i = 0; i < SKIN_CHANNELS; i++) {
        tare->first[i] = tare->sum[i] = 0.0f;
        tare->count[i] = 0;
    }
}

/* Add a frame without contact: readings in V, pressures in Pa. */
static inline void skin_tare_add(skin_tare *tare, const float *readings, const float *pressures)
{
    for (uint32_t i = 0; i < SKIN_CHANNELS; i++) {
        const float value = i < SKIN_READINGS ? readings[i] : pressures[i - SKIN_READINGS];
        if (!isfinite(value))
            continue;
        if (tare->count[i] == 0)
            tare->first[i] = value;
        tare->sum[i] += value - tare->first[i];
        tare->count[i]++;
    }
}

/* The means of the frames that were added. */
static inline void skin_tare_rest(const skin_tare *tare, skin_rest *rest)
{
    for (uint32_t i = 0; i < SKIN_CHANNELS; i++) {
        const float mean = tare->count[i] ? tare->first[i] + tare->sum[i] / (float)tare->count[i] : NAN;
        if (i < SKIN_READINGS)
            rest->readings[i] = mean;
        else
            rest->pressures[i - SKIN_READINGS] = mean;
    }
}

#if SKIN_MAX_MISSING > 0
/* Element of the symmetric matrix that predicts pair sums; its lower triangle is kept, row by row. */
static inline double skin_predicted(uint32_t i, uint32_t j)
{
    return (double)(i >= j ? skin_predict[i * (i + 1) / 2 + j] : skin_predict[j * (j + 1) / 2 + i]);
}

/* Complete the weighted sums t of a frame by what the image of its other readings predicts for the missing ones:
   (1/w - B T B^T) q = B T t, then t += B^T q. Returns 0 if the other readings do not determine it. */
static inline int skin_complete(const uint16_t *missing, uint32_t count, skin_exact *sums)
{
    static const double sign[4] = {1.0, -1.0, -1.0, 1.0};
    double lower[SKIN_MAX_MISSING * (SKIN_MAX_MISSING + 1) / 2], value[SKIN_MAX_MISSING];
    for (uint32_t a = 0; a < count; a++) {
        const uint16_t *of_a = skin_pairs[missing[a]];
        double *row = lower + a * (a + 1) / 2;
        value[a] = 0.0;
        for (uint32_t s = 0; s < 4; s++) {
            double along = 0.0;
            for (uint32_t j = 0; j < SKIN_PAIRS; j++)
                along += skin_predicted(of_a[s], j) * (double)sums[j];
            value[a] += sign[s] * along;
        }
        for (uint32_t b = 0; b <= a; b++) {
            const uint16_t *of_b = skin_pairs[missing[b]];
            row[b] = a == b ? 1.0 / (double)skin_weight[missing[a]] : 0.0;
            for (uint32_t s = 0; s < 4; s++)
                for (uint32_t u = 0; u < 4; u++)
                    row[b] -= sign[s] * sign[u] * skin_predicted(of_a[s], of_b[u]);
        }
        /* L D L^T, with D on the diagonal */
        for (uint32_t b = 0; b < a; b++) {
            const double *above = lower + b * (b + 1) / 2;
            for (uint32_t j = 0; j < b; j++)
                row[b] -= row[j] * above[j];
        }
        for (uint32_t b = 0; b < a; b++) {
            const double scaled = row[b] / lower[b * (b + 1) / 2 + b];
            row[a] -= row[b] * scaled;
            row[b] = scaled;
            value[a] -= scaled * value[b];
        }
        if (!(row[a] * (double)skin_weight[missing[a]] > 1e-9))
            return 0;
    }
    for (uint32_t a = count; a-- > 0;) {
        value[a] /= lower[a * (a + 1) / 2 + a];
        for (uint32_t b = a + 1; b < count; b++)
            value[a] -= lower[b * (b + 1) / 2 + a] * value[b];
        for (uint32_t s = 0; s < 4; s++)
            sums[skin_pairs[missing[a]][s]] += (skin_exact)(sign[s] * value[a]);
    }
    return 1;
}
#endif

/* Product of two vectors, one number for each pair sum. Eight sums side by side wait for each other an eighth of the time. */
static inline float skin_dot(const float *a, const float *b)
{
    float part[8] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
    uint32_t j = 0;
    for (; j + 8 <= SKIN_PAIRS; j += 8)
        for (uint32_t i = 0; i < 8; i++)
            part[i] += a[j + i] * b[j + i];
    for (; j < SKIN_PAIRS; j++)
        part[0] += a[j] * b[j];
    return ((part[0] + part[4]) + (part[1] + part[5])) + ((part[2] + part[6]) + (part[3] + part[7]));
}

/* The image of a frame. Returns 0, or 1 if it has too many missing readings: the image is then NaN. */
static inline int skin_imaged(const skin_rest *rest, const float *readings, skin_result *out)
{
    skin_exact sums[SKIN_PAIRS];
    float single[SKIN_PAIRS];
#if SKIN_MAX_MISSING > 0
    uint16_t missing[SKIN_MAX_MISSING] = {0};
#endif
    int known;
    for (uint32_t j = 0; j < SKIN_PAIRS; j++)
        sums[j] = 0;
    out->missing = 0;
    for (uint32_t i = 0; i < SKIN_READINGS; i++) {
        const float change = readings[i] - rest->readings[i];
        if (skin_weight[i] == 0)
            continue; /* a channel that the calibration does not use */
        if (isfinite(change)) {
            const skin_exact weighed = skin_weight[i] * change;
            sums[skin_pairs[i][0]] += weighed;
            sums[skin_pairs[i][1]] -= weighed;
            sums[skin_pairs[i][2]] -= weighed;
            sums[skin_pairs[i][3]] += weighed;
        } else {
#if SKIN_MAX_MISSING > 0
            if (out->missing < SKIN_MAX_MISSING)
                missing[out->missing] = (uint16_t)i;
#endif
            out->missing++;
        }
    }
#if SKIN_MAX_MISSING > 0
    known = out->missing == 0 || (out->missing <= SKIN_MAX_MISSING && skin_complete(missing, out->missing, sums));
#else
    known = out->missing == 0;
#endif
    for (uint32_t j = 0; j < SKIN_PAIRS; j++)
        single[j] = (float)sums[j];
    for (uint32_t p = 0; p < SKIN_PIXELS; p++)
        out->image[p] = known ? skin_dot(skin_factor[p], single) : NAN;
    return !known;
}

/*@LOCATION@*/
/* Force of a pad, N, at its own pressure, Pa; see CURVE above. */
static inline float skin_curve(uint32_t pad, float pressure)
{
    const float *a = skin_curves[pad];
/*@CURVE@*/
}

/* Forces of the pads from their pressures. */
static inline void skin_pad_forces(const skin_rest *rest, const float *pressures, skin_result *out)
{
    float change[SKIN_PADS];
    for (uint32_t i = 0; i < SKIN_PADS; i++)
        change[i] = pressures[i] - rest->pressures[i];
    for (uint32_t i = 0; i < SKIN_PADS; i++) {
        float own = 0.0f;
        out->force[i] = NAN;
        out->in_range[i] = 0;
        if (!isfinite(change[i]))
            continue;
        for (uint32_t j = 0; j < SKIN_PADS; j++)
            if (isfinite(change[j]))
                own += skin_unmix[i][j] * change[j];
        out->force[i] = skin_curve(i, own)/*@GAIN@*/;
        out->in_range[i] = own >= skin_range[i][0] && own <= skin_range[i][1];
    }
}

/* Distribute the force of each pad over the positive part of the image on the pad, or evenly. */
static inline void skin_fuse(skin_result *out)
{
    for (uint32_t p = 0; p < SKIN_PIXELS; p++)
        out->map[p] = 0.0f;
    for (uint32_t i = 0; i < SKIN_PADS; i++) {
        const uint32_t begin = skin_mask_start[i], end = skin_mask_start[i + 1];
        float positive = 0.0f, negative = 0.0f, even = 0.0f, scale;
        for (uint32_t e = begin; e < end; e++) {
            const float mass = skin_mask_area[e] * out->image[skin_mask_pixel[e]];
            if (mass > 0.0f)
                positive += mass;
            else
                negative -= mass; /* NaN, where the image is not known */
            even += skin_mask_area[e];
        }
        out->shaped[i] = out->force[i] > 0.0f && isfinite(out->force[i]) && positive > 0.0f &&
                         positive >= SKIN_GATE * (positive + negative);
        scale = out->force[i] / (out->shaped[i] ? positive : even);
        if (!isfinite(out->force[i]))
            scale = NAN;
        for (uint32_t e = begin; e < end; e++) {
            const uint32_t p = skin_mask_pixel[e];
            if (!out->shaped[i])
                out->map[p] += scale * skin_mask_area[e];
            else if (out->image[p] > 0.0f)
                out->map[p] += scale * skin_mask_area[e] * out->image[p];
        }
    }
}

/* Image, pad forces and force map of one frame: readings (V) and pad pressures (Pa) as the devices give them, without
   the mean of the rest subtracted. Returns 0, or 1 if too many readings are missing: the image is then NaN and the
   force of each pad is spread evenly. */
static inline int skin_frame(const skin_rest *rest, const float *readings, const float *pressures, skin_result *out)
{
    const int unknown = skin_imaged(rest, readings, out);
/*@LOCATE@*/
    skin_pad_forces(rest, pressures, out);
    skin_fuse(out);
    return unknown;
}

#endif
