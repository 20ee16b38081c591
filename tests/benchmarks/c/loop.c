/* The work of rtloop in a tick, in C, on the same records and with the same pointers to laws, driver and clock.
 *
 *     run_law    the law alone over arrays of readings and references
 *     run_loop   the loop of rtloop.engine.loop: commands, snapshot, wait, read, interlocks, law, write, events, record
 *
 * Left out, in favour of C: all kinds of references except constants and tables, coefficients that are loaded during a run,
 * controllers of several axes, extra channels. A run that needs them ends the program. */
#include <time.h>
#include "laws.h"
#include "commands.h"
#include "rig.h"
#include "spin.h"

enum { DONE, STOPPED, DRIVER_FAILED, HEARTBEAT_LOST, READ_FAILED = 1, WRITE_FAILED, BACKPRESSURE_NS = 50000 };
typedef int32_t (*driver_function)(void *context, double *values);

static inline int32_t call(int64_t function, int64_t context, int64_t values) {
    return ((driver_function)at(function))(at(context), (double *)at(values));
}

void run_law(
    law_p law, const double *restrict adc_v, const double *restrict references, const int64_t *restrict modes,
    const struct conditions *restrict now, int64_t ticks, double *restrict out
) {
    const double feed_um = 0;
    for (int64_t k = 0; k < ticks; k++) {
        if (modes[k] >= 0) {
            reset_trip(law);
            set_mode(law, modes[k], false);
        }
        evaluate(law, &adc_v[k], &references[k], &feed_um, now);
        update(law);
        axis_s s = state_of(law, 0);
        out[4 * k] = s->command_um;
        out[4 * k + 1] = s->demand_v;
        out[4 * k + 2] = s->drive_v;
        out[4 * k + 3] = (double)loop_of(law)->tick_flags;
    }
}

int32_t unpaced_wait(void *context, double *timing) {
    struct clock *clock = context;
    word_p head = (word_p)at(clock->head_address), words = (word_p)at(clock->words_address);
    const struct timespec pause = {.tv_nsec = BACKPRESSURE_NS};
    while ((int64_t)(atomic_load_explicit(head, memory_order_relaxed) - load(words + clock->cursor_word))
           > clock->slack_ticks)
        nanosleep(&pause, NULL);
    timing[0] = (double)(int64_t)((double)clock->index * clock->period_ns);
    timing[1] = timing[3] = NAN;
    timing[2] = 0;
    clock->index++;
    return 0;
}

static inline double reference_sample(struct generator *g, int64_t tick, const double *table) {
    if (tick < g->held_until) return g->held;
    if (g->kind == GENERATOR_HOLD) {
        g->held_until = INT64_MAX;
        return g->held = g->parameters[0];
    }
    if (g->kind != GENERATOR_TABLE) abort();
    int64_t hold_ticks = (int64_t)g->parameters[2], index = (tick - g->start_tick) / hold_ticks;
    int64_t count = (int64_t)g->parameters[1];
    g->held_until = g->start_tick + (index + 1) * hold_ticks;
    index = g->parameters[3] != 0 ? index % count : index < count ? index : count - 1;
    index += (int64_t)g->parameters[0];
    g->feed_um = g->parameters[4] != 0 ? table[index + count] : 0;
    return g->held = table[index];
}

static void end_late_episode(loop_p loop) {
    const double values[] = {(double)loop->late_periods, (double)loop->late_ticks, (double)loop->late_largest};
    if (loop->late_ticks > 1) publish_event(loop, KIND_LATENESS_OVER, ALL_AXES, ORIGIN_LOOP, 0, values, 3);
    loop->late_ticks = loop->late_periods = loop->late_largest = 0;
}

static void record_lateness(loop_p loop, double missed) {
    int64_t periods = (int64_t)missed;
    if (loop->tick >= loop->late_until) end_late_episode(loop);
    if (loop->late_ticks == 0) publish_event(loop, KIND_PERIODS_MISSED, ALL_AXES, ORIGIN_LOOP, 0, &missed, 1);
    loop->late_ticks++;
    loop->late_periods += periods;
    if (periods > loop->late_largest) loop->late_largest = periods;
    loop->late_until = loop->tick + (int64_t)(1.0 / loop->period_s);
}

