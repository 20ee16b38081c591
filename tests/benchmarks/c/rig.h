/* The simulated rig as rtloop.hil computes it, operation by operation, and its driver's two functions. A Bouc-Wen
 * actuator and loopback channels end the program: no benchmark has them. */
#pragma once
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include "layout.h"

typedef const struct rig_coefficients *restrict rig_c;
typedef struct rig_state *restrict rig_s;

static inline double convert(double lsb_v, double lowest_v, double highest_v, double value_v) {
    if (lsb_v > 0) value_v = rint(value_v / lsb_v) * lsb_v;
    return value_v < lowest_v ? lowest_v : value_v > highest_v ? highest_v : value_v;
}

static inline double noise(uint64_t *word) {
    uint64_t w = *word, lanes = 0;
    for (int i = 0; i < 3; i++) {
        w ^= w << 13;
        w ^= w >> 7;
        w ^= w << 17;
        lanes += (w & 0x0000FFFF0000FFFFull) + ((w >> 16) & 0x0000FFFF0000FFFFull);
    }
    *word = w;
    return ((double)((lanes & 0xFFFFFFFFull) + (lanes >> 32)) - 393210.0) / sqrt(4294967295.0);
}

enum { SENSOR_STUCK = 1, SENSOR_LOST, DRIVE_LOST };

static inline double changed_reading(rig_c c, rig_s s, double reading_v) {
    if (s->fault_wait > 0) return s->fault_reading_v = reading_v;
    return c->fault_kind == SENSOR_STUCK ? s->fault_reading_v : c->fault_kind == SENSOR_LOST ? 0 : reading_v;
}

static inline double changed_drive(rig_c c, rig_s s, double drive_v) {
    if (s->fault_wait > 0) {
        s->fault_wait--;
        return drive_v;
    }
    return c->fault_kind == DRIVE_LOST ? 0 : drive_v;
}

static inline double rig_sample(rig_c c, rig_s s) {
    double true_sums[4] = {0}, sensed_sums[4] = {0};
    for (unsigned i = 0; i < c->mode_count; i += 4)
        for (unsigned lane = 0; lane < 4; lane++) {
            double real = s->modes_real[i + lane], imag = s->modes_imag[i + lane];
            true_sums[lane] += c->true_real[i + lane] * real + c->true_imag[i + lane] * imag;
            sensed_sums[lane] += c->sensed_real[i + lane] * real + c->sensed_imag[i + lane] * imag;
        }
    double true_um = c->true_direct * s->input_um + ((true_sums[0] + true_sums[1]) + (true_sums[2] + true_sums[3]));
    double sensed_um =
        c->sensed_direct * s->input_um + ((sensed_sums[0] + sensed_sums[1]) + (sensed_sums[2] + sensed_sums[3]));
    s->true_position_um = true_um;
    double reading_um = sensed_um + c->sensor_offset_um;
    if (c->sensor_noise_um > 0) reading_um += c->sensor_noise_um * noise(&s->noise_word);
    if (c->sensor_resolution_um > 0)
        reading_um = rint(reading_um / c->sensor_resolution_um) * c->sensor_resolution_um;
    return changed_reading(
        c, s, convert(c->adc_lsb_v, c->adc_lowest_v, c->adc_highest_v, reading_um / c->sensor_um_per_v)
    );
}

static inline double rig_drive(rig_c c, rig_s s, double value_v) {
    if (!isnan(value_v)) s->dac_v = convert(c->dac_lsb_v, c->dac_lowest_v, c->dac_highest_v, value_v);
    if (c->latency_ticks == 0) return s->dac_v;
    int64_t head = s->queue_head;
    double arrived_v = s->queue_v[head];
    s->queue_v[head] = s->dac_v;
    s->queue_head = head + 1 < c->latency_ticks ? head + 1 : 0;
    return arrived_v;
}

