/* The two laws of the paper behind the pointers of a slot: plays and inverse, linear controller; operation by operation
 * as rtloop.laws.shipped computes them. A status of 0 means that the law returned, as every law here does. */
#pragma once
#include <stdbool.h>
#include "layout.h"

enum { LANES = 4, BLOCK = 8 };
#define LAW_ARGUMENTS(record) double *restrict result, void **raised, const struct record##_coefficients *restrict c, struct record##_state *restrict s

static inline double sum_of_lanes(const double *lanes) { return (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]); }

static inline double play(double value, double threshold, double last) {
    double low = value - threshold, high = value + threshold, raised = low > last ? low : last;
    return high < raised ? high : raised;
}

int32_t plays_output(LAW_ARGUMENTS(plays), double command_um) {
    (void)raised;
    double lanes[LANES] = {0};
    for (unsigned i = 0; i < c->play_count; i += LANES)
        for (unsigned lane = 0; lane < LANES; lane++)
            lanes[lane] += c->inverse_weights_v_per_um[i + lane]
                * play(command_um, c->inverse_thresholds_um[i + lane], s->inverse_plays_um[i + lane]);
    double drive_v = sum_of_lanes(lanes);
    if (c->dead_band_v > 0) {
        double centre_v = s->model_plays_v[0];
        if (drive_v > centre_v + c->dead_band_threshold_v) s->dead_band_direction = 1;
        else if (drive_v < centre_v - c->dead_band_threshold_v) s->dead_band_direction = -1;
        drive_v += s->dead_band_direction * c->dead_band_v;
    }
    *result = drive_v;
    return 0;
}

int32_t plays_update(LAW_ARGUMENTS(plays), double drive_v) {
    (void)raised;
    double lanes[LANES] = {0};
    for (unsigned i = 0; i < c->play_count; i += LANES)
        for (unsigned lane = 0; lane < LANES; lane++) {
            double moved_v = play(drive_v, c->model_thresholds_v[i + lane], s->model_plays_v[i + lane]);
            s->model_plays_v[i + lane] = moved_v;
            lanes[lane] += c->model_weights_um_per_v[i + lane] * moved_v;
        }
    double applied_um = sum_of_lanes(lanes);
    for (unsigned i = 0; i < c->play_count; i += LANES)
        for (unsigned lane = 0; lane < LANES; lane++)
            s->inverse_plays_um[i + lane] =
                play(applied_um, c->inverse_thresholds_um[i + lane], s->inverse_plays_um[i + lane]);
    *result = applied_um;
    return 0;
}

int32_t plays_enter(LAW_ARGUMENTS(plays), double drive_v) {
    (void)raised, (void)result;
    if (c->dead_band_v > 0) s->dead_band_direction = (drive_v - s->model_plays_v[0]) / c->dead_band_v;
    return 0;
}

static inline double linear_command(const struct linear_coefficients *c, const struct linear_state *s, double error_um) {
    double lanes[LANES] = {0};
    for (unsigned i = 0; i < c->order; i += BLOCK)
        for (unsigned lane = 0; lane < LANES; lane++)
            lanes[lane] += c->c[i + lane] * s->controller[i + lane]
                + c->c[i + lane + LANES] * s->controller[i + lane + LANES];
    return sum_of_lanes(lanes) + c->d * error_um;
}

int32_t linear_output(LAW_ARGUMENTS(linear), const struct control *restrict signals) {
    (void)raised;
    *result = linear_command(c, s, signals->error_um);
    return 0;
}

int32_t linear_update(LAW_ARGUMENTS(linear), const struct control *restrict signals) {
    (void)raised, (void)result;
    double error_um = signals->error_um, gap_um = c->tracking_share * (signals->applied_um - signals->command_um);
    if (c->coupled)
        for (unsigned i = 0; i < c->order; i++) s->scratch[i] = s->controller[i] + c->tracking[i] * gap_um;
    for (unsigned i = 0; i < c->order; i += BLOCK)
        for (unsigned lane = 0; lane < LANES; lane++) {
            unsigned j = i + lane, k = j + LANES;
            double first = s->controller[j] + c->tracking[j] * gap_um;
            double second = s->controller[k] + c->tracking[k] * gap_um;
            s->controller[j] = c->own[j] * first + c->partner[j] * second + c->b[j] * error_um;
            s->controller[k] = c->own[k] * second + c->partner[k] * first + c->b[k] * error_um;
        }
    if (c->coupled)
        for (unsigned i = 0; i < c->order; i++)
            for (unsigned j = c->row_start[i]; j < c->row_stop[i]; j++)
                s->controller[i] += c->coupling[i][j] * s->scratch[j];
    return 0;
}

int32_t linear_enter(LAW_ARGUMENTS(linear), const struct control *restrict signals) {
    (void)raised, (void)result;
    for (unsigned i = 0; i < c->order; i++) s->controller[i] = c->steady_state[i] * signals->error_um;
    double gap_um = signals->command_um - linear_command(c, s, signals->error_um);
    for (unsigned i = 0; i < c->order; i++) s->controller[i] += c->tracking[i] * gap_um;
    return 0;
}
