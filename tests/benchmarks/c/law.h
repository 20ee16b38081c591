/* The law of one tick as rtloop.kernel computes it, operation by operation, for comparison. */
#pragma once
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include "layout.h"

enum { OFF, RAW, FEEDFORWARD, CLOSED_LOOP };
enum {
    COMMAND_LIMITED = 1 << 1, DRIVE_LIMITED = 1 << 2, SLEW_LIMITED = 1 << 3, RAMPING = 1 << 4, HEARTBEAT_LOST = 1 << 5,
    TRIP_NON_FINITE = 1 << 8, TRIP_SENSOR_RANGE = 1 << 9, TRIP_POSITION = 1 << 10, TRIP_DRIVER = 1 << 11,
    TRIP_HEARTBEAT = 1 << 12, TRIP_STALE = 1 << 13, TRIP_FROZEN = 1 << 14, TRIP_TRACKING = 1 << 15,
    TRIP_OSCILLATION = 1 << 16, TRIP_LATE = 1 << 17, TRIP_ENABLE = 1 << 18, TRIP_LAW = 1 << 19,
};
enum { LANES = 4, BLOCK = 8, MAX_TAPS = 128, ANOTHER_MODE = 1, CONTROLLER_OUTPUT = 2, FEEDFORWARD_OUTPUT = 8, FEEDFORWARD_UPDATE = 10 };

typedef const struct law_coefficients *restrict law_c;
typedef struct law_state *restrict law_s;
typedef struct loop_state *restrict loop_s;

static inline double play(double value, double threshold, double last) {
    double low = value - threshold, high = value + threshold;
    double raised = low > last ? low : last;
    return high < raised ? high : raised;
}
static inline double total(const double *sums) { return (sums[0] + sums[1]) + (sums[2] + sums[3]); }

static inline double inverse_drive(law_c c, law_s s, double command_um) {
    double sums[LANES] = {0};
    for (unsigned i = 0; i < c->play_count; i += LANES)
        for (unsigned lane = 0; lane < LANES; lane++)
            sums[lane] += c->inverse_weights_v_per_um[i + lane]
                * play(command_um, c->inverse_thresholds_um[i + lane], s->inverse_plays_um[i + lane]);
    double drive = total(sums);
    if (c->dead_band_v > 0) {
        double centre = s->model_plays_v[0];
        if (drive > centre + c->dead_band_threshold_v) s->dead_band_direction = 1;
        else if (drive < centre - c->dead_band_threshold_v) s->dead_band_direction = -1;
        else if (s->entering) s->dead_band_direction = (s->drive_v - centre) / c->dead_band_v;
        drive += s->dead_band_direction * c->dead_band_v;
    }
    return drive;
}

static inline double follow_drive(law_c c, law_s s, double drive_v) {
    double sums[LANES] = {0};
    for (unsigned i = 0; i < c->play_count; i += LANES)
        for (unsigned lane = 0; lane < LANES; lane++) {
            double moved = play(drive_v, c->model_thresholds_v[i + lane], s->model_plays_v[i + lane]);
            s->model_plays_v[i + lane] = moved;
            sums[lane] += c->model_weights_um_per_v[i + lane] * moved;
        }
    double applied_um = total(sums);
    for (unsigned i = 0; i < c->play_count; i += LANES)
        for (unsigned lane = 0; lane < LANES; lane++)
            s->inverse_plays_um[i + lane] =
                play(applied_um, c->inverse_thresholds_um[i + lane], s->inverse_plays_um[i + lane]);
    return applied_um;
}

static inline double controller_output(law_c c, law_s s, double error_um) {
    double sums[LANES] = {0};
    for (unsigned i = 0; i < c->order; i += BLOCK)
        for (unsigned lane = 0; lane < LANES; lane++)
            sums[lane] += c->c[i + lane] * s->controller[i + lane]
                + c->c[i + lane + LANES] * s->controller[i + lane + LANES];
    return total(sums) + c->d * error_um;
}