static inline void prepare_tick(loop_p loop) {
    apply_commands(loop);
    bool failing = loop->failed == WRITE_FAILED;
    if (loop->stopping == 0 && (failing || load(words_of(loop) + WORD_STOP) != 0)) {
        loop->stopping = 1;
        publish_event(loop, KIND_STOP, ALL_AXES, failing ? ORIGIN_LOOP : ORIGIN_SUPERVISOR, 0, (double[]){0, 0}, 2);
        set_mode(law_of(loop), MODE_OFF, false);
    }
    if (loop->tick >= loop->next_snapshot) {
        publish_snapshot(loop);
        loop->next_snapshot = loop->tick + loop->snapshot_ticks;
        if (loop->tick >= loop->late_until) end_late_episode(loop);
    }
}

static inline double elapsed_ns(loop_p loop) {
    if (loop->now == 0) return NAN;
    call(loop->now, loop->clock_context, loop->timing);
    return *(const double *)at(loop->timing);
}

static inline void evaluate_law(loop_p loop, int32_t status, double now_ns, double lateness_us) {
    law_p law = law_of(loop);
    const double *inputs = (const double *)at(loop->inputs), *table = (const double *)at(loop->table);
    double *outputs = (double *)at(loop->outputs), *adc_v = (double *)at(loop->adc_v);
    double *references = (double *)at(loop->references), *feeds_um = (double *)at(loop->feeds_um);
    const int64_t *input_index = (const int64_t *)at(loop->input_index);
    const int64_t *output_index = (const int64_t *)at(loop->output_index);
    struct generator *generators = (struct generator *)at(loop->generators);
    struct conditions *now = (struct conditions *)at(loop->conditions);
    for (unsigned a = 0; a < loop->axis_count; a++) {
        adc_v[a] = inputs[input_index[a]];
        references[a] = reference_sample(&generators[a], loop->tick, table);
        feeds_um[a] = generators[a].feed_um;
    }
    double heartbeat_ns = (double)load(words_of(loop) + WORD_HEARTBEAT_NS);
    now->driver_status = status;
    now->heartbeat_lost = now_ns - heartbeat_ns > loop->heartbeat_timeout_ns;
    now->sample_age_us = inputs[loop->input_count];
    now->lateness_us = lateness_us;
    now->enable_v = loop->enable_index >= 0 ? inputs[loop->enable_index] : 0;
    evaluate(law, adc_v, references, feeds_um, now);
    for (unsigned a = 0; a < loop->axis_count; a++) outputs[output_index[a]] = state_of(law, a)->drive_v;
}

static inline void record_outputs(loop_p loop, int32_t write_status) {
    law_p law = law_of(loop);
    double *last_drive_v = (double *)at(loop->last_drive_v);
    if (write_status < 0) {
        loop_of(law)->settled = (double)++loop->refused * loop->period_s > 1.0;
        for (unsigned a = 0; a < loop->axis_count; a++) state_of(law, a)->drive_v = last_drive_v[a];
        return;
    }
    loop->refused = 0;
    for (unsigned a = 0; a < loop->axis_count; a++) last_drive_v[a] = state_of(law, a)->drive_v;
}

static inline void publish_events(loop_p loop, int32_t status, int32_t write_status, double missed) {
    int64_t causes = loop_of(law_of(loop))->new_trip;
    if (causes) {
        const struct trip *trip = (const struct trip *)at(law_of(loop)->trip);
        double values[] = {(double)causes, trip->value, trip->limit, (double)trip->cause, (double)trip->law};
        publish_event(loop, KIND_TRIPPED, trip->axis, ORIGIN_LOOP, 0, values, 5);
    }
    if (loop->failed == 0 && (status < 0 || write_status < 0)) {
        loop->failed = write_status < 0 ? WRITE_FAILED : READ_FAILED;
        loop->failed_tick = loop->tick;
        loop->failed_status = write_status < 0 ? write_status : status;
        double values[] = {(double)loop->failed_status, write_status < 0};
        publish_event(loop, KIND_DRIVER_FAILED, ALL_AXES, ORIGIN_LOOP, 0, values, 2);
    }
    if (missed > 0) record_lateness(loop, missed);
}