static inline double rig_play(double drive_v, double threshold_v, double held_v) {
    double low_v = drive_v - threshold_v, high_v = drive_v + threshold_v;
    double lowered_v = high_v < held_v ? high_v : held_v;
    return low_v > lowered_v ? low_v : lowered_v;
}

static inline double rig_disturbance(rig_c c, rig_s s) {
    if (s->disturbance_wait > 0) {
        s->disturbance_wait--;
        return s->disturbance_um;
    }
    double sine_um = s->sine_um, cosine_um = s->cosine_um;
    s->sine_um = c->disturbance_cos * sine_um + c->disturbance_sin * cosine_um;
    s->cosine_um = c->disturbance_cos * cosine_um - c->disturbance_sin * sine_um;
    return s->disturbance_um + c->disturbance_step_um + sine_um;
}

/* The displacement for a drive, with creep; the caller adds the disturbance and the other axes' displacement. */
static inline void rig_displace(rig_c c, rig_s s, double dac_v) {
    double actuator_v = changed_drive(c, s, rig_drive(c, s, dac_v)), sums_um[4] = {0};
    if (c->bw_um_per_v != 0) abort();
    for (unsigned i = 0; i < c->play_count; i += 4)
        for (unsigned lane = 0; lane < 4; lane++) {
            double play_v = rig_play(actuator_v, c->thresholds_v[i + lane], s->plays_v[i + lane]);
            s->plays_v[i + lane] = play_v;
            sums_um[lane] += c->weights_um_per_v[i + lane] * play_v;
        }
    double displacement_um = (sums_um[0] + sums_um[1]) + (sums_um[2] + sums_um[3]), crept_um = displacement_um;
    for (int64_t i = 0; i < c->lag_count; i++) {
        double lag_um = s->lags_um[i];
        crept_um += c->lag_gains[i] * lag_um;
        s->lags_um[i] = lag_um + c->lag_shares[i] * (displacement_um - lag_um);
    }
    s->hysteresis_um = crept_um;
}

static inline void rig_move(rig_c c, rig_s s, double input_um) {
    s->input_um = input_um;
    for (unsigned i = 0; i < c->mode_count; i += 4)
        for (unsigned lane = 0; lane < 4; lane++) {
            double real = s->modes_real[i + lane], imag = s->modes_imag[i + lane];
            s->modes_real[i + lane] = c->mode_real[i + lane] * real - c->mode_imag[i + lane] * imag + input_um;
            s->modes_imag[i + lane] = c->mode_imag[i + lane] * real + c->mode_real[i + lane] * imag;
        }
}

int32_t rig_read(void *context, double *values) {
    const struct sim *rig = context;
    const struct rig_coefficients *c = (const void *)(intptr_t)rig->coefficients;
    struct rig_state *s = (void *)(intptr_t)rig->state;
    if (rig->looped) abort();
    values[rig->count] = 0;
    for (unsigned i = 0; i < rig->count; i++) {
        values[i] = rig_sample(&c[i], &s[i]);
        double *observed = values + rig->count + 1 + 2 * i;
        observed[0] = s[i].true_position_um;
        observed[1] = s[i].hysteresis_um;
    }
    return 0;
}

int32_t rig_write(void *context, double *values) {
    const struct sim *rig = context;
    const struct rig_coefficients *c = (const void *)(intptr_t)rig->coefficients;
    struct rig_state *s = (void *)(intptr_t)rig->state;
    for (unsigned i = 0; i < rig->count; i++) rig_displace(&c[i], &s[i], values[i]);
    for (unsigned i = 0; i < rig->count; i++) {
        double input_um = s[i].hysteresis_um;
        for (int64_t j = 0; j < c[i].coupled_count; j++) input_um += c[i].coupling[j] * s[j].hysteresis_um;
        rig_move(&c[i], &s[i], input_um + rig_disturbance(&c[i], &s[i]));
    }
    return 0;
}