static inline void controller_update(law_c c, law_s s, double error_um, double shortfall_um) {
    if (c->coupled)
        for (unsigned i = 0; i < c->order; i++) s->scratch[i] = s->controller[i] + c->tracking[i] * shortfall_um;
    for (unsigned i = 0; i < c->order; i += BLOCK)
        for (unsigned lane = 0; lane < LANES; lane++) {
            unsigned j = i + lane, k = j + LANES;
            double first = s->controller[j] + c->tracking[j] * shortfall_um;
            double second = s->controller[k] + c->tracking[k] * shortfall_um;
            s->controller[j] = c->own[j] * first + c->partner[j] * second + c->b[j] * error_um;
            s->controller[k] = c->own[k] * second + c->partner[k] * first + c->b[k] * error_um;
        }
    if (c->coupled)
        for (unsigned i = 0; i < c->order; i++)
            for (unsigned j = c->row_start[i]; j < c->row_stop[i]; j++)
                s->controller[i] += c->coupling[i][j] * s->scratch[j];
}

static inline void controller_enter(law_c c, law_s s, double error_um, double command_um) {
    for (unsigned i = 0; i < c->order; i++) s->controller[i] = c->steady_state[i] * error_um;
    double gap = command_um - controller_output(c, s, error_um);
    for (unsigned i = 0; i < c->order; i++) s->controller[i] += c->tracking[i] * gap;
}

static inline double prefilter(law_c c, law_s s, double value, double *added_um) {
    *added_um = 0;
    if (c->tap_count > 0) {
        int64_t index = (s->tap_index > 0 ? s->tap_index : MAX_TAPS) - 1;
        s->tap_index = index;
        s->tap_history[index] = s->tap_history[index + MAX_TAPS] = value;
        const double *history = s->tap_history + index;
        double x[4] = {0}, v[4] = {0};
        for (int64_t i = 0; i < c->tap_count; i += 4)
            for (int64_t lane = 0; lane < 4; lane++) {
                x[lane] += c->taps[i + lane] * history[i + lane];
                v[lane] += c->command_taps[i + lane] * history[i + lane];
            }
        value = (x[0] + x[1]) + (x[2] + x[3]);
        *added_um = (v[0] + v[1]) + (v[2] + v[3]);
    }
    for (int64_t i = 0; i < c->section_count; i++) {
        const double *q = c->sections[i];
        double *h = s->section_history[i], output = q[0] * value + h[0];
        h[0] = q[1] * value - q[3] * output + h[1];
        h[1] = q[2] * value - q[4] * output;
        value = output;
    }
    return value;
}

static inline bool usable(double value) { return -1e9 < value && value < 1e9; }

static inline double clip(double value, double low, double high) {
    return value < low ? low : value > high ? high : value;
}
static inline double toward(double value, double target, double step) {
    return clip(target, value - step, value + step);
}

static inline double died(law_c c, double offset, bool anew, double gap) {
    offset = anew ? gap : offset * c->bump_decay;
    return -1e-9 < offset && offset < 1e-9 ? 0 : offset;
}
static inline double bump(law_c c, law_s s, double gap) {
    return s->bump = died(c, s->bump, s->entering == ANOTHER_MODE, gap);
}

static inline void failed(law_s s, int64_t which, double value) {
    if (s->failed == 0) {
        s->failed = which;
        s->failed_value = value;
    }
}
static inline void trip_by_law(loop_s loop) {
    loop->new_trip |= TRIP_LAW & ~loop->trip;
    loop->trip |= TRIP_LAW;
    loop->mode = OFF;
}