static inline void fill_signals(loop_p loop, double *restrict row) {
    const double *inputs = (const double *)at(loop->inputs), *adc_v = (const double *)at(loop->adc_v);
    const double *references = (const double *)at(loop->references), *feeds_um = (const double *)at(loop->feeds_um);
    row[COLUMN_SAMPLE_AGE] = inputs[loop->input_count];
    row[COLUMN_ENABLE] = ((const struct conditions *)at(loop->conditions))->enable_v;
    double *column = row + COLUMN_COMMON_COUNT;
    for (unsigned a = 0; a < loop->axis_count; a++, column += COLUMN_PER_AXIS_COUNT) {
        axis_s s = state_of(law_of(loop), a);
        column[COLUMN_ADC] = adc_v[a];
        column[COLUMN_POSITION] = s->position_um;
        column[COLUMN_REFERENCE] = references[a];
        column[COLUMN_ERROR] = s->error_um;
        column[COLUMN_COMMAND] = s->command_um;
        column[COLUMN_DEMAND] = s->demand_v;
        column[COLUMN_DRIVE] = s->drive_v;
        column[COLUMN_FEED] = feeds_um[a];
    }
    for (unsigned i = 0; i < loop->observed_count; i++) column[i] = inputs[loop->input_count + 1 + i];
}

static inline void execute_tick(loop_p loop) {
    const double *timing = (const double *)at(loop->timing);
    double deadline_ns = timing[0], wake_ns = timing[1], missed = timing[2], now_ns = timing[3];
    int32_t status = call(loop->read, loop->driver_context, loop->inputs);
    double read_ns = elapsed_ns(loop), lateness_us = (wake_ns - deadline_ns) * 1e-3;
    evaluate_law(loop, status, now_ns, lateness_us);
    double law_ns = elapsed_ns(loop);
    int32_t write_status = call(loop->write, loop->driver_context, loop->outputs);
    double write_ns = elapsed_ns(loop);
    record_outputs(loop, write_status);
    update(law_of(loop));
    publish_events(loop, status, write_status, missed);
    if (loop->tick >= loop->record_limit) return;

    loop_s state = loop_of(law_of(loop));
    uint64_t slot = claim(loop->ticks_marks, loop->ticks_capacity, loop->tick);
    double *restrict row = (double *)at(loop->ticks_slots) + slot * loop->column_count;
    fill_signals(loop, row);
    row[COLUMN_TICK] = (double)loop->tick;
    row[COLUMN_DEADLINE] = deadline_ns;
    row[COLUMN_LATENESS] = lateness_us;
    row[COLUMN_READ] = (read_ns - wake_ns) * 1e-3;
    row[COLUMN_LAW] = (law_ns - read_ns) * 1e-3;
    row[COLUMN_WRITE] = (write_ns - law_ns) * 1e-3;
    row[COLUMN_PERIODS_MISSED] = missed;
    row[COLUMN_MODE] = (double)state->mode;
    row[COLUMN_DRIVER_STATUS] = status;
    row[COLUMN_EXEC] = (elapsed_ns(loop) - wake_ns) * 1e-3;
    bool overrun = lateness_us + row[COLUMN_EXEC] > loop->period_us;
    row[COLUMN_FLAGS] =
        (double)(state->tick_flags | (overrun ? FLAG_OVERRUN : 0) | (write_status < 0 ? FLAG_WRITE_FAILED : 0));
    publish(loop->ticks_head, loop->ticks_marks, loop->ticks_capacity, loop->tick);
}

int64_t run_loop(loop_p loop, int64_t until_tick) {
    while (loop->tick < until_tick) {
        prepare_tick(loop);
        if (call(loop->wait, loop->wait_context, loop->timing) != 0) return DRIVER_FAILED;
        execute_tick(loop);
        loop->tick++;
        loop_s state = loop_of(law_of(loop));
        if (!state->settled) continue;
        if (loop->failed) return DRIVER_FAILED;
        if (state->trip & FLAG_TRIP_HEARTBEAT) return HEARTBEAT_LOST;
        if (loop->stopping) return STOPPED;
    }
    return DONE;
}
