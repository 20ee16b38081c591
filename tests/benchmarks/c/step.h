/* The step of a tick around the laws, like rtloop.kernel.step: `evaluate` before the drive is written, `update` after.
 * A controller of several axes and extra inputs and outputs end the program: no benchmark has them. */
#pragma once
#include <stdlib.h>
#include "interlocks.h"

enum { MAX_TAPS = 128, TAP_LANES = 4, REFILL = -1, ANOTHER_MODE = 1, NO_AXIS = -1 };
typedef struct law *law_p;
typedef struct loop_state *loop_s;
typedef int32_t (*feedforward_function)(void *result, void *raised, const void *c, void *s, double value);
typedef int32_t (*controller_function)(void *result, void *raised, const void *c, void *s, const struct control *signals);

static inline char *at(int64_t address) { return (char *)(intptr_t)address; }
static inline axis_c coefficients_of(law_p law, unsigned a) {
    return (axis_c)at(law->coefficients + a * law->coefficients_bytes);
}
static inline axis_s state_of(law_p law, unsigned a) { return (axis_s)at(law->axes + a * law->axes_bytes); }
static inline struct control *control_of(law_p law, unsigned a) { return (struct control *)at(law->controls) + a; }
static inline const struct functions *functions_of(law_p law, unsigned number) {
    return (const struct functions *)at(law->functions) + number;
}
static inline loop_s loop_of(law_p law) { return (loop_s)at(law->loop); }
static inline bool returned(int32_t status) { return status == 0 || status == -2; }

static void failed(axis_s s, int64_t which, double value) {
    if (s->failed == 0) s->failed = which, s->failed_value = value;
}

static inline bool call_feedforward(law_p law, unsigned a, int64_t function, double *result, double value) {
    return returned(((feedforward_function)at(function))(
        result, at(law->raised), (const char *)coefficients_of(law, a) + sizeof(struct axis_coefficients),
        (char *)state_of(law, a) + sizeof(struct axis_state), value
    ));
}
static inline bool call_controller(law_p law, unsigned a, int64_t function) {
    return returned(((controller_function)at(function))(
        at(law->result), at(law->raised), (const char *)coefficients_of(law, a) + law->controller_coefficients,
        (char *)state_of(law, a) + law->controller_state, control_of(law, a)
    ));
}

static inline double clip(double value, double low, double high) {
    return value < low ? low : value > high ? high : value;
}
static inline double toward(double value, double target, double step) {
    return clip(target, value - step, value + step);
}
static inline double decayed(axis_c c, double offset, bool restarts, double gap) {
    offset = restarts ? gap : offset * c->bump_decay;
    return -1e-9 < offset && offset < 1e-9 ? 0 : offset;
}
static inline double bump(axis_c c, axis_s s, double gap) {
    return s->bump = decayed(c, s->bump, s->entering == ANOTHER_MODE, gap);
}
static inline void trip_by_law(loop_s loop) {
    loop->new_trip |= FLAG_TRIP_LAW & ~loop->trip;
    loop->trip |= FLAG_TRIP_LAW;
    loop->mode = MODE_OFF;
}

static void set_mode(law_p law, int64_t mode, bool at_rest) {
    loop_of(law)->mode = mode;
    for (unsigned a = 0; a < law->axis_count; a++) {
        axis_s s = state_of(law, a);
        s->entering = at_rest ? 0 : ANOTHER_MODE;
        s->failed = 0;
        if (!at_rest && mode != MODE_OFF) s->tap_index = REFILL;
    }
}
static void reset_trip(law_p law) {
    loop_of(law)->trip = 0;
    loop_of(law)->mode = MODE_OFF;
}

static inline double tap_outputs(axis_c c, axis_s s, double *added_um) {
    double x[TAP_LANES] = {0}, v[TAP_LANES] = {0};
    const double *history = s->tap_history + s->tap_index;
    for (int64_t i = 0; i < c->tap_count; i += TAP_LANES)
        for (int64_t lane = 0; lane < TAP_LANES; lane++) {
            x[lane] += c->taps[i + lane] * history[i + lane];
            v[lane] += c->command_taps[i + lane] * history[i + lane];
        }
    *added_um = (v[0] + v[1]) + (v[2] + v[3]);
    return (x[0] + x[1]) + (x[2] + x[3]);
}

static void fill_prefilter(axis_c c, axis_s s, double value) {
    double unused;
    s->tap_index = 0;
    for (int64_t i = 0; i < 2 * MAX_TAPS; i++) s->tap_history[i] = value;
    if (c->tap_count > 0) value = tap_outputs(c, s, &unused);
    for (int64_t i = 0; i < c->section_count; i++) {
        const double *q = c->sections[i];
        double output = value * (q[0] + q[1] + q[2]) / (1.0 + q[3] + q[4]);
        s->section_history[i][0] = output - q[0] * value;
        s->section_history[i][1] = q[2] * value - q[4] * output;
        value = output;
    }
}