static inline bool control(law_c c, law_s s) {
    double applied_um = s->applied_command_um - s->feed_um, resting_um = c->resting_error[0] * applied_um;
    double met_um = s->error_um - bump(c, s, s->error_um - resting_um);
    if (s->entering) controller_enter(c, s, met_um, applied_um);
    double command_um = controller_output(c, s, met_um);
    bool good = usable(command_um);
    if (!good) failed(s, CONTROLLER_OUTPUT, command_um);
    s->command_bump_um = died(c, s->command_bump_um, s->entering != 0, applied_um - command_um);
    s->command_um = (command_um + s->command_bump_um) + s->feed_um;
    return good;
}

static inline int64_t drive_of(law_c c, law_s s, loop_s loop, double reference) {
    double last_v = s->drive_v;
    if (loop->new_trip && (!s->usable || s->failed)) {
        s->demand_v = last_v;
        return RAMPING;
    }
    if (loop->mode == OFF) {
        s->drive_v = toward(last_v, c->safe_v, c->trip_slew_v_per_tick);
        s->demand_v = c->safe_v;
        s->command_um = s->applied_command_um;
        return s->drive_v == c->safe_v ? 0 : RAMPING;
    }
    int64_t flags = 0;
    if (loop->mode == RAW) {
        s->command_um = s->applied_command_um;
        s->demand_v = reference + bump(c, s, last_v - reference);
    } else {
        if (loop->mode == FEEDFORWARD) {
            s->command_um = reference + bump(c, s, s->applied_command_um - reference);
        }
        double limited = clip(s->command_um, -c->command_limit_um, c->command_limit_um);
        if (limited != s->command_um) flags |= COMMAND_LIMITED;
        s->demand_v = inverse_drive(c, s, limited);
        if (!usable(s->demand_v)) failed(s, FEEDFORWARD_OUTPUT, s->demand_v);
        if (s->failed) {
            trip_by_law(loop);
            s->demand_v = last_v;
            return RAMPING;
        }
    }
    s->entering = 0;
    double allowed = clip(s->demand_v, c->drive_min_v, c->drive_max_v);
    if (allowed != s->demand_v) flags |= DRIVE_LIMITED;
    s->drive_v = toward(last_v, allowed, c->slew_v_per_tick);
    if (s->drive_v != allowed) flags |= SLEW_LIMITED;
    return flags;
}

static inline bool frozen(law_c c, law_s s, double adc_v) {
    if (adc_v != s->frozen_adc_v) {
        s->frozen_adc_v = adc_v;
        s->frozen_from_v = s->drive_v;
        s->frozen_count = 0;
        return false;
    }
    double moved_v = s->drive_v - s->frozen_from_v;
    if (moved_v < 0) moved_v = -moved_v;
    return ++s->frozen_count >= c->frozen_ticks && moved_v > c->frozen_drive_v;
}

static inline void swing(law_s s, int64_t direction) {
    s->swing_direction = direction;
    s->swing_extreme_um = s->position_um;
    s->swing_count++;
    s->swing_age = 0;
}

static inline void count_swings(law_c c, law_s s) {
    double position_um = s->position_um, extreme_um = s->swing_extreme_um;
    if (++s->swing_age > c->swing_ticks) s->swing_count = 0;
    if (s->swing_direction >= 0) {
        if (position_um > extreme_um) s->swing_extreme_um = position_um;
        else if (position_um < extreme_um - c->oscillation_um) swing(s, -1);
    } else if (position_um < extreme_um) s->swing_extreme_um = position_um;
    else if (position_um > extreme_um + c->oscillation_um) swing(s, 1);
}

