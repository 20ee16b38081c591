/* The trip conditions of an axis and the counters of those that take several ticks, as rtloop.kernel.interlocks. */
#pragma once
#include <math.h>
#include <stdbool.h>
#include <string.h>
#include "layout.h"

typedef const struct axis_coefficients *axis_c;
typedef struct axis_state *axis_s;

static inline bool usable(double value) { return -1e9 < value && value < 1e9; }

static inline void condition(
    struct trip *first, int64_t *causes, int64_t among, int64_t flag, bool tripped, double value, double limit
) {
    if (!tripped || !(among & flag)) return;
    if (first && !*causes) first->cause = flag, first->value = value, first->limit = limit;
    *causes |= flag;
}

/* The causes among `among`; the first of them also to `first`, unless it is NULL. */
static inline int64_t axis_trip(
    axis_c c, axis_s s, double adc_v, const struct conditions *now, int64_t among, struct trip *first
) {
    int64_t causes = 0, *all = &causes;
    double age_us = now->sample_age_us, limit_um = c->position_limit_um;
    bool frozen = s->frozen_count >= c->frozen_ticks && c->frozen_ticks > 0
        && fabs(s->drive_v - s->frozen_from_v) > c->frozen_drive_v;
    condition(first, all, among, FLAG_TRIP_LAW, s->failed != 0, s->failed_value, (double)s->failed);
    condition(first, all, among, FLAG_TRIP_NON_FINITE, !s->usable, adc_v, 0);
    condition(first, all, among, FLAG_TRIP_SENSOR_RANGE, adc_v < c->sensor_min_v, adc_v, c->sensor_min_v);
    condition(first, all, among, FLAG_TRIP_SENSOR_RANGE, adc_v > c->sensor_max_v, adc_v, c->sensor_max_v);
    condition(first, all, among, FLAG_TRIP_POSITION, s->position_um > limit_um, s->position_um, limit_um);
    condition(first, all, among, FLAG_TRIP_POSITION, s->position_um < -limit_um, s->position_um, -limit_um);
    condition(first, all, among, FLAG_TRIP_STALE, !(age_us <= c->sample_age_limit_us), age_us, c->sample_age_limit_us);
    condition(first, all, among, FLAG_TRIP_ENABLE, !(now->enable_v >= c->enable_min_v), now->enable_v, c->enable_min_v);
    condition(first, all, among, FLAG_TRIP_FROZEN, frozen, (double)s->frozen_count, (double)c->frozen_ticks);
    condition(
        first, all, among, FLAG_TRIP_LATE, s->late_count >= c->late_ticks && c->late_ticks > 0, now->lateness_us,
        c->late_us
    );
    condition(
        first, all, among, FLAG_TRIP_TRACKING, s->tracking_count >= c->tracking_ticks && c->tracking_ticks > 0,
        s->error_um, c->tracking_error_um
    );
    condition(
        first, all, among, FLAG_TRIP_OSCILLATION, s->swing_count >= c->oscillation_swings && c->oscillation_swings > 0,
        (double)s->swing_count, (double)c->oscillation_swings
    );
    return causes;
}

static inline void count_swings(axis_c c, axis_s s) {
    double position_um = s->position_um, extreme_um = s->swing_extreme_um;
    if (++s->swing_age > c->swing_ticks) s->swing_count = 0;
    int64_t sign = s->swing_direction >= 0 ? 1 : -1;
    if ((double)sign * position_um > (double)sign * extreme_um) {
        s->swing_extreme_um = position_um;
    } else if ((double)sign * position_um < (double)sign * extreme_um - c->oscillation_um) {
        s->swing_direction = -sign;
        s->swing_extreme_um = position_um;
        s->swing_count++;
        s->swing_age = 0;
    }
}

static inline void count_ticks(axis_c c, axis_s s, int64_t mode, double adc_v, double lateness_us) {
    if (c->frozen_ticks > 0) {
        if (adc_v != s->frozen_adc_v) s->frozen_adc_v = adc_v, s->frozen_from_v = s->drive_v, s->frozen_count = 0;
        else s->frozen_count++;
    }
    if (c->late_ticks > 0) s->late_count = lateness_us > c->late_us ? s->late_count + 1 : 0;
    if (mode != MODE_CLOSED_LOOP) {
        s->tracking_count = s->swing_count = s->swing_age = 0;
        s->swing_extreme_um = s->position_um;
        return;
    }
    if (c->tracking_ticks > 0)
        s->tracking_count = fabs(s->error_um) > c->tracking_error_um ? s->tracking_count + 1 : 0;
    if (c->oscillation_swings > 0) count_swings(c, s);
}