static inline double prefilter(axis_c c, axis_s s, double value, double *added_um) {
    if (s->tap_index < 0) fill_prefilter(c, s, value);
    *added_um = 0;
    if (c->tap_count > 0) {
        int64_t index = (s->tap_index > 0 ? s->tap_index : MAX_TAPS) - 1;
        s->tap_index = index;
        s->tap_history[index] = s->tap_history[index + MAX_TAPS] = value;
        value = tap_outputs(c, s, added_um);
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

static bool enter_controller(law_p law, unsigned a) {
    const struct functions *functions = functions_of(law, coefficients_of(law, a)->controller_law);
    memset((char *)state_of(law, a) + law->controller_state, 0, (size_t)functions->state_bytes);
    if (functions->enter == 0 || call_controller(law, a, functions->enter)) return true;
    failed(state_of(law, a), FAILURE_CONTROLLER_ENTER + RAISED, NAN);
    return false;
}

static inline bool control_axis(law_p law, unsigned a) {
    axis_c c = coefficients_of(law, a);
    axis_s s = state_of(law, a);
    struct control *signals = control_of(law, a);
    double in_force_um = s->applied_command_um - s->feed_um, resting_um = c->resting_error[0] * in_force_um;
    double error_um = s->error_um - bump(c, s, s->error_um - resting_um), command_um = NAN;
    signals->reference_um = s->position_um + error_um;
    signals->position_um = s->position_um;
    signals->error_um = error_um;
    signals->command_um = signals->applied_um = in_force_um;
    bool good = s->entering == 0 || enter_controller(law, a);
    if (call_controller(law, a, functions_of(law, c->controller_law)->output)) {
        command_um = *(const double *)at(law->result);
    } else {
        failed(s, FAILURE_CONTROLLER_OUTPUT + RAISED, NAN);
        good = false;
    }
    s->command_bump_um = decayed(c, s->command_bump_um, s->entering != 0, in_force_um - command_um);
    signals->command_um = command_um + s->command_bump_um;
    s->command_um = signals->command_um + s->feed_um;
    if (usable(command_um)) return good;
    failed(s, FAILURE_CONTROLLER_OUTPUT, command_um);
    return false;
}

static void enter_feedforward(law_p law, unsigned a, double drive_v) {
    const struct functions *functions = functions_of(law, coefficients_of(law, a)->feedforward_law);
    if (functions->enter != 0 && !call_feedforward(law, a, functions->enter, (double *)at(law->result), drive_v))
        failed(state_of(law, a), FAILURE_FEEDFORWARD_ENTER + RAISED, NAN);
}

static inline double demand_of(law_p law, unsigned a, axis_c c, axis_s s, double command_um) {
    double *result = (double *)at(law->result);
    if (!call_feedforward(law, a, functions_of(law, c->feedforward_law)->output, result, command_um)) {
        failed(s, FAILURE_FEEDFORWARD_OUTPUT + RAISED, NAN);
        return NAN;
    }
    double demand_v = *result;
    if (!usable(demand_v)) failed(s, FAILURE_FEEDFORWARD_OUTPUT, demand_v);
    return demand_v;
}

static inline int64_t set_drive(law_p law, unsigned a, loop_s loop, axis_c c, axis_s s, double reference) {
    double last_v = s->drive_v, demand_v;
    if (loop->new_trip && (!s->usable || s->failed)) {
        s->demand_v = last_v;
        return FLAG_RAMPING;
    }
    if (loop->mode == MODE_OFF) {
        s->drive_v = toward(last_v, c->safe_v, c->trip_slew_v_per_tick);
        s->demand_v = c->safe_v;
        s->command_um = s->applied_command_um;
        return s->drive_v == c->safe_v ? 0 : FLAG_RAMPING;
    }
    int64_t flags = 0;
    if (loop->mode == MODE_RAW) {
        s->command_um = s->applied_command_um;
        demand_v = reference + bump(c, s, last_v - reference);
    } else {
        if (loop->mode == MODE_FEEDFORWARD) s->command_um = reference + bump(c, s, s->applied_command_um - reference);
        double limited_um = clip(s->command_um, -c->command_limit_um, c->command_limit_um);
        if (limited_um != s->command_um) flags |= FLAG_COMMAND_LIMITED;
        if (s->entering) enter_feedforward(law, a, last_v);
        demand_v = demand_of(law, a, c, s, limited_um);
        if (s->failed) {
            trip_by_law(loop);
            s->demand_v = last_v;
            return FLAG_RAMPING;
        }
    }
    s->entering = 0;
    s->demand_v = demand_v;
    double allowed_v = clip(demand_v, c->drive_min_v, c->drive_max_v);
    if (allowed_v != demand_v) flags |= FLAG_DRIVE_LIMITED;
    s->drive_v = toward(last_v, allowed_v, c->slew_v_per_tick);
    if (s->drive_v != allowed_v) flags |= FLAG_SLEW_LIMITED;
    return flags;
}

static void record_trip(law_p law, const double *adc_v, const struct conditions *now, int64_t causes) {
    struct trip *trip = (struct trip *)at(law->trip);
    *trip = (struct trip){.axis = NO_AXIS};
    for (unsigned a = 0; a < law->axis_count && trip->cause == 0; a++) {
        axis_c c = coefficients_of(law, a);
        if (axis_trip(c, state_of(law, a), adc_v[a], now, causes, trip) == 0) continue;
        trip->axis = a;
        trip->law = trip->limit >= FAILURE_FEEDFORWARD_OUTPUT ? c->feedforward_law : c->controller_law;
    }
}

static inline void evaluate(
    law_p law, const double *restrict adc_v, const double *restrict references, const double *restrict feeds_um,
    const struct conditions *restrict now
) {
    loop_s loop = loop_of(law);
    int64_t causes = (now->driver_status < 0 ? FLAG_TRIP_DRIVER : 0) | (now->heartbeat_lost ? FLAG_TRIP_HEARTBEAT : 0);
    causes |= loop->pending;
    loop->pending = 0;
    if (law->extra_count) abort();
    for (unsigned a = 0; a < law->axis_count; a++) {
        axis_c c = coefficients_of(law, a);
        axis_s s = state_of(law, a);
        s->position_um = (adc_v[a] - c->offset_v) * c->um_per_v;
        s->usable = usable(adc_v[a]) && usable(references[a]) && usable(feeds_um[a]);
        count_ticks(c, s, loop->mode, adc_v[a], now->lateness_us);
        causes |= axis_trip(c, s, adc_v[a], now, ~(int64_t)FLAG_TRIP_LAW, NULL);
        double target_um = references[a], added_um = 0;
        if (s->usable) target_um = prefilter(c, s, references[a], &added_um);
        s->error_um = target_um - s->position_um;
        s->feed_um = feeds_um[a] + added_um;
    }
    loop->new_trip = causes & ~loop->trip;
    if (loop->new_trip) record_trip(law, adc_v, now, loop->new_trip);
    loop->trip |= causes;
    if (loop->trip) loop->mode = MODE_OFF;
    loop->tick_flags = now->heartbeat_lost ? FLAG_HEARTBEAT_LOST : 0;
    loop->settled = 1;
    for (unsigned a = 0; a < law->axis_count; a++) {
        axis_c c = coefficients_of(law, a);
        axis_s s = state_of(law, a);
        if (c->controller_axes != 1) abort();
        if (loop->mode == MODE_CLOSED_LOOP && !control_axis(law, a)) trip_by_law(loop);
        loop->tick_flags |= set_drive(law, a, loop, c, s, references[a]);
        if (s->drive_v != c->safe_v) loop->settled = 0;
    }
    if (loop->new_trip & ~causes) record_trip(law, adc_v, now, loop->new_trip);
    loop->tick_flags |= loop->trip;
}

static inline void update(law_p law) {
    loop_s loop = loop_of(law);
    for (unsigned a = 0; a < law->axis_count; a++) {
        axis_c c = coefficients_of(law, a);
        axis_s s = state_of(law, a);
        double *applied_um = &control_of(law, a)->applied_um;
        if (!call_feedforward(law, a, functions_of(law, c->feedforward_law)->update, applied_um, s->drive_v)) {
            failed(s, FAILURE_FEEDFORWARD_UPDATE + RAISED, NAN);
            loop->pending |= FLAG_TRIP_LAW;
        } else if (!usable(*applied_um)) {
            failed(s, FAILURE_FEEDFORWARD_UPDATE, *applied_um);
            loop->pending |= FLAG_TRIP_LAW;
        } else {
            s->applied_command_um = *applied_um;
            *applied_um -= s->feed_um;
        }
        if (loop->mode == MODE_CLOSED_LOOP && !call_controller(law, a, functions_of(law, c->controller_law)->update)) {
            failed(s, FAILURE_CONTROLLER_UPDATE + RAISED, NAN);
            loop->pending |= FLAG_TRIP_LAW;
        }
    }
}