static inline int64_t watch(law_c c, law_s s, int64_t mode, double adc_v, double lateness_us) {
    int64_t causes = 0;
    if (c->frozen_ticks > 0 && frozen(c, s, adc_v)) causes |= TRIP_FROZEN;
    if (c->late_ticks > 0) {
        s->late_count = lateness_us > c->late_us ? s->late_count + 1 : 0;
        if (s->late_count >= c->late_ticks) causes |= TRIP_LATE;
    }
    if (mode != CLOSED_LOOP) {
        s->tracking_count = s->swing_count = s->swing_age = 0;
        s->swing_extreme_um = s->position_um;
        return causes;
    }
    if (c->tracking_ticks > 0) {
        double error_um = s->error_um >= 0 ? s->error_um : -s->error_um;
        s->tracking_count = error_um > c->tracking_error_um ? s->tracking_count + 1 : 0;
        if (s->tracking_count >= c->tracking_ticks) causes |= TRIP_TRACKING;
    }
    if (c->oscillation_swings > 0) {
        count_swings(c, s);
        if (s->swing_count >= c->oscillation_swings) causes |= TRIP_OSCILLATION;
    }
    return causes;
}

static inline void evaluate(
    law_c c, law_s s, loop_s loop, int64_t axes, const double *restrict adc_v, const double *restrict references,
    const double *restrict feeds_um,
    const struct conditions *restrict now
) {
    bool lost = now->heartbeat_lost != 0;
    int64_t causes = (now->driver_status < 0 ? TRIP_DRIVER : 0) | (lost ? TRIP_HEARTBEAT : 0) | loop->pending;
    loop->pending = 0;
    for (int64_t a = 0; a < axes; a++) {
        double position_um = (adc_v[a] - c[a].offset_v) * c[a].um_per_v;
        s[a].position_um = position_um;
        s[a].usable = usable(adc_v[a]) && usable(references[a]) && usable(feeds_um[a]);
        if (!s[a].usable) causes |= TRIP_NON_FINITE;
        if (adc_v[a] < c[a].sensor_min_v || adc_v[a] > c[a].sensor_max_v) causes |= TRIP_SENSOR_RANGE;
        if (position_um < -c[a].position_limit_um || position_um > c[a].position_limit_um) causes |= TRIP_POSITION;
        if (!(now->sample_age_us <= c[a].sample_age_limit_us)) causes |= TRIP_STALE;
        if (!(now->enable_v >= c[a].enable_min_v)) causes |= TRIP_ENABLE;
        causes |= watch(&c[a], &s[a], loop->mode, adc_v[a], now->lateness_us);
    }
    loop->new_trip = causes & ~loop->trip;
    loop->trip |= causes;
    if (loop->trip) loop->mode = OFF;
    for (int64_t a = 0; a < axes; a++) {
        double added_um = 0, wanted_um = references[a];
        if (s[a].usable) wanted_um = prefilter(&c[a], &s[a], references[a], &added_um);
        s[a].error_um = wanted_um - s[a].position_um;
        s[a].feed_um = feeds_um[a] + added_um;
    }
    if (loop->mode == CLOSED_LOOP) {
        bool good = true;
        for (int64_t a = 0; a < axes; a++) good = control(&c[a], &s[a]) && good;
        if (!good) trip_by_law(loop);
    }
    loop->tick_flags = lost ? HEARTBEAT_LOST : 0;
    loop->settled = 1;
    for (int64_t a = 0; a < axes; a++) {
        loop->tick_flags |= drive_of(&c[a], &s[a], loop, references[a]);
        if (s[a].drive_v != c[a].safe_v) loop->settled = 0;
    }
    loop->tick_flags |= loop->trip;
}

static inline void update(law_c c, law_s s, loop_s loop, int64_t axes) {
    for (int64_t a = 0; a < axes; a++) {
        double applied_um = follow_drive(&c[a], &s[a], s[a].drive_v);
        if (usable(applied_um)) {
            s[a].applied_command_um = applied_um;
        } else {
            failed(&s[a], FEEDFORWARD_UPDATE, applied_um);
            loop->pending |= TRIP_LAW;
        }
    }
    if (loop->mode != CLOSED_LOOP) return;
    for (int64_t a = 0; a < axes; a++) {
        double shortfall_um = s[a].applied_command_um - s[a].command_um;
        controller_update(&c[a], &s[a], s[a].error_um - s[a].bump, c[a].tracking_share * shortfall_um);
    }
}
